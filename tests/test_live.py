"""Rows as they come: sources that are followed, lines that are read, their rate, and short gaps."""

from __future__ import annotations

import io
import json
import os
import re
import socket
import threading
import time
from pathlib import Path

import numpy as np
import pytest

from asm_gym.data import live_sources
from asm_gym.data.alarm_reasons import blamed, reason
from asm_gym.data.bridging import Bridge, bridged, filled
from asm_gym.data.live_clock import NEWEST, Pace
from asm_gym.data.live_rows import RowReader
from asm_gym.data.live_sources import SourceDied, live_source, record
from asm_gym.data.logs import read_logs
from asm_gym.data.publishers import Publishers
from asm_gym.data.schema import LogSchema
from asm_gym.data.schema_inference import SchemaHints
from asm_gym.spec import MOTOR, Channel, StreamSpec


def lines_from(*source):
    """Lines of a source without the empty ones, which say that time goes on."""
    return filter(str.strip, live_sources.lines_from(*source))


SPEC = StreamSpec(
    (Channel("q", 2, "rad"), Channel("torque", 1), Channel("cmd", 1, group=MOTOR)), dt=0.02
)
ROWS = np.arange(40.0).reshape(10, 4)


def csv_lines(times=None, rows=ROWS, header="time [s],cmd,q_0 [rad],q_1 [rad],note,torque"):
    times = 0.02 * np.arange(len(rows)) if times is None else times
    return [
        header,
        *(f"{t:.3f},{r[3]},{r[0]},{r[1]},fine,{r[2]}" for t, r in zip(times, rows, strict=True)),
    ]


def read(lines):
    return [
        (row.numbers.tolist(), row.lost)
        for row, _ in RowReader(LogSchema.of_spec(SPEC)).rows(lines)
    ]


def problems(lines):
    return [row.problem for row, _ in RowReader(LogSchema.of_spec(SPEC)).rows(lines)]


def test_csv_is_read_by_its_header_in_whatever_order():
    assert read(csv_lines()) == [(row.tolist(), 0) for row in ROWS]
    assert read([json.dumps(row.tolist()) for row in ROWS]) == [(row.tolist(), 0) for row in ROWS]


def test_rows_that_are_missing_by_their_time_are_counted():
    kept = [0, 1, 2, 5, 6]
    assert [lost for _, lost in read(csv_lines(0.02 * np.array(kept), ROWS[kept]))] == [
        0,
        0,
        0,
        2,
        0,
    ]
    named = [{"t": 0.02 * k, "q": [1, 2], "torque": 3, "cmd": 4} for k in (0, 4)]
    assert [lost for _, lost in read(map(json.dumps, named))] == [0, 3]


def test_the_clock_that_is_asked_for_is_read():
    row = {"time": 0, "q": [1, 2], "torque": 3, "cmd": 4}  # the first clock stands still
    lines = [json.dumps(row | {"tick": 20 * k}) for k in (0, 1, 4)]
    rows = [row for row, _ in RowReader(LogSchema.of_spec(SPEC), "tick [ms]").rows(lines)]
    assert [(row.lost, row.problem) for row in rows] == [(0, ""), (0, ""), (2, "")]


def test_nested_json_and_units_are_read_as_from_a_file():
    spec = StreamSpec((Channel("arm.q", 2, "rad"), Channel("current", 1, "A")), dt=0.02)
    lines = [
        '{"arm": {"q [deg]": [180, 90]}, "current [mA]": 500}',
        '{"arm": {"q [deg]": [0, null]}, "current [mA]": 1}',
    ]
    first, second = (row.numbers for row, _ in RowReader(LogSchema.of_spec(spec)).rows(lines))
    np.testing.assert_allclose(first, [np.pi, np.pi / 2, 0.5])
    np.testing.assert_allclose(second, [0.0, np.nan, 0.001])


@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig", "cp1252"])
@pytest.mark.filterwarnings("ignore:.*Windows-1252")
def test_text_of_any_encoding_is_read_as_from_a_file(encoding, tmp_path):
    path = tmp_path / "x.csv"
    rows = [f"{k / 50:.2f};{90 * np.sin(k / 9):.3f};{k % 7}".replace(".", ",") for k in range(60)]
    path.write_bytes("\n".join(["Zeit [s];Achse 1 [°];Öl", *rows, ""]).encode(encoding))
    ((_, episode),) = read_logs(path, SchemaHints(clock="Zeit"))
    followed = lines_from(f"tail:{path}", io.StringIO(), 1.0)
    lines = [line for _, line in zip(range(61), followed, strict=False)]
    live = [
        row.numbers for row, _ in RowReader(LogSchema.of_spec(episode.spec), "Zeit").rows(lines)
    ]
    assert episode.spec.labels == ("Achse 1", "Öl")
    np.testing.assert_allclose(live, episode.stream, rtol=1e-6)


