"""Rows watched as they come: alarms, bridged gaps, lost rows, other rates, and sources that die and come back."""

from __future__ import annotations

import csv
import html
import io
import itertools
import json
import shlex
import socket
import subprocess
import sys
import time
from functools import partial
from importlib.metadata import version

import numpy as np
import pytest

from asm_gym.data.bridging import bridge_of
from asm_gym.data.episode import Episode
from asm_gym.data.live_rows import SourceDied
from asm_gym.data.logs import Log
from asm_gym.detection.alarm_rule import EVENTS, KNOCK
from asm_gym.evaluation.recorded_alarms import alarms_of, excused_in, traces_of
from asm_gym.evaluation.scored_episode import ScoredEpisode
from asm_gym.guard.alarm_outlets import AlarmOutlets, LineWriter
from asm_gym.guard.live_events import LiveEvent
from asm_gym.guard.live_watch import follow
from asm_gym.guard.watch_settings import WatchSettings
from asm_gym.monitors import make_monitor
from asm_gym.scripts.cli import main
from asm_gym.spec import MOTOR, Channel, StreamSpec
from tests.needs import needs
from tests.streams import swing

SPEC = StreamSpec(
    (Channel("q", 2, "rad"), Channel("torque", 1), Channel("cmd", 1, group=MOTOR)), dt=0.02
)
DT = SPEC.dt

episode = partial(swing, SPEC)


@pytest.fixture(scope="module")
def monitor():
    made = make_monitor("kalman", SPEC, seed=0).fit([episode(n) for n in range(12)])
    return made.calibrate([episode(100 + n) for n in range(39)], 0.05)


def lines(rows, stamps=None, dies=False):
    """Rows as JSON lines, at these times, of a source that may die."""
    for t, row in zip(DT * np.arange(len(rows)) if stamps is None else stamps, rows, strict=False):
        line = {
            "time": float(t),
            "q": row[:2].tolist(),
            "torque": float(row[2]),
            "cmd": float(row[3]),
        }
        yield json.dumps(line).replace("NaN", "null")
    if dies:
        raise SourceDied("nothing came for 2 s")


def watched(source, monitor, **settings):
    """The number of alarms, and what was said."""
    events = []
    return follow(source, monitor, events.append, WatchSettings(**settings)), "\n".join(
        map(str, events)
    )


def test_a_source_that_dies_and_rows_that_are_lost_are_alarms(monitor):
    rows = episode(500).stream[:30]
    count, said = watched(lines(rows, dies=True), monitor)
    assert count
    assert "0.580 s  the source has died, nothing came for 2 s: an alarm" in said
    assert "30 rows, 1 alarm;" in said
    kept = np.delete(np.arange(30), [12, 13])
    count, said = watched(lines(rows[kept], DT * kept), monitor)
    assert count
    assert "0.280 s  2 rows lost: an alarm (late)" in said
    assert said.splitlines()[-1].startswith("30 rows, ")
    assert watched(lines(rows[kept], DT * kept), monitor, bridge_s=0.05)[0] == 0


@pytest.mark.parametrize("lost", [1, 2, 3, 30])
def test_up_to_two_lost_rows_are_bridged_and_more_are_one_alarm(lost, monitor):
    kept = np.delete(np.arange(80), np.arange(20, 20 + lost))
    count, said = watched(
        lines(episode(500).stream[kept], DT * kept), monitor, bridge_s=bridge_of(None, DT)
    )
    assert count == (lost > 2)
    assert said.count("(late)") == (lost > 2)


def test_a_port_to_which_nobody_sends_is_watched_no_longer_than_asked(monitor, tmp_path):
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    assert live(monitor, tmp_path, f"udp:{port}", "--wait", "0.3", "--silence", "0.3") == 2


