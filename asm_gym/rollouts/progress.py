"""How far a stage has come: a bar in a terminal or a notebook, elsewhere a line at least every ten seconds."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from importlib.util import find_spec

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, SpinnerColumn, TextColumn, TimeElapsedColumn
from rich.progress import Progress as Bars

from asm_gym.rollouts.parallel import Progress

EVERY_S = 10.0
"""Between two lines where there is no terminal [s]."""


@contextmanager
def stage(name: str, console: Console, seconds: dict[str, float]) -> Iterator[Progress]:
    """Shows how far ``name`` has come while the block runs, and notes how long it took in ``seconds``.

    Yields:
        What the block calls as (done, total).
    """
    start = time.perf_counter()
    with (_bar if console.is_terminal or _has_widgets(console) else _lines)(name, console) as progress:
        yield progress
    seconds[name] = round(time.perf_counter() - start, 1)


@contextmanager
def in_a_notebook(name: str, progress: Progress | None) -> Iterator[Progress | None]:
    """``progress``; where there is none, and this is a notebook with widgets, a bar."""
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
    start, ended, reached = time.perf_counter(), threading.Event(), [""]

    def say(what: str) -> None:
        # Markup and wrapping are for readers; what reads a pipe wants a line.
        console.print(
            f"{name}: {what}{time.perf_counter() - start:.0f} s", markup=False, highlight=False, soft_wrap=True
        )

    def note(done: int, total: int) -> None:
        reached[0] = f"{done} of {total}, "

    def keep_saying() -> None:
        while not ended.wait(EVERY_S):
            say(reached[0])

    speaker = threading.Thread(target=keep_saying, daemon=True)
    speaker.start()
    try:
        yield note
    finally:
        ended.set()
        speaker.join()
    say(f"{reached[0]}done in ")