@pytest.mark.parametrize("as_json", [True, False])
def test_a_row_of_each_joint_makes_one_of_all_in_any_order_and_one_that_was_lost_lacks_its_numbers(
    as_json,
):
    spec = StreamSpec((Channel("position", 2, "rad", elements=("elbow", "lift")),), dt=0.02)
    rows = [
        (k, joint, k + 10 * (joint == "lift"))
        for k in range(5)
        for joint in ("elbow", "lift")[:: (-1) ** k]
    ]
    del rows[5]  # the lift's of the third moment
    lines = [json.dumps({"time": 0.02 * k, "joint": j, "position [rad]": x}) for k, j, x in rows]
    lines = (
        lines
        if as_json
        else ["time,joint,position [rad]", *(f"{0.02 * k},{j},{x}" for k, j, x in rows)]
    )
    read = [row for row, _ in RowReader(LogSchema.of_spec(spec)).rows(lines)]
    np.testing.assert_array_equal(
        [r.numbers for r in read], [[0, 10], [1, 11], [2, np.nan], [3, 13], [4, 14]]
    )
    assert not any(row.lost or row.problem for row in read)


def test_equal_columns_of_one_name_are_read_as_one_as_in_a_file():
    row = [0.5, 1.5, 3, 4]
    header = "q_0,q_1,torque,cmd,q_1"
    assert read([header, "0.5,1.5,3,4,1.5", header, "0.5,1.5,3,4,1.5"]) == [(row, 0), (row, 0)]