@pytest.mark.parametrize("bad", ["an empty datagram", "[1, 2", "[1]", "[" * 100_000, "\x00\ufffd"])
def test_a_line_that_cannot_be_read_is_an_alarm_and_the_fault_after_it_is_found(bad, monitor):
    rows = list(lines(episode(500).stream[:60]))
    frozen = json.loads(rows[40])["q"]
    after = [json.dumps({**json.loads(row), "q": frozen}) for row in rows[40:]]
    events = []
    assert follow([*rows[:20], bad, *rows[20:40], *after], monitor, events.append) > 1
    alarms = [(event.reason, event.channel) for event in events if event.kind == "alarm"]
    assert alarms[0][0] == "unreadable"
    assert "surprise" in [why for why, _ in alarms[1:]]


def test_a_source_whose_lines_are_no_rows_at_all_is_an_error_unless_others_may_send_to_it(monitor):
    rows = list(lines(episode(500).stream[:10]))
    with pytest.raises(ValueError, match="line 1 is no row of numbers, and no header"):
        watched(["garbage", *rows], monitor)
    count, said = watched(["garbage", *rows], monitor, reopen=lambda first: iter(()), wait_s=0.1)
    assert count == 1
    assert "10 rows" in said
    with pytest.raises(ValueError, match="no row came"):
        watched([], monitor)


def test_the_first_alarm_ends_a_watch_that_is_told_so(monitor):
    rows = list(lines(episode(500).stream))
    source = iter([*rows[:5], "no row", *rows])
    assert watched(source, monitor, until_alarm=True)[0] == 1
    assert next(source) == rows[0]


def test_missing_numbers_are_bridged_or_an_alarm_that_says_why(monitor):
    def alarms(stream, bridge=0.0):
        (trace,) = traces_of([Log("x", Episode.from_stream(stream, SPEC))], monitor, bridge)
        return [(a.why, a.channel) for a in alarms_of(trace)]

    def with_gap(start, rows, column=slice(None), value=np.nan):
        stream = episode(500).stream.copy()
        stream[start : start + rows, column] = value
        return stream

    assert alarms(episode(500).stream) == []
    assert alarms(with_gap(50, 2)) == [("missing data", "")]
    assert alarms(with_gap(50, 2, 1)) == [("missing data", "q[1]")]
    assert alarms(with_gap(50, 2), bridge=0.05) == []
    assert alarms(with_gap(50, 5), bridge=0.05) == [("missing data", "")]
    assert alarms(with_gap(50, 1, 0, np.inf), bridge=0.05) == [("not finite", "q[0]")]
    count, said = watched(lines(with_gap(50, 1, 1)), monitor)
    assert count
    assert "q[1]  inf thresholds" in said
    assert "(missing data)" in said
    assert watched(lines(with_gap(50, 1, 1)), monitor, bridge_s=0.05)[0] == 0


def test_a_knock_that_excuses_surprise_is_said_once_and_is_no_alarm(monitor, monkeypatch):
    asm = monitor
    observe, count = asm.observe, itertools.count()

    def knocked(state, rows):
        state, surprise = observe(state, rows)
        felt = 5 <= next(count) - 1 < 9  # the first call compiles
        kind = np.array([EVENTS.index(KNOCK) * felt], np.int8)
        return state, surprise._replace(raw=surprise.value + 2 * asm.threshold * felt, excuse=kind)

    monkeypatch.setattr(asm, "observe", knocked)
    count, said = watched(lines(episode(501).stream[:30]), asm)
    assert not count
    assert said.count("knock") == 1
    assert "0.100 s  knock: no alarm" in said
    trace = ScoredEpisode(
        "log", 0, 0.1, 1.0, np.zeros(6), excused={KNOCK: np.array([0, 2, 2, 0, 2, 0.5])}
    )
    assert excused_in(trace) == {KNOCK: 2}


def test_a_pipe_and_a_file_are_watched_as_a_command(monitor, tmp_path, monkeypatch, capsys):
    monitor.save(tmp_path / "x.asm")
    text = "\n".join(lines(episode(500).stream)) + "\n"
    monkeypatch.setattr("sys.stdin", io.StringIO(text))
    assert main(["watch", "-", "--monitor", str(tmp_path / "x.asm")]) == 0
    assert "80 rows, 0 alarms; a row took" in capsys.readouterr().out
    (tmp_path / "log.jsonl").write_text(text)
    live = [
        "watch",
        f"tail:{tmp_path / 'log.jsonl'}",
        "--monitor",
        str(tmp_path / "x.asm"),
        "--silence",
        "0.1",
    ]
    assert main(live) == 1
    assert "the source has died" in capsys.readouterr().out


