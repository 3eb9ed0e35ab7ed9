"""Follow the rate of a live source by its clock, and tell which rows a memory of another rate reads.

own      median step of the newest 32 rows [s]
right    dt/1.5 <= own <= 1.5 dt    every row is read; (step / dt) - 1 rows were lost before it
faster   own < dt/1.5               rows are read dt apart, and those between passed over
slower   own > 1.5 dt               nothing is judged: a memory of short steps cannot judge longer ones
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


class ClockWentBack(ValueError):  # noqa: N818 (what happened, and no fault of ours)
    """A row is older than the one before it."""


class Pace:
    """Follow the clock of a source; ``change`` is a message where its rate changed.

    Args:
        dt: from row to row of the memory [s].
    """

    def __init__(self, dt: float) -> None:
        self.dt, self.kind, self.change = dt, RIGHT, ""
        self._steps: deque[float] = deque(maxlen=NEWEST)
        self._rows = 0
        self._before: float | None = None
        self._read = 0.0  # time of the last row that was read

    def lost(self, stamp: float) -> int | None:
        """Return how many rows were lost before the one of this time [s]; None where it is not to be read.

        Raises:
            ClockWentBack: its time is not later than that of the row before.
        """
        before, self._before, self.change = self._before, stamp, ""
        if before is None:
            self._read = stamp
            return 0
        if not stamp > before:
            raise ClockWentBack(f"time must increase, got {stamp:g} s after {before:g} s")
        self._steps.append(stamp - before)
        self._rows += 1
        if self._rows % NEWEST == 0:
            self._judge(median(self._steps))
        if self.kind == SLOWER:
            self._read = stamp
            return None
        own = min(self.dt, median(self._steps)) if self.kind == FASTER else 0.0
        if self.kind == FASTER and stamp - self._read < self.dt - EARLY * own:
            return None
        step, self._read = stamp - self._read, stamp
        return max(0, round(step / self.dt) - 1)

    def _judge(self, own: float) -> None:
        kind = FASTER if own < self.dt / RESAMPLED else SLOWER if own > self.dt * RESAMPLED else RIGHT
        if kind != self.kind:
            self.change = (
                f"rows come at {1 / own:.4g} a second"
                + {
                    RIGHT: " again",
                    FASTER: f", and are read at {1 / self.dt:.4g}, by their clock",
                    SLOWER: f", and the memory reads {1 / self.dt:.4g}: they are not judged, an alarm",
                }[kind]
            )
        self.kind = kind
