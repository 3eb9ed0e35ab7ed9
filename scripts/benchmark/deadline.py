"""``asm-gym benchmark deadline``: how late rows are judged while all cores are busy with something else."""

from __future__ import annotations

import gc
import os
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, ExitStack, contextmanager
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from rich.console import Console

from asm_gym.evaluation.tables import ConsoleTable, Table
from asm_gym.monitors import NeuralASM
from asm_gym.scripts.benchmark.turns import machine
from asm_gym.scripts.command import DONE
from asm_gym.validation import check_number

BURNS = "import array\na = array.array('d', bytes(1 << 24))\nwhile True: sum(a)"
"""What the others do: they fill their caches with 16 MB of their own."""

FIRST = 1
"""Priority under ``SCHED_FIFO``: before everything that has none."""


@contextmanager
def load() -> Iterator[None]:
    """All cores are busy while the block runs."""
    others = [subprocess.Popen([sys.executable, "-c", BURNS]) for _ in range(os.cpu_count() or 1)]
    try:
        time.sleep(0.5)
        yield
    finally:
        for other in others:
            other.kill()
            other.wait()


@contextmanager
def no_garbage() -> Iterator[None]:
    """What is there is looked at no more, and nothing is collected while the block runs."""
    gc.collect()
    gc.freeze()
    gc.disable()
    try:
        yield
    finally:
        gc.enable()
        gc.unfreeze()


@contextmanager
def first() -> Iterator[None]:
    """This process runs whenever it can. Raises PermissionError where that takes rights that it has not."""
    before = os.sched_getscheduler(0), os.sched_getparam(0)
    os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(FIRST))
    try:
        yield
    finally:
        os.sched_setscheduler(0, *before)


def paced(memory: NeuralASM, rate: float, rows: int) -> NDArray[np.float64]:
    """(rows,) from when a row is due to when it is judged [s]; one comes ``rate`` times a second."""
    rng, spec, senses = np.random.default_rng(0), memory.spec, memory.senses_
    stream = senses.mean + senses.change * rng.standard_normal((rows, spec.size)).cumsum(0) / np.sqrt(rows)
    state, late = memory.initial_state(), np.empty(rows)
    state, _ = memory.observe(state, stream[:1])
    due = time.perf_counter()
    for n in range(rows):
        due += 1.0 / rate
        time.sleep(max(0.0, due - time.perf_counter()))
        state, _ = memory.observe(state, stream[n : n + 1])
        late[n] = time.perf_counter() - due
        due = max(due, time.perf_counter() - 1.0 / rate)  # what was missed is not made up for
    return late


@dataclass
class Deadline:
    """How late rows are judged when all cores are busy, with and without garbage collection and real-time priority."""

    memory: str = "panda"
    """Name of the shipped memory."""
    rate: float = 100.0
    """Rows a second [Hz]."""
    rows: int = 1000
    """How many, of each kind."""

    def __post_init__(self) -> None:
        check_number("rate", self.rate, above=0.0)
        check_number("rows", self.rows, low=10, whole=True)

    def run(self, console: Console) -> int:
        """Prints the table."""
        memory = NeuralASM.pretrained(self.memory)
        kinds: list[tuple[str, tuple[Callable[[], AbstractContextManager[None]], ...]]] = [
            ("as it is", ()),
            ("all cores busy", (load,)),
            ("all cores busy, nothing collected", (load, no_garbage)),
            ("all cores busy, nothing collected, SCHED_FIFO", (load, no_garbage, first)),
        ]
        rows: list[tuple[str, ...]] = []
        wall, own = time.perf_counter(), time.process_time()
        for name, meanwhile in kinds:
            with ExitStack() as stack:
                try:
                    for context in meanwhile:
                        stack.enter_context(context())
                except PermissionError:
                    rows.append((name, *("not allowed",) * 3, ""))
                    continue
                late = paced(memory, self.rate, self.rows)
            missed = f"{100 * np.mean(late > 1.0 / self.rate):.1f} %"
            rows.append((name, *(f"{1e3 * q:.2f}" for q in np.quantile(late, (0.5, 0.99, 0.999))), missed))
        title = f"{self.rows} rows at {self.rate:g} Hz, from due to judged"
        console.print(ConsoleTable(Table(title, ("", "p50 ms", "p99 ms", "p99.9 ms", "later than a row"), rows)))
        console.print(machine((time.process_time() - own) / (time.perf_counter() - wall)))
        return DONE