def recording(folder, stream, names=("q[0]", "q[1]", "torque", "cmd"), name="log.csv"):
    rows = [
        ",".join(("time", *names)),
        *(",".join(map(str, (DT * k, *row))) for k, row in enumerate(stream)),
    ]
    (folder / name).write_text("\n".join(rows) + "\n")
    return str(folder / name)


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
@pytest.mark.parametrize("columns", [[1], [0, 1, 2, 3], [3]])
def test_a_channel_that_is_never_finite_is_reported(value, columns, monitor, tmp_path, capsys):
    needs("matplotlib")
    monitor.save(tmp_path / "x.asm")
    stream = episode(500).stream.astype(object)
    stream[:, columns] = value
    out = tmp_path / "out"
    code = main(
        [
            "watch",
            recording(tmp_path, stream),
            "--monitor",
            str(tmp_path / "x.asm"),
            "--out",
            str(out),
        ]
    )
    assert "Axis limits" not in capsys.readouterr().err
    if code != 2:  # a column that says nothing may be refused, in a line of its own
        assert code == 1
        assert (out / "report.html").stat().st_size > 10_000


def test_what_a_watch_writes_stays_in_its_folder_and_holds_no_formula(
    monitor, tmp_path, monkeypatch
):
    needs("matplotlib")
    monitor.save(tmp_path / "x.asm")
    stream = episode(500).stream.copy()
    stream[40:, 0] += 3
    out = tmp_path / "out"
    out.mkdir()
    names = ("alarms.csv", "report.html", "surprise.png", "stream.png")
    for name in names:
        (tmp_path / f"own {name}").write_text("precious")
        (out / name).symlink_to(tmp_path / f"own {name}")
    source = recording(tmp_path, stream, name="@SUM(1).csv")
    command = [
        "watch",
        source,
        "--monitor",
        str(tmp_path / "x.asm"),
        "--out",
        str(out),
    ]
    monkeypatch.setattr("sys.argv", ["asm-gym", *command])
    assert main(command) == 1
    assert {(tmp_path / f"own {name}").read_text() for name in names} == {"precious"}
    with (out / "alarms.csv").open(newline="") as file:
        cells = [cell for row in csv.reader(file) for cell in row]
    assert any("@SUM(1)" in cell for cell in cells)
    assert not any(cell[:1] in ("=", "+", "-", "@", "\t", "\r") for cell in cells if cell)
    report = html.unescape((out / "report.html").read_text())
    assert shlex.join(["asm-gym", *command]) in report
    assert version("asm-gym") in report


def live(monitor, folder, source, *options):
    """What a watch of a source prints and returns."""
    monitor.save(folder / "x.asm")
    return main(["watch", source, "--monitor", str(folder / "x.asm"), *options])


def test_alarms_leave_a_watch_as_json_and_by_a_command(monitor, tmp_path, monkeypatch, capsys):
    rows = list(lines(episode(500).stream[:30]))
    monkeypatch.setattr("sys.stdin", io.StringIO("\n".join([*rows[:10], "no row", *rows[10:]])))
    script = tmp_path / "stop.py"
    script.write_text(f"import sys; open({str(tmp_path / 'heard')!r}, 'a').write(sys.stdin.read())")
    hook = f"{sys.executable} {script}"
    assert live(monitor, tmp_path, "-", "--json", "--hook", hook) == 1
    events = [json.loads(line) for line in capsys.readouterr().out.splitlines()]
    (alarm,) = [event for event in events if event["kind"] == "alarm"]
    assert (alarm["reason"], events[-1]["kind"]) == ("unreadable", "summary")
    until = time.monotonic() + 10
    while not (tmp_path / "heard").exists() or not (tmp_path / "heard").read_text().endswith("\n"):
        assert time.monotonic() < until
        time.sleep(0.05)
    assert json.loads((tmp_path / "heard").read_text()) == alarm


