"""At which rate rows come, by their own clock, and which of them a memory of another rate reads.

own      median step of the newest 32 rows [s]
right    dt/1.5 <= own <= 1.5 dt    every row is read; (step / dt) - 1 rows were lost before it
faster   own < dt/1.5               rows are read dt apart, and those between passed over
slower   own > 1.5 dt               nothing is judged: what was learned of a step says nothing of a longer one
"""

from __future__ import annotations

from collections import deque
from statistics import median

from asm_gym.data.channels import RESAMPLED

NEWEST = 32
"""Rows that tell the rate, and after which it is told again."""

EARLY = 0.5
"""Of their own step, how much sooner than due a row may come that is read."""

RIGHT, FASTER, SLOWER = "right", "faster", "slower"


class Pace:
    """Follows the clock of a source, and says in ``change`` what it found last.

    Args:
        dt: from row to row of the memory [s].
    """

    def __init__(self, dt: float) -> None:
        self.dt, self.kind, self.change = dt, RIGHT, ""
        self._steps: deque[float] = deque(maxlen=NEWEST)
        self._since = 0
        self._before: float | None = None
        self._read: float | None = None

    def lost(self, stamp: float) -> int | None:
        """How many rows were lost before the one of this time [s]; None where it is not to be read.

        Raises:
            ClockWentBack: its time is not later than that of the row before.
        """
        before, self._before, self.change = self._before, stamp, ""
        if before is None or self._read is None:
            self._read = stamp
            return 0
        if not stamp > before:
            raise ClockWentBack(f"time must increase, got {stamp:g} s after {before:g} s")
        self._steps.append(stamp - before)
        self._since += 1
        if self._since >= NEWEST:
            self._since = 0
            self._tell()
        if self.kind == SLOWER:
            self._read = stamp
            return None
        own = min(self.dt, median(self._steps)) if self.kind == FASTER else 0.0
        if self.kind == FASTER and stamp - self._read < self.dt - EARLY * own:
            return None
        apart, self._read = stamp - self._read, stamp
        return max(0, round(apart / self.dt) - 1)

    def _tell(self) -> None:
        own = median(self._steps)
        kind = FASTER if own < self.dt / RESAMPLED else SLOWER if own > self.dt * RESAMPLED else RIGHT
        if kind != self.kind:
            theirs, ours = f"{1 / own:.4g}", f"{1 / self.dt:.4g}"
            self.change = {
                RIGHT: f"rows come at {theirs} a second again",
                FASTER: f"rows come at {theirs} a second, and are read at {ours}, by their clock",
                SLOWER: f"rows come at {theirs} a second, and the memory reads {ours}: they are not judged, an alarm",
            }[kind]
        self.kind = kind


class ClockWentBack(ValueError):  # noqa: N818 (what happened, and no fault of ours)
    """A row is older than the one before it."""
