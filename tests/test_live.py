"""Rows as they come: from pipes, growing files and UDP, and what is said when they stop coming."""

from __future__ import annotations

import io
import itertools
import json
import os
import socket
import threading
import time
import tracemalloc
from functools import partial

import numpy as np
import pytest
from rich.console import Console

from asm_gym.data.live import RowReader, SourceDied
from asm_gym.data.sources import is_live, lines_from
from asm_gym.detection.events import EVENTS, KNOCK
from asm_gym.evaluation.alarms import excused_in
from asm_gym.evaluation.scored_episode import ScoredEpisode
from asm_gym.monitors import make_monitor
from asm_gym.scripts.cli import main
from asm_gym.scripts.watch import follow
from asm_gym.spec import MOTOR, Channel, StreamSpec
from tests.streams import swing

SPEC = StreamSpec((Channel("q", 2, "rad"), Channel("torque", 1), Channel("cmd", 1, group=MOTOR)), dt=0.02)
ROWS = np.arange(40.0).reshape(10, 4)


def csv_lines(times=None, rows=ROWS, header="time [s],cmd,q_0 [rad],q_1 [rad],note,torque"):
    times = 0.02 * np.arange(len(rows)) if times is None else times
    return [header, *(f"{t:.3f},{r[3]},{r[0]},{r[1]},fine,{r[2]}" for t, r in zip(times, rows, strict=True))]


def read(lines):
    return [(row.numbers.tolist(), row.lost) for row, _ in RowReader(SPEC).rows(lines)]


def test_csv_is_read_by_its_header_in_whatever_order():
    assert read(csv_lines()) == [(row.tolist(), 0) for row in ROWS]
    assert read([json.dumps(row.tolist()) for row in ROWS]) == [(row.tolist(), 0) for row in ROWS]


def test_rows_that_are_missing_by_their_time_are_counted():
    kept = [0, 1, 2, 5, 6]
    assert [lost for _, lost in read(csv_lines(0.02 * np.array(kept), ROWS[kept]))] == [0, 0, 0, 2, 0]
    named = [{"t": 0.02 * k, "q": [1, 2], "torque": 3, "cmd": 4} for k in (0, 4)]
    assert [lost for _, lost in read(map(json.dumps, named))] == [0, 3]


@pytest.mark.parametrize(
    ("lines", "message"),
    [
        (["time,q_0,q_1,torque", "1,2,3,4"], "line 1 is no row of numbers, and no header: it lacks cmd"),
        (["q_0,q_0", "1,2"], "columns of the same name"),
        ([*csv_lines()[:2], "0.1,1,2"], "line 3 is no row of numbers: it has 3 cells, the header 6"),
        ([*csv_lines()[:2], "0.1,1,2,x,fine,3"], "line 3 is no row of numbers"),
        ([*csv_lines()[:3], csv_lines()[1]], r"line 4 is no row of numbers: time must increase, got 0 s after 0\.02"),
    ],
)
def test_a_line_that_is_no_row_is_named(lines, message):
    with pytest.raises(ValueError, match=message):
        read(lines)


def test_a_pipe_ends_where_its_writer_closes_it_and_dies_where_it_falls_silent():
    reader, writer = os.pipe()
    with os.fdopen(reader) as stdin:
        os.write(writer, b"[1]\n[2]\n[3")
        found = lines_from("-", stdin, 0.05)
        assert [next(found), next(found)] == ["[1]", "[2]"]
        with pytest.raises(SourceDied, match=r"nothing came for 0\.05 s"):
            next(found)
    reader, second = os.pipe()
    with os.fdopen(reader) as stdin:
        os.write(second, b"[1]\n[2]")
        os.close(second)
        assert list(lines_from("-", stdin, 5.0)) == ["[1]", "[2]"]
    os.close(writer)


def test_a_file_is_followed_while_it_grows(tmp_path):
    path = tmp_path / "log.csv"
    path.write_text("a\n1\n")

    def grow():
        with path.open("a") as file:
            for number in range(2, 6):
                time.sleep(0.02)
                file.write(f"{number}\n")
                file.flush()

    thread = threading.Thread(target=grow)
    thread.start()
    lines = lines_from(f"tail:{path}", io.StringIO(), 0.5)
    assert [next(lines) for _ in range(6)] == ["a", "1", "2", "3", "4", "5"]
    thread.join()
    with pytest.raises(SourceDied):
        next(lines)


def test_a_file_that_became_shorter_is_no_log_any_more(tmp_path):
    path = tmp_path / "log.csv"
    path.write_text("a\n1\n2\n")
    found = lines_from(f"tail:{path}", io.StringIO(), 1.0)
    assert [next(found) for _ in range(3)] == ["a", "1", "2"]
    path.write_text("a\n")
    with pytest.raises(ValueError, match="became shorter"):
        next(found)


def free_port():
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]


