"""``asm-gym benchmark fleet``: one process that watches many robots, whose rows come through a socket."""

from __future__ import annotations

import asyncio
import socket
import time
from dataclasses import dataclass
from multiprocessing import get_context
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rich.console import Console

from asm_gym.evaluation.tables import ConsoleTable, Table
from asm_gym.monitors import NeuralASM
from asm_gym.scripts.benchmark.turns import machine
from asm_gym.scripts.command import BAD_NEWS, DONE
from asm_gym.validation import check_number

ROOM = 4096
"""Datagrams that are kept until they are judged."""

TICK_S = 1e-3
"""So often they are read [s]: a socket seldom has room for more than a few hundred."""

WARM_UP_S = 1.0
"""What comes before does not count [s]."""


class Fleet:
    """Streams that one memory watches, of which some have a row at a time.

    Args:
        memory: calibrated.
        streams: how many.
    """

    def __init__(self, memory: NeuralASM, streams: int) -> None:
        self._memory, self._streams = memory, streams
        self._state = _some(memory.initial_state(streams), np.arange(streams))  # of which no two parts are one array

    def observe(self, streams: NDArray[np.int64], rows: NDArray[np.floating[Any]]) -> NDArray[np.float64]:
        """The surprise (N,) at rows (N, D), each the next of its stream (N,), in the order in which they came."""
        found = np.empty(len(rows))
        order = np.argsort(streams, kind="stable")
        begins = np.flatnonzero(np.diff(streams[order], prepend=-1))
        turn = np.arange(len(order)) - np.repeat(begins, np.diff(begins, append=len(order)))
        for k in range(int(turn.max(initial=-1)) + 1):  # of each stream one row at a time
            now = order[turn == k]
            if len(now) == self._streams:  # all of them, in their order
                self._state, surprise = self._memory.observe(self._state, rows[now])
                found[now] = surprise.value
                continue
            state, surprise = self._memory.observe(_some(self._state, streams[now]), rows[now])
            _put(self._state, streams[now], state)
            found[now] = surprise.value
        return found


def _some(state: Any, streams: NDArray[np.int64]) -> Any:
    """The state of some streams."""
    if isinstance(state, tuple):
        parts = [_some(part, streams) for part in state]
        return type(state)(*parts) if hasattr(state, "_fields") else tuple(parts)
    return state[streams]


def _put(state: Any, streams: NDArray[np.int64], new: Any) -> None:
    """Writes the state of some streams; nobody else has this one."""
    if isinstance(state, tuple):
        for old, part in zip(state, new, strict=True):
            _put(old, streams, part)
    else:
        state[streams] = new


class Inbox:
    """Rows as they come: datagrams of a stream's number, when it was sent [s], and the row.

    Args:
        size: D.
    """

    def __init__(self, size: int) -> None:
        self.kind = np.dtype([("stream", "<i8"), ("sent", "<f8"), ("row", "<f4", (size,))])
        self.socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 1 << 24)
        self.socket.bind(("127.0.0.1", 0))
        self.socket.setblocking(False)
        self._buffers = [bytearray(self.kind.itemsize) for _ in range(ROOM)]
        self._came = 0

    def drain(self) -> None:
        """Takes in what has come, as far as there is room; the socket keeps the rest."""
        try:
            while self._came < ROOM:
                self.socket.recv_into(self._buffers[self._came])
                self._came += 1
        except BlockingIOError:
            return

    def taken(self) -> NDArray[Any]:
        """What has come, which is forgotten here."""
        rows = np.frombuffer(b"".join(self._buffers[: self._came]), self.kind)
        self._came = 0
        return rows


async def watch(fleet: Fleet, inbox: Inbox, period: float, seconds: float) -> NDArray[np.float64]:
    """(N,) how long after it was sent each row was judged [s], of those after the first second.

    The compiled call runs beside the loop, which reads on meanwhile.
    """
    loop, late = asyncio.get_running_loop(), []
    start = time.time()
    while time.time() < start + seconds:
        due = asyncio.create_task(asyncio.sleep(period))
        inbox.drain()
        rows = inbox.taken()
        judged = loop.run_in_executor(None, fleet.observe, rows["stream"], rows["row"])
        while not (judged.done() and due.done()):
            await asyncio.wait((due, judged), timeout=TICK_S, return_when=asyncio.ALL_COMPLETED)
            inbox.drain()
        late.append((time.time() - rows["sent"])[rows["sent"] > start + WARM_UP_S])
    return np.concatenate(late)