def test_an_infinite_surprise_is_json_too():
    event = LiveEvent(
        "alarm", 1.0, "q[0]  inf thresholds", "missing data", "q[0]", float("inf"), 0.1
    )
    assert json.loads(event.to_json())["thresholds"] == "inf"


def test_what_is_for_a_live_source_is_refused_with_a_recording(monitor, tmp_path, capsys):
    assert live(monitor, tmp_path, str(tmp_path), "--until-alarm") == 2
    assert "--until-alarm is for a live source" in capsys.readouterr().err
    assert live(monitor, tmp_path, "-", "--ignore", "q") == 2
    assert "--ignore is for a recording" in capsys.readouterr().err


def test_alarms_of_one_cause_are_one(monitor):
    rows = episode(500).stream.copy()
    rows[[20, 28, 36, 75], 2] += 100.0  # at 50 Hz: a push, and another one
    events = []
    follow(lines(rows), monitor, events.append)
    (alarm,) = [event for event in events if event.kind == "alarm"]
    assert round(alarm.time / DT) == 21


@pytest.mark.parametrize("rate", [20, 100])
def test_another_rate_is_said_once_and_is_an_alarm(rate, monitor):
    count, said = watched(
        lines(np.resize(episode(500).stream, (200, 4)), np.arange(200) / rate), monitor
    )
    assert count
    assert (
        said.count(f"rows come at {rate} a second, and the memory reads 50: they are not judged")
        == 1
    )


def test_a_source_is_watched_anew_after_its_death_and_after_its_clock_went_back(monitor):
    rows, opened = episode(501).stream[:20], []

    def again(first):
        opened.append(1)
        if len(opened) == 1:
            raise ConnectionRefusedError
        return lines(rows, [5.0, 5.02, 1.0, 1.02] if len(opened) == 2 else None)

    count, said = watched(lines(rows, dies=True), monitor, reopen=again, wait_s=5.0)
    assert count
    assert said.count("the source is back") == 1
    assert "time must increase, got 1.02 s after 5.02 s: an alarm, and a new beginning" in said
    assert "23 rows" in said
    count, said = watched(lines(rows, [5.0, 5.02, 1.0, 1.02]), monitor)
    assert count
    assert "time must increase, got 1.02 s after 5.02 s: an alarm, and a new beginning" in said

    def never(first):
        raise OSError("no")

    said = watched(lines(rows, dies=True), monitor, reopen=never, wait_s=0.3)[1]
    assert "the source did not come back within 0.3 s" in said


# ------------------------------------------------------------------ what must not silence a watch


def junk(kind: str, rows: list[str], good: int):
    """Lines of a source that goes on to send something, but no rows."""
    yield from rows[:good]
    while True:
        time.sleep(0.01)
        yield {"blank": " ", "no line": "", "garbage": "garbage", "other keys": '{"x": 1}'}[kind]


@pytest.mark.parametrize("kind", ["blank", "no line", "garbage", "other keys"])
def test_a_source_without_rows_has_died_whatever_else_it_sends(kind, monitor):
    events = []
    settings = WatchSettings(silence_s=0.3)
    rows = list(lines(episode(500).stream[:20]))
    follow(junk(kind, rows, 20), monitor, events.append, settings)
    died = [event for event in events if event.reason == "source died"]
    assert len(died) == 1
    assert "no row came for 0.3 s" in died[0].text


class Stuck(io.StringIO):
    """A pipe that nobody reads: writing never ends."""

    def write(self, text):
        time.sleep(60)
        return 0


class Closed(io.StringIO):
    """A pipe whose reader has gone."""

    def write(self, text):
        raise BrokenPipeError


def events_of(count):
    return [LiveEvent("alarm", float(k), "an alarm", reason="surprise") for k in range(count)]


