"""Rivals take turns, call by call: what slows the machine down slows all of them down, and is told of."""

from __future__ import annotations

import os
import platform
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from rich.console import Console
from rich.progress import track

from asm_gym.evaluation.statistics import Spread

REPETITIONS = 10
"""Into so many parts a measurement is divided; how much they differ is its spread."""

OWN = 0.9
"""Share of a core that this process must have had: with less, what was measured is the machine's other work."""

OTHERS = 0.5
"""Load of other processes for each core [runnable processes], over the last minute, above which the machine is busy."""


class BusyError(RuntimeError):
    """The machine had too much else to do for any figure to mean something."""


class Turns(NamedTuple):
    """What rivals took.

    Attributes:
        seconds: (n,) of each rival's calls, in the order they were made.
        share: of one core that this process had meanwhile.
    """

    seconds: dict[str, NDArray[np.float64]]
    share: float

    def median(self, name: str) -> float:
        """Of a rival's calls [s]."""
        return float(np.median(self.seconds[name]))

    def quantile(self, name: str, q: float) -> float:
        """Of a rival's calls [s]."""
        return float(np.quantile(self.seconds[name], q))

    def ratio(self, name: str, to: str) -> Spread:
        """How many times as long a call took as another rival's: of medians, its mean and spread over repetitions."""
        parts = min(REPETITIONS, len(self.seconds[name]))
        one, other = ([float(np.median(part)) for part in np.array_split(self.seconds[n], parts)] for n in (name, to))
        return Spread.of([a / b for a, b in zip(one, other, strict=True)])

    def times(self, name: str, to: str) -> str:
        """``ratio`` for a table."""
        return f"{self.ratio(name, to).text(digits=2)}×"

    def faster(self, name: str, than: str) -> str:
        """How many times as fast as another rival, for a table."""
        return f"{self.ratio(than, name).text(digits=1)}×"

    def where(self) -> str:
        """The machine, how much of it this process had, and what a spread is of."""
        return f"{machine(self.share)} After ±: standard deviation over {REPETITIONS} repetitions."


def take_turns(rivals: dict[str, Callable[[], Any]], turns: int, console: Console, even_if_busy: bool = False) -> Turns:
    """Times the calls of each rival; the first calls, which warm up, do not count.

    Raises:
        BusyError: the machine had too much else to do, unless ``even_if_busy``.
    """
    for call in rivals.values():
        call()
    seconds: dict[str, list[float]] = {name: [] for name in rivals}
    order, rng = list(rivals), np.random.default_rng(0)
    before = time.perf_counter(), time.process_time()
    for _ in track(range(turns), "measuring", console=console, transient=True):
        rng.shuffle(order)  # whoever comes after another finds the caches as that one left them
        for name in order:
            call = rivals[name]
            start = time.perf_counter()
            call()
            seconds[name].append(time.perf_counter() - start)
    wall, own = time.perf_counter() - before[0], time.process_time() - before[1]
    found = Turns({name: np.array(times) for name, times in seconds.items()}, own / wall)
    if not even_if_busy:
        check_quiet(found.share, os.getloadavg()[0], os.cpu_count() or 1)
    return found


def again(call: Callable[[], Any], times: int) -> NDArray[np.float64]:
    """(times,) what a call takes that nothing comes between [s]; the first tenth does not count."""
    seconds = np.empty(times + times // 10)
    for n in range(len(seconds)):
        start = time.perf_counter()
        call()
        seconds[n] = time.perf_counter() - start
    return seconds[-times:]


def machine(share: float) -> str:
    """What was measured on, and the ``share`` of a core that this process had."""
    return f"{_processor()}, {os.cpu_count()} cores, of which this process kept {share:.1f} busy."


def check_quiet(share: float, load: float, cores: int) -> None:
    """Raises BusyError where a process had only a ``share`` of a core, or others would load the ``cores``."""
    others = (load - 1.0) / cores
    if share < OWN or others > OTHERS:
        raise BusyError(
            f"this machine is too busy to tell: the benchmark had {100 * share:.0f} % of a core, and over the last "
            f"minute {max(0.0, load - 1):.1f} other processes ran on {cores} cores. Wait, or add --even-if-busy"
        )


def _processor() -> str:
    """Its name, as the system has it."""
    info = Path("/proc/cpuinfo")
    if info.is_file():
        for line in info.read_text(encoding="utf-8", errors="replace").splitlines():
            if line.startswith("model name"):
                return line.partition(":")[2].strip()
    return platform.processor() or platform.machine()
