"""Keep the newest rows of a live watch, and write those around each incident to a file.

    row ► ring of 5 s ► at an incident: a window ► 5 s later ► a thread writes CSV

What cannot be written is a problem to note: it never holds up a row or an alarm.
"""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from queue import Full, Queue
from threading import Thread
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from asm_gym.evaluation.incident_window import AFTER_S, BEFORE_S, IncidentWindow
from asm_gym.files import write_text
from asm_gym.monitors.expectation import Expectation

MOST_WAITING = 100  # windows that wait to be written; later ones are left out
LAST_S = 2.0  # how long the end of a watch waits for its last files [s]


class KeptRow(NamedTuple):
    """A row as it was judged."""

    time: float  # [s]
    stamp: float | None  # by the robot's own clock [s]
    numbers: NDArray[np.floating[Any]]  # (D,)
    surprise: float  # in thresholds


@dataclass(eq=False)
class _OpenWindow:
    """A window whose incident has begun."""

    path: Path
    column: int | None
    until: float  # time of its last row [s]
    rows: list[KeptRow] = field(default_factory=list)


class IncidentRecorder:
    """Record the rows around incidents.

    Args:
        folder: of the files; None to keep rows and write nothing.
        names: of the columns (D,).
        dt: period of the rows [s].
        expectation: what channels should read.
    """

    def __init__(
        self, folder: Path | None, names: Sequence[str], dt: float, expectation: Expectation
    ) -> None:
        self._folder = folder
        self._names = names
        self._expectation = expectation
        self._ring: deque[KeptRow] = deque(maxlen=max(2, round(BEFORE_S / dt)))
        self._open: list[_OpenWindow] = []
        self._queue: Queue[_OpenWindow] = Queue(MOST_WAITING)
        self._problems: Queue[str] = Queue()
        self._began = f"{datetime.now(UTC):%Y%m%dT%H%M%S}"
        if folder is not None:
            Thread(target=self._write_all, daemon=True).start()

    def begin(self) -> None:
        """Forget the rows before: they are not the past of those that follow."""
        self._ring.clear()

    def add(self, row: KeptRow) -> None:
        """Keep a row."""
        self._ring.append(row)
        for window in self._open:
            window.rows.append(row)
        if self._open and row.time >= min(window.until for window in self._open):
            for window in [w for w in self._open if row.time >= w.until]:
                self._finish(window)

    def open_window(self, number: int, column: int | None, start: float) -> str:
        """Begin the window of an incident that starts at a time [s]; return its file, empty for none."""
        if self._folder is None:
            return ""
        path = self._folder / f"{self._began}_{number:04d}.csv"
        window = _OpenWindow(path, column, until=start + AFTER_S, rows=list(self._ring))
        self._open.append(window)
        return str(path)

    def last_row(self) -> NDArray[np.floating[Any]] | None:
        """Return the newest row (D,); None before the first."""
        if not self._ring:
            return None
        return self._ring[-1].numbers

    def problems(self) -> list[str]:
        """Return what went wrong since this was last asked."""
        found = []
        while not self._problems.empty():
            found.append(self._problems.get())
        return found

    def close(self) -> None:
        """Write the windows that are open, and wait, at most ``LAST_S``, until all are written."""
        for window in list(self._open):
            self._finish(window)
        end = time.monotonic() + LAST_S
        while self._queue.unfinished_tasks and time.monotonic() < end:
            time.sleep(0.001)
        if self._queue.unfinished_tasks:
            self._problems.put("the rows around an incident were not written in time")

    def _finish(self, window: _OpenWindow) -> None:
        """Hand a window to the thread that writes."""
        self._open.remove(window)
        try:
            self._queue.put_nowait(window)
        except Full:
            self._problems.put(f"{window.path} is not written: too many incidents wait")

    def _write_all(self) -> None:
        """Write windows one after another."""
        while True:
            window = self._queue.get()
            try:
                write_text(window.path, self._table(window))
            except Exception as error:  # a full or missing disk must not end the watch
                self._problems.put(f"the rows around an incident cannot be written: {error}")
            self._queue.task_done()

    def _table(self, window: _OpenWindow) -> str:
        """Return the rows of a window as CSV."""
        table = IncidentWindow(
            times=[row.time if row.stamp is None else row.stamp for row in window.rows],
            rows=np.array([row.numbers for row in window.rows], np.float64),
            surprise=[row.surprise for row in window.rows],
            labels=self._names,
            column=window.column,
        )
        return table.to_csv(self._expectation)