def test_datagrams_are_rows_until_an_empty_one():
    port, found = free_port(), []
    thread = threading.Thread(target=lambda: found.extend(lines_from(f"udp:{port}", io.StringIO(), 5.0)))
    thread.start()
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
        for _ in range(100):  # until it listens
            sender.sendto(b"[0]", ("127.0.0.1", port))
            time.sleep(0.01)
            if found:
                break
        sender.sendto(b"[1]\n[2]\n", ("127.0.0.1", port))
        sender.sendto(b"", ("127.0.0.1", port))
    thread.join(5)
    assert found[-2:] == ["[1]", "[2]"]
    assert set(found[:-2]) == {"[0]"}


@pytest.mark.parametrize(
    ("source", "message"),
    [
        ("udp:0.0.0.0:9870", "a port of this machine, as in udp:9870"),
        ("udp:99999", "port must be a whole number"),
        ("serial:tty", "known: -, tail:FILE, udp:PORT"),
    ],
)
def test_a_source_that_makes_no_sense_is_refused(source, message):
    with pytest.raises(ValueError, match=message):
        list(lines_from(source, io.StringIO(), 1.0))
    assert is_live(source) == source.startswith("udp")


@pytest.fixture(scope="module")
def monitor():
    episode = partial(swing, SPEC)
    made = make_monitor("kalman", SPEC, seed=0).fit([episode(n) for n in range(12)])
    return made.calibrate([episode(100 + n) for n in range(19)], 0.05), episode


def watched(lines, monitor):
    said = io.StringIO()
    return follow(lines, monitor, Console(file=said)), said.getvalue()


def test_a_source_that_dies_and_rows_that_are_lost_are_alarms(monitor):
    asm, episode = monitor
    rows = episode(500).stream[:30]

    def dying():
        yield from csv_lines(rows=rows)
        raise SourceDied("nothing came for 2 s")

    code, said = watched(dying(), asm)
    assert code == 1
    assert "0.600 s  the source has died, nothing came for 2 s: an alarm" in said
    assert "30 rows, 1 alarm;" in said
    kept = np.delete(np.arange(30), [12, 13])
    code, said = watched(csv_lines(0.02 * kept, rows[kept]), asm)
    assert code == 1
    assert "0.260 s  2 rows lost: an alarm" in said
    assert said.splitlines()[-1].startswith("30 rows, ")


def test_a_knock_that_excuses_surprise_is_said_once_and_is_no_alarm(monitor, monkeypatch):
    asm, episode = monitor
    observe, count = asm.observe, itertools.count()

    def knocked(state, rows):
        state, surprise = observe(state, rows)
        felt = 5 <= next(count) - 1 < 9  # the first call compiles
        kind = np.array([EVENTS.index(KNOCK) * felt], np.int8)
        return state, surprise._replace(raw=surprise.value + 2 * asm.threshold * felt, excuse=kind)

    monkeypatch.setattr(asm, "observe", knocked)
    code, said = watched(csv_lines(rows=episode(501).stream[:30]), asm)
    assert code == 0
    assert said.count("knock") == 1
    assert "0.120 s  knock: no alarm" in said
    trace = ScoredEpisode("log", 0, 0.1, 1.0, np.zeros(6), excused={KNOCK: np.array([0, 2, 2, 0, 2, 0.5])})
    assert excused_in(trace) == {KNOCK: 2}


def test_rows_are_watched_in_constant_memory(monitor, monkeypatch):
    monkeypatch.setattr("asm_gym.scripts.live_watching.LATENCIES", 100)
    asm, episode = monitor
    line = json.dumps(episode(500).stream[20].tolist())
    peaks = []
    for rows in (400, 2000):
        tracemalloc.start()
        watched((line for _ in range(rows)), asm)
        peaks.append(tracemalloc.get_traced_memory()[1])
        tracemalloc.stop()
    assert peaks[1] < peaks[0] + 20_000  # 1600 rows more, of 60 bytes as text alone


def test_a_pipe_is_watched_as_a_command(monitor, tmp_path, monkeypatch, capsys):
    asm, episode = monitor
    asm.save(tmp_path / "x.asm")
    reader, writer = os.pipe()
    os.write(writer, "\n".join(csv_lines(rows=episode(500).stream)).encode())
    os.close(writer)
    with os.fdopen(reader) as stdin:
        monkeypatch.setattr("sys.stdin", stdin)
        assert main(["watch", "-", "--monitor", str(tmp_path / "x.asm")]) == 0
    assert "80 rows, 0 alarms; a row took" in capsys.readouterr().out
    (tmp_path / "log.csv").write_text("\n".join(csv_lines(rows=episode(500).stream)) + "\n")
    live = ["watch", f"tail:{tmp_path / 'log.csv'}", "--monitor", str(tmp_path / "x.asm"), "--silence", "0.1"]
    assert main(live) == 1
    assert "the source has died" in capsys.readouterr().out