def send(port: int, rows: NDArray[Any], rate: float, seconds: float) -> None:
    """Sends each of the rows (B,) again and again, ``rate`` times a second, evenly spread."""
    out = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    out.connect(("127.0.0.1", port))
    each, start, sent = 1.0 / (rate * len(rows)), time.time(), 0
    while (now := time.time()) < start + seconds:
        for n in range(sent, int((now - start) / each)):
            rows[n % len(rows)]["sent"] = time.time()
            rows[n % len(rows)]["row"][0] += np.float32(1e-4) * (n % 7 - 3)
            try:
                out.send(rows[n % len(rows)].tobytes())
            except ConnectionRefusedError:
                return
            sent = n + 1
        time.sleep(5e-4)


@dataclass
class Robots:
    """One process that watches many robots, whose rows come through a socket: how late they are judged."""

    streams: tuple[int, ...] = (1000, 100)
    """How many robots."""
    rates: tuple[float, ...] = (20.0, 1000.0)
    """Rows of each a second [Hz], one for each of these."""
    seconds: float = 5.0
    """For how long; the first second does not count."""
    memory: str = "panda"
    """Name of the shipped memory that watches them all."""

    def __post_init__(self) -> None:
        check_number("seconds", self.seconds, above=WARM_UP_S)
        if len(self.streams) != len(self.rates):
            raise ValueError(f"{len(self.streams)} fleets need as many rates, got {len(self.rates)}")
        for streams, rate in zip(self.streams, self.rates, strict=True):
            check_number("streams", streams, low=1, whole=True)
            check_number("rates", rate, above=0.0)

    def run(self, console: Console) -> int:
        """Prints the table; 1 where rows were lost, or one in a hundred was judged later than three of its periods."""
        memory, rows, kept = NeuralASM.pretrained(self.memory), [], True
        wall, own = time.perf_counter(), time.process_time()
        for streams, rate in zip(self.streams, self.rates, strict=True):
            busy = time.process_time()
            late = self._late(memory, streams, rate)
            busy = (time.process_time() - busy) / self.seconds
            wanted = streams * rate * (self.seconds - WARM_UP_S)
            share = min(1.0, len(late) / wanted)
            p50, p99, most = (1e3 * q for q in np.quantile(late, (0.5, 0.99, 0.999))) if len(late) else (np.inf,) * 3
            kept &= share > 0.99 and p99 < 3e3 / rate
            numbers = f"{100 * share:.1f} %", f"{p50:.1f}", f"{p99:.1f}", f"{most:.1f}", f"{busy:.2f}"
            rows.append((f"{streams} at {rate:g} Hz", *numbers))
        names = "robots", "rows judged", "p50 ms", "p99 ms", "p99.9 ms", "cores"
        console.print(ConsoleTable(Table(f"{memory.spec.size} numbers a row, from sent to judged", names, rows)))
        console.print(machine((time.process_time() - own) / (time.perf_counter() - wall)))
        return DONE if kept else BAD_NEWS

    def _late(self, memory: NeuralASM, streams: int, rate: float) -> NDArray[np.float64]:
        inbox, fleet = Inbox(memory.spec.size), Fleet(memory, streams)
        rows = np.zeros(streams, inbox.kind)
        rows["stream"], rows["row"] = np.arange(streams), memory.senses_.mean
        fleet.observe(rows["stream"], rows["row"])
        port = inbox.socket.getsockname()[1]
        robots = get_context("spawn").Process(target=send, args=(port, rows, rate, 3600.0), daemon=True)
        robots.start()
        try:
            while not len(inbox.taken()):  # they take a while to start
                inbox.drain()
                time.sleep(0.01)
            return asyncio.run(watch(fleet, inbox, min(0.05, 1.0 / rate), self.seconds))
        finally:
            robots.terminate()
            robots.join()
            inbox.socket.close()