@pytest.mark.parametrize("file", [Stuck(), Closed(), None])
def test_every_alarm_reaches_the_hook_though_nobody_reads_standard_output(file, capsys):
    told = []
    outlets = AlarmOutlets([told.append], LineWriter(file), as_json=True)
    start = time.monotonic()
    for event in events_of(2000):
        outlets.say(event)
    assert time.monotonic() - start < 2.0
    outlets.close()
    assert outlets.output_failed
    assert [event.time for event in told if event.reason == "surprise"] == list(range(2000))
    assert [event.reason for event in told].count("output") == 1
    assert "standard output" in capsys.readouterr().err


def test_a_hook_that_fails_stops_neither_the_topic_nor_the_print(capsys):
    told = []
    printed = io.StringIO()
    outlets = AlarmOutlets([lambda event: 1 / 0, told.append], LineWriter(printed), as_json=False)
    for event in events_of(3):
        outlets.say(event)
    outlets.close()
    assert len(told) == 3
    assert len(printed.getvalue().splitlines()) == 3
    assert not outlets.output_failed
    assert "ZeroDivisionError" in capsys.readouterr().err


@pytest.mark.parametrize("reader", ["gone", "asleep"])
def test_a_watch_in_a_pipe_that_nobody_reads_calls_its_hook(reader, monitor, tmp_path):
    """Two faults: standard output fails at the first one, and the second is told all the same."""
    rows = episode(500).stream.copy()
    rows[30, 2] += 100.0
    rows[65, 0] = np.inf
    monitor.save(tmp_path / "m.asm")
    heard = tmp_path / "heard"
    hook = f"cat >> {shlex.quote(str(heard))}"
    command = [sys.executable, "-m", "asm_gym", "watch", "-", "--monitor", str(tmp_path / "m.asm")]
    process = subprocess.Popen(
        [*command, "--hook", hook, "--json"],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    if reader == "gone":
        process.stdout.close()
    for line in lines(rows):
        process.stdin.write(line + "\n")
    process.stdin.close()
    error = process.stderr.read()
    code = process.wait(60)
    said = [json.loads(line) for line in heard.read_text().splitlines()]
    told = [(round(event["time"] / DT), event["reason"]) for event in said]
    assert {(31, "surprise"), (66, "not finite")} <= set(told)
    if reader == "gone":
        assert code == 2
        assert "standard output" in error


def test_a_header_of_a_stray_sender_does_not_make_the_watch_deaf(monitor):
    good = list(lines(episode(500).stream))
    datagrams = {"reopen": lambda first: iter(())}
    count, _ = watched(["a,b,c,d", *good], monitor, **datagrams)
    assert count == 1  # the stray line alone
    header = "time,q[0],q[1],torque,cmd"
    csv_rows = [
        ",".join(map(str, [k * DT, *row])) for k, row in enumerate(episode(500).stream.tolist())
    ]
    count, said = watched(["name,joint", header, *csv_rows], monitor, **datagrams)
    assert f"{len(csv_rows)} rows" in said


def test_a_pipe_of_another_robot_is_refused_by_the_names_that_its_header_lacks(
    monitor, tmp_path, monkeypatch, capsys
):
    monkeypatch.setattr("sys.stdin", io.StringIO("time,q[0],q[1],grip\n0,1,2,3\n"))
    monitor.save(tmp_path / "m.asm")
    assert main(["watch", "-", "--monitor", str(tmp_path / "m.asm")]) == 2
    line = capsys.readouterr().err.splitlines()[-1]
    assert "another robot's header: " in line
    assert "torque, cmd" in line
    assert "grip" in line


@pytest.mark.parametrize(
    "line",
    [
        '{"a": [' + "1, " * 300_000 + "1]}",
        json.dumps({f"key {k}": k for k in range(60_000)}),
        "1," * 400_000 + "1",
    ],
)
def test_a_huge_line_is_an_alarm_at_once(line, monitor):
    good = list(lines(episode(500).stream))
    start = time.perf_counter()
    events = []
    follow([*good[:30], line, *good[30:]], monitor, events.append)
    assert time.perf_counter() - start < 2.0
    assert [event.reason for event in events if event.kind == "alarm"] == ["unreadable"]
