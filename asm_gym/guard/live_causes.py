"""Name the cause of a live alarm from the rows that follow it, as soon as one is clear."""

from __future__ import annotations

from collections import deque
from typing import Any

import numpy as np
from numpy.typing import NDArray

from asm_gym.monitors.named_causes import (
    AFTER_S,
    BEFORE_S,
    PACE_S,
    SHORTEST_S,
    UNEXPLAINED,
    CauseNamer,
    NamedCause,
)

LOOKS_S = (SHORTEST_S, 1.5, PACE_S, AFTER_S)  # after an alarm, at which its cause is looked for [s]


class LiveCauses:
    """Follows rows, and names the cause of the newest alarm.

    Args:
        monitor: that raises the alarms; one without ``cause_namer_`` names none.
    """

    def __init__(self, monitor: Any) -> None:
        self._namer: CauseNamer | None = getattr(monitor, "cause_namer_", None)
        dt = monitor.spec.dt
        self._before = round(BEFORE_S / dt)
        self._looks = [max(1, round(seconds / dt)) for seconds in LOOKS_S]
        self._rows: deque[NDArray[Any]] = deque(maxlen=self._before + self._looks[-1] + 1)
        self.begin()

    def begin(self) -> None:
        """Forget all rows, and the alarm."""
        self._rows.clear()
        self._since = -1  # rows since the alarm; negative where no cause is looked for
        self._blamed: tuple[int, ...] = ()

    def open(self, blamed: tuple[int, ...]) -> None:
        """Look for the cause of the alarm in the newest row, of which blame points to these columns."""
        self._since = 0
        self._blamed = blamed

    def follow(self, row: NDArray[Any]) -> NamedCause | None:
        """Take up the next row (D,); return the cause once it is clear, or nothing can be found."""
        self._rows.append(row)
        if self._since < 0 or self._namer is None:
            return None
        self._since += 1
        if self._since not in self._looks:
            return None
        rows = np.array(self._rows)
        first = len(rows) - 1 - self._since
        start = max(0, first - self._before)
        cause = self._namer(rows[start:], first - start, self._blamed)
        if cause.name == UNEXPLAINED and self._since < self._looks[-1]:
            return None
        self._since = -1
        return cause