@pytest.mark.parametrize("finger_first", [True, False])
def test_publishers_of_other_joints_make_one_row_and_one_that_lacks_a_number_lacks_it(finger_first):
    spec = StreamSpec(
        (Channel("position", 3, "rad", elements=("elbow", "lift", "finger")),), dt=0.01
    )

    def said(k, **joints):
        return json.dumps(
            {"time": 0.01 * k, "name": list(joints), "position": list(joints.values())}
        )

    lines = [said(0, finger=-1)] if finger_first else []
    for k in range(20):
        lines.append(said(k, lift=k + 100, elbow=k))
        lines += (
            [said(k + 0.5, finger=k), json.dumps({"time": 0.01 * k, "battery": 12.0})]
            if k % 4 == 0
            else []
        )
    lines.insert(-1, said(18.5, elbow=18))  # without its lift
    read = [row for row, _ in RowReader(LogSchema.of_spec(spec)).rows(lines)]
    first = 0 if finger_first else 1
    wanted = [[k, k + 100, (k - 1) // 4 * 4 if k else -1] for k in range(first, 19)]
    np.testing.assert_array_equal(
        [r.numbers for r in read], [*wanted, [18, np.nan, 16], [19, 119, 16]]
    )
    assert not any(row.problem for row in read)


def test_a_publisher_that_falls_silent_leaves_its_numbers_missing_and_another_one_leads():
    arm, finger = {"q": 1, "v": 2}, {"f": 3}
    publishers = Publishers(silence=0.5)
    assert publishers.row(arm, arm, 0.0) == arm
    assert publishers.row(finger, finger, 0.1) is None
    assert publishers.row(arm, arm, 0.5) == arm | finger
    assert publishers.row(arm, arm, 0.7) == arm
    assert publishers.row(finger, finger, 1.3) == finger


@pytest.mark.parametrize(
    ("lines", "message"),
    [
        (
            ["time,q_0,q_1,torque", "1,2,3,4"],
            "line 1 is another robot's header: the memory reads channels that are not there: cmd",
        ),
        (
            [*csv_lines()[:2], "time,a,b"],
            "line 3 is another robot's header: .* not there: .*q.*; there are.*: a, b",
        ),
        (
            ["nothing but words"],
            "line 1 is no row of numbers, and no header",
        ),
        (
            ["q_0,q_0,q_1,torque,cmd", "1,1,3,4,5", "1,2,3,4,5"],
            "line 3 .* columns of the same name differ: 'q_0'",
        ),
        (
            ["[1, 2]"],
            r"line 1 is no row of numbers.*: it must hold 4 numbers, got the shape \(2,\)",
        ),
        (["{"], "line 1 is no row of numbers"),
        (
            ['{"q": [1, 2]}'],
            "line 1 is no row of numbers.*: the memory reads channels that are not there: torque, cmd",
        ),
        (['{"q": [1, 2, 3], "torque": 1, "cmd": 1}'], "q must hold 2 numbers, got 3"),
        (
            [*csv_lines()[:2], "0.1,1,2"],
            "line 3 is no row of numbers: it has 3 cells, its header 6",
        ),
        ([*csv_lines()[:2], "0.1,1,2,x,fine,3"], "line 3 is no row of numbers"),
        ([*csv_lines()[:3], csv_lines()[1]], r"time must increase, got 0 s after 0\.02"),
    ],
)
def test_a_line_that_is_no_row_is_named_and_the_next_one_is_read(lines, message):
    assert re.search(message, "\n".join(problems(lines)))
    if lines[0].startswith(("[", "{")):
        (*_, row) = read([*lines, "[1, 2, 3, 4]"])
        assert row == ([1, 2, 3, 4], 0)


def test_whatever_a_line_holds_reading_goes_on():
    good, depth = json.dumps(ROWS[0].tolist()), 100_000
    bad = [
        "garbage",
        "[1, 2, 3",
        "[1]",
        "[]",
        "5",
        "null",
        '"x"',
        "{}",
        "[" * depth,
        '{"q":' * depth,
        "[1e999, {}, 3, 4]",
    ]
    bad += [
        "[" + "9" * 400 + ", 2, 3, 4]",
        "[" + "9" * 9000 + ", 2, 3, 4]",
        "\ufffd\x00",
        "a line of more than 5 bytes",
    ]
    rows = [
        row
        for row, _ in RowReader(LogSchema.of_spec(SPEC)).rows(
            [bad[0], good, *(line for b in bad for line in (b, good))]
        )
    ]
    assert [bool(row.problem) for row in rows] == [True, False] + len(bad) * [True, False]
    assert all(row.numbers.tolist() == ROWS[0].tolist() for row in rows if not row.problem)


def stamped(*stamps):
    named = ({"t": t, "q": [1, 2], "torque": 3, "cmd": 4} for t in stamps)
    return [row for row, _ in RowReader(LogSchema.of_spec(SPEC)).rows(map(json.dumps, named))]


@pytest.mark.parametrize("stamp", [-1.0, 0.0, 0.02, 1e18, 1e300, "NaN", "soon"])
def test_one_row_that_comes_late_or_from_another_clock_is_left_out(stamp):
    rows = stamped(0, 0.02, stamp, 0.04, 0.06)
    assert [row.read for row in rows] == [True, True, False, True, True]
    assert [bool(row.problem) for row in rows] == [False, False, True, False, False]
    assert [row.lost for row in rows if row.read] == [0] * 4


@pytest.mark.parametrize("start", [-1.0, 1e9])
def test_a_clock_that_is_set_anew_begins_anew(start):
    rows = stamped(0, 0.02, start, start + 0.02, start + 0.04)
    assert [row.read for row in rows] == [True, True, False, True, True]
    assert [bool(row.problem) for row in rows] == [False, False, True, True, False]


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


class Datagrams:
    """Lines of a source that follows datagrams, gathered in a thread, and senders to it."""

    def __init__(self, port: int, sender: str = "", silence: float = 0.5) -> None:
        self.port, self.found, self.died = port, list[str](), ""
        self.thread = threading.Thread(target=self._gather, args=(f"udp:{port}{sender}", silence))
        self.thread.start()

    def _gather(self, source: str, silence: float) -> None:
        try:
            self.found.extend(lines_from(source, io.StringIO(), silence, 5.0))
        except SourceDied as error:
            self.died = str(error)

    def send(self, sender: socket.socket, *datagrams: bytes) -> None:
        for datagram in datagrams:
            sender.sendto(datagram, ("127.0.0.1", self.port))

    def heard(self, sender: socket.socket) -> None:
        """Send until it listens."""
        while not self.found and self.thread.is_alive():
            self.send(sender, b"[0]")
            time.sleep(0.01)


def test_datagrams_are_lines_whatever_they_hold_until_none_come():
    source = Datagrams(free_port())
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
        source.heard(sender)
        source.send(sender, b"[1]\n[2]\n", b"", b"\xff\xfe\x00", b"x" * 60_000, b"[3]")
    source.thread.join(5)
    lines = [line for line in source.found if line != "[0]"]
    assert [lines[0], lines[1], lines[-1], len(lines)] == ["[1]", "[2]", "[3]", 6]
    assert source.died


def test_only_the_sender_that_is_named_is_believed():
    with (
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as one,
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as other,
    ):
        one.bind(("127.0.0.1", 0))
        source = Datagrams(free_port(), f"@127.0.0.1:{one.getsockname()[1]}")
        source.heard(one)
        source.send(other, b"[7]", b"")
        source.send(one, b"[1]")
        source.thread.join(5)
    assert set(source.found) == {"[0]", "[1]"}


@pytest.mark.parametrize("source", ["-", "tail", "udp"])
def test_a_source_that_sends_no_line_has_died_as_soon_as_the_first_is_due(source, tmp_path):
    (tmp_path / "log").touch()
    reader, writer = os.pipe()
    with os.fdopen(reader) as stdin:
        name = {"tail": f"tail:{tmp_path / 'log'}", "udp": f"udp:{free_port()}"}.get(source, source)
        with pytest.raises(SourceDied, match=r"nothing came for 0\.1 s"):
            next(lines_from(name, stdin, 9.0, 0.1))
    os.close(writer)


@pytest.mark.parametrize(
    ("source", "message"),
    [
        ("udp:0.0.0.0:9870", "a port of this machine, as in udp:9870"),
        ("udp:99999", "port must be a whole number"),
        ("udp:9870@", "or udp:9870@127.0.0.1:5005"),
        ("udp:9870@127.0.0.1:x", "or udp:9870@127.0.0.1:5005"),
        ("udp:9870@robot", "robot"),
        ("serial:tty", "known: -, tail:FILE, udp:PORT"),
    ],
)
def test_a_source_that_makes_no_sense_is_refused(source, message):
    with pytest.raises(ValueError, match=message):
        list(lines_from(source, io.StringIO(), 1.0))
    assert (live_source(source) is not None) == source.startswith("udp")


def paced(stamps: np.ndarray, dt: float = 0.02) -> tuple[list[int | None], Pace]:
    pace = Pace(dt)
    return [pace.rows_lost_before(float(t)) for t in stamps], pace


def test_every_row_of_its_own_rate_is_read_however_it_jitters():
    rng = np.random.default_rng(0)
    stamps = 0.02 * (np.arange(500) + rng.uniform(-0.2, 0.2, 500))
    assert paced(stamps)[0] == [0] * 500
    kept = np.delete(0.02 * np.arange(100), [50, 51])
    assert [n for n in paced(kept)[0] if n] == [2]


@pytest.mark.parametrize("step", [0.005, 0.05])
def test_of_another_rate_nothing_is_judged_until_it_is_right_again(step):
    other = step * np.arange(100)
    found, pace = paced([*other, *(other[-1] + 0.02 * np.arange(1, 100))])
    assert pace.is_right
    assert found[NEWEST:100] == [None] * (100 - NEWEST)
    assert found[-30:] == [0] * 30


def test_a_bridge_goes_over_short_gaps_and_no_longer_or_frequent_ones():
    missing = np.zeros((200, 1))
    missing[[10, 11, 100, 101, 102]] = np.nan
    assert np.flatnonzero(bridged(missing, 0.02, 0.04)).tolist() == [10, 11, 100, 101]
    assert not bridged(missing, 0.02, 0.0).any()
    loose = np.where(np.arange(400) % 3 == 0, np.nan, 0.0)[:, None]  # a third of all rows
    assert 0 < np.flatnonzero(np.isnan(loose[:, 0]) & ~bridged(loose, 0.02, 0.04))[0] < 10
    rare = np.where(np.arange(400) % 100 == 5, np.nan, 0.0)[:, None]
    np.testing.assert_array_equal(bridged(rare, 0.02, 0.02), np.isnan(rare[:, 0]))
    with pytest.raises(ValueError, match="bridge must be"):
        Bridge(-1.0, 0.02, 1)


def test_what_is_learned_from_lies_on_the_line_between_its_neighbours():
    stream = np.arange(12, dtype=np.float32).reshape(6, 2)
    holed = stream.copy()
    holed[2:4, 0] = np.nan
    holed[0, 1] = holed[4:, 1] = np.nan
    out = filled(holed, 0.02, 0.04)
    np.testing.assert_allclose(out[:, 0], stream[:, 0])
    assert np.isnan(out[[0, 4, 5], 1]).all()  # nothing is known beyond the ends
    assert np.isnan(filled(holed, 0.02, 0.02)[2:4, 0]).all()


def test_reasons_and_blame_of_single_rows():
    assert reason(np.array([1.0, np.nan])) == "missing data"
    assert reason(np.array([1.0, np.inf])) == "not finite"
    assert reason(np.array([1.0, 2.0])) == "surprise"
    assert blamed(np.full(2, np.nan), np.zeros(2)) is None
    assert blamed(np.array([1.0, np.nan]), np.zeros(2)) == 1
    assert blamed(np.array([1.0, 2.0]), np.array([3.0, 1.0])) == 0


def test_a_full_disk_is_said_of_the_file_that_it_lacks_room_for():
    with pytest.raises(OSError, match="No space left") as refused:
        record(("[1, 2]\n" for _ in range(100_000)), Path("/dev/full"), 1.0)
    assert refused.value.filename == "/dev/full"
