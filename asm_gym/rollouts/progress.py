"""Progress of a stage: a bar in a terminal, elsewhere a line every ten seconds."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager

from rich.console import Console
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    SpinnerColumn,
    TextColumn,
    TimeElapsedColumn,
)
from rich.progress import Progress as Bars

from asm_gym.rollouts.parallel import Progress

EVERY_S = 10.0  # least time between two lines [s]


@contextmanager
def stage(name: str, console: Console, seconds: dict[str, float]) -> Iterator[Progress]:
    """Show the progress of ``name`` while the block runs, by a function of (done, total); store its ``seconds``."""
    start = printed = time.perf_counter()
    reached = ""

    def say(text: str) -> None:
        if not console.is_terminal:
            line = f"{name}: {text}{time.perf_counter() - start:.0f} s"
            console.print(line, markup=False, highlight=False, soft_wrap=True)

    def note(done: int, total: int) -> None:
        nonlocal printed, reached
        bars.update(bar, completed=done, total=total)
        reached = f"{done} of {total}, "
        if time.perf_counter() - printed >= EVERY_S:
            printed = time.perf_counter()
            say(reached)

    columns = (
        SpinnerColumn(),
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
    )
    with Bars(*columns, console=console, disable=not console.is_terminal) as bars:
        bar = bars.add_task(name, total=None)
        yield note
        total = bars.tasks[bar].total or 1
        bars.update(bar, total=total, completed=total)
    say(f"{reached}done in ")
    seconds[name] = round(time.perf_counter() - start, 1)
