"""A UR controller's stream, from one of the tests in another thread that speaks the protocol byte by byte."""

from __future__ import annotations

import io
import json
import socket
import struct
import threading
from collections.abc import Callable

import numpy as np
import pytest
from rich.console import Console

from asm_gym.data.live import SourceDied, lines_from
from asm_gym.data.rtde import rtde_lines
from asm_gym.episode import Episode
from asm_gym.monitors import make_monitor
from asm_gym.scripts import watch

RATE = 125.0
KINDS = {"timestamp": "DOUBLE", "actual_q": "VECTOR6D", "actual_current": "VECTOR6D", "robot_mode": "INT32"}


def package(kind: str, body: bytes) -> bytes:
    return struct.pack(">HB", 3 + len(body), ord(kind)) + body


class Controller(threading.Thread):
    """Answers one client as the guide says, sends rows, and closes or falls silent."""

    def __init__(self, rows: np.ndarray, end: str = "close", version: bytes = b"\x01") -> None:
        super().__init__(daemon=True)
        self.rows, self.end, self.version = rows, end, version
        self.listening = socket.create_server(("127.0.0.1", 0))
        self.place = f"127.0.0.1:{self.listening.getsockname()[1]}"
        self.asked: list[str] = []
        self.frequency = 0.0
        self.quit = threading.Event()

    def run(self) -> None:
        there, _ = self.listening.accept()
        with there, self.listening:
            assert self.read(there) == ("V", struct.pack(">H", 2))
            there.sendall(package("V", self.version))
            if self.version != b"\x01":
                return
            kind, body = self.read(there)
            assert kind == "O"
            (self.frequency,) = struct.unpack_from(">d", body)
            self.asked = body[8:].decode().split(",")
            there.sendall(package("M", b"\x05hello"))  # says something in words, as they do
            types = ",".join(KINDS.get(name, "NOT_FOUND") for name in self.asked)
            there.sendall(package("O", b"\x01" + types.encode()))
            if "NOT_FOUND" in types:
                return
            assert self.read(there)[0] == "S"
            there.sendall(package("S", b"\x01"))
            stream = b"".join(
                package("U", b"\x01" + struct.pack(">13d", k / RATE, *row)) for k, row in enumerate(self.rows)
            )
            for n in range(0, len(stream), 777):  # packages are cut anywhere
                there.sendall(stream[n : n + 777])
            if self.end == "silence":
                self.quit.wait(20)

    @staticmethod
    def read(there: socket.socket) -> tuple[str, bytes]:
        head = there.recv(3, socket.MSG_WAITALL)
        length, kind = struct.unpack(">HB", head)
        return chr(kind), there.recv(length - 3, socket.MSG_WAITALL) if length > 3 else b""


@pytest.fixture
def controller():
    made: list[Controller] = []

    def start(*args: object, **options: object) -> Controller:
        made.append(Controller(*args, **options))  # type: ignore[arg-type]
        made[-1].start()
        return made[-1]

    yield start
    for one in made:
        one.quit.set()
        one.join(5)


def arm(seed: int, rows: int = 150) -> np.ndarray:
    """(T, 12) six angles and currents."""
    rng = np.random.default_rng(seed)
    q = np.sin(np.outer(np.arange(rows) / RATE, np.arange(1, 7)) + rng.uniform(0, 6, 6))
    return np.hstack([q + 1e-3 * rng.normal(size=q.shape), np.cos(q) + 0.01 * rng.normal(size=q.shape)])


def episode(rows: np.ndarray) -> Episode:
    return Episode.from_table({"actual_q": rows[:, :6], "actual_current": rows[:, 6:]}, rate=RATE, success=True)


Start = Callable[..., Controller]


def test_nothing_but_outputs_is_asked_for(controller: Start):
    rows = arm(0)
    there = controller(rows)
    with pytest.raises(TimeoutError, match="the controller closed the connection"):
        list(rtde_lines(there.place, ["actual_q", "actual_current"], RATE, 2.0))
    assert there.asked == ["timestamp", "actual_q", "actual_current"]
    assert there.frequency == RATE


def test_every_number_is_read_whatever_the_cuts(controller: Start):
    rows = arm(0)
    there, found = controller(rows), list[dict[str, object]]()
    lines = rtde_lines(there.place, ["actual_q", "actual_current"], RATE, 2.0)
    for _ in rows:
        found.append(json.loads(next(lines)))
    np.testing.assert_array_equal([r["actual_q"] for r in found], rows[:, :6])
    np.testing.assert_array_equal([r["actual_current"] for r in found], rows[:, 6:])
    np.testing.assert_allclose([r["timestamp"] for r in found], np.arange(len(rows)) / RATE)


def test_a_memory_watches_a_controller_and_alarms_within_two_rows_of_a_fault(controller: Start):
    spec = episode(arm(0)).spec
    monitor = make_monitor("kalman", spec).fit([episode(arm(n)) for n in range(20)])
    monitor.calibrate([episode(arm(n)) for n in range(20, 60)], 0.05)
    faulty = arm(100)
    faulty[100:, 2] += 0.3
    there, said = controller(faulty), io.StringIO()
    lines = lines_from(f"rtde:{there.place}", io.StringIO(), 1.0, spec)
    assert watch.follow(lines, monitor, Console(file=said, width=200)) == 1
    first, *_, died, summary = said.getvalue().strip().splitlines()
    assert 101 / RATE <= float(first.split()[0]) <= 103 / RATE
    assert "the source has died, the controller closed the connection" in died
    assert summary.startswith("150 rows")


def test_a_controller_that_falls_silent_has_died(controller: Start):
    there = controller(arm(0, 20), end="silence")
    lines = lines_from(f"rtde:{there.place}", io.StringIO(), 0.3, episode(arm(0)).spec)
    with pytest.raises(SourceDied, match=r"timed out|nothing came"):
        assert len(list(lines)) == 0


def test_what_is_no_such_controller_is_one_line(controller: Start):
    with pytest.raises(ValueError, match="has no such output: wishes"):
        next(rtde_lines(controller(arm(0)).place, ["wishes"], RATE, 1.0))
    with pytest.raises(ValueError, match="does not speak version 2 of RTDE"):
        next(rtde_lines(controller(arm(0), version=b"\x00").place, ["actual_q"], RATE, 1.0))
    with pytest.raises(ValueError, match="rtde takes a controller"):
        next(rtde_lines("", ["actual_q"], RATE, 1.0))
    with socket.create_server(("127.0.0.1", 0)) as taken:
        place = f"127.0.0.1:{taken.getsockname()[1]}"
    with pytest.raises(OSError, match="refused"):
        next(rtde_lines(place, ["actual_q"], RATE, 1.0))
