"""Progress of a stage: a bar in a terminal or a notebook, elsewhere a line every ten seconds."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager
from importlib.util import find_spec

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, SpinnerColumn, TextColumn, TimeElapsedColumn
from rich.progress import Progress as Bars

from asm_gym.rollouts.parallel import Progress

EVERY_S = 10.0
"""Least time between two lines [s]."""


@contextmanager
def stage(name: str, console: Console, seconds: dict[str, float]) -> Iterator[Progress]:
    """Show the progress of ``name`` while the block runs, and store its duration in ``seconds``.

    Yields:
        A function of (done, total), for the block to call.
    """
    start = time.perf_counter()
    with (_bar if console.is_terminal or _has_widgets(console) else _lines)(name, console) as progress:
        yield progress
    seconds[name] = round(time.perf_counter() - start, 1)


@contextmanager
def in_a_notebook(name: str, progress: Progress | None) -> Iterator[Progress | None]:
    """Yield ``progress``; without one, a bar where this is a notebook with widgets."""
    console = Console()
    if progress is None and _has_widgets(console):
        with _bar(name, console) as bar:
            yield bar
    else:
        yield progress


def _has_widgets(console: Console) -> bool:
    return console.is_jupyter and find_spec("ipywidgets") is not None


@contextmanager
def _bar(name: str, console: Console) -> Iterator[Progress]:
    columns = SpinnerColumn(), TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn()
    with Bars(*columns, console=console) as bars:
        bar = bars.add_task(name, total=None)
        yield lambda done, total: bars.update(bar, completed=done, total=total)
        total = bars.tasks[bar].total or 1
        bars.update(bar, total=total, completed=total)


@contextmanager
def _lines(name: str, console: Console) -> Iterator[Progress]:
    start = printed = time.perf_counter()
    reached = ""

    def say(text: str) -> None:
        line = f"{name}: {text}{time.perf_counter() - start:.0f} s"
        console.print(line, markup=False, highlight=False, soft_wrap=True)

    def note(done: int, total: int) -> None:
        nonlocal printed, reached
        reached = f"{done} of {total}, "
        if time.perf_counter() - printed >= EVERY_S:
            printed = time.perf_counter()
            say(reached)

    yield note
    say(f"{reached}done in ")
