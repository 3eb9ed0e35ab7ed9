"""Progress of a stage on standard error: a bar in a terminal, elsewhere a line every ten seconds."""

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
def stage(
    name: str, seconds: dict[str, float] | None = None, console: Console | None = None
) -> Iterator[Progress]:
    """Show the progress of a stage while the block runs, which reports it by a function of (done, total).

    Args:
        name: of the stage.
        seconds: gets the duration of the stage by its name [s].
        console: to print to; standard error by default.
    """
    console = console or Console(stderr=True)
    start = time.perf_counter()
    last_print = start
    reached = ""

    def print_line(text: str) -> None:
        if not console.is_terminal:
            line = f"{name}: {text}{time.perf_counter() - start:.0f} s"
            console.print(line, markup=False, highlight=False, soft_wrap=True)

    def report(done: int, total: int) -> None:
        nonlocal last_print, reached
        bars.update(bar, completed=done, total=total)
        reached = f"{done} of {total}, "
        if time.perf_counter() - last_print >= EVERY_S:
            last_print = time.perf_counter()
            print_line(reached)

    columns = (
        SpinnerColumn(),
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
    )
    disable = not console.is_terminal
    # Standard output may be a pipe.
    with Bars(*columns, console=console, disable=disable, redirect_stdout=False) as bars:
        bar = bars.add_task(name, total=None)
        yield report
        total = bars.tasks[bar].total or 1
        bars.update(bar, total=total, completed=total)
    print_line(f"{reached}done in ")
    if seconds is not None:
        seconds[name] = round(time.perf_counter() - start, 1)
