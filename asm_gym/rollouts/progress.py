"""Progress bars: one for each stage of a script."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, SpinnerColumn, TextColumn, TimeElapsedColumn

from asm_gym.rollouts import parallel


@contextmanager
def stage(name: str, console: Console, seconds: dict[str, float]) -> Iterator[parallel.Progress]:
    """Shows a bar called ``name`` while the block runs, and notes how long it took in ``seconds``.

    Yields:
        What the block calls as (done, total).
    """
    columns = (
        SpinnerColumn(),
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
    )
    start = time.perf_counter()
    with Progress(*columns, console=console) as progress:
        bar = progress.add_task(name, total=None)
        yield lambda done, total: progress.update(bar, completed=done, total=total)
        task = progress.tasks[bar]
        progress.update(bar, total=task.total or 1, completed=task.total or 1)
    seconds[name] = round(time.perf_counter() - start, 1)
