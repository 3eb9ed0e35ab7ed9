"""Rivals take turns, call by call: what slows the machine down slows all of them down."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

import numpy as np
from rich.console import Console
from rich.progress import track


def take_turns(rivals: dict[str, Callable[[], Any]], turns: int, console: Console) -> dict[str, float]:
    """Median seconds of a call of each rival; the first calls, which warm up, do not count."""
    for call in rivals.values():
        call()
    seconds: dict[str, list[float]] = {name: [] for name in rivals}
    order, rng = list(rivals), np.random.default_rng(0)
    for _ in track(range(turns), "measuring", console=console, transient=True):
        rng.shuffle(order)  # whoever comes after another finds the caches as that one left them
        for name in order:
            call = rivals[name]
            start = time.perf_counter()
            call()
            seconds[name].append(time.perf_counter() - start)
    return {name: float(np.median(times)) for name, times in seconds.items()}
