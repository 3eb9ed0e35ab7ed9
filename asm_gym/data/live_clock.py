"""The clock of a live source: the stamp of each row, and which rows were lost before it.

own      median step of the newest 32 rows [s]
right    dt/1.5 <= own <= 1.5 dt    each row is read; step/dt - 1 rows were lost before it
wrong    elsewhere                  nothing is judged: a memory cannot judge steps of another length
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Collection, Mapping
from statistics import median
from typing import Any

import numpy as np

from asm_gym.data.clock import NUMBER, SINCE_1970, LogClock
from asm_gym.data.clock_inference import UNNAMED_UNITS, clock_called, clocks_among, resolve
from asm_gym.data.column_names import LONGER
from asm_gym.data.schema import LogSchema, can_resample

NEWEST = 32  # rows that tell the rate, and after which it is told again
LONGEST_STEP_S = 3600.0  # a clock that goes on by more between two rows was set anew [s]


class ClockWentBack(ValueError):  # noqa: N818 (what happened, and no fault of ours)
    """A row is older than the one before it, or much newer."""


class Pace:
    """Follow the stamps of a source for a memory whose rows are ``dt`` [s] apart.

    Attributes:
        is_right: rows come at the memory's rate.
        change: how the rate changed with the newest row; empty if it did not.
    """

    def __init__(self, dt: float) -> None:
        self.dt = dt
        self.is_right = True
        self.change = ""
        self._steps: deque[float] = deque(maxlen=NEWEST)
        self._rows = 0
        self._last_stamp: float | None = None  # [s]

    def rows_lost_before(self, stamp: float) -> int | None:
        """Return how many rows were lost before the one of this stamp [s]; None if it is not to be read.

        Raises:
            ValueError: the stamp is not finite.
            ClockWentBack: it is not later than the last one, or more than ``LONGEST_STEP_S`` later.
        """
        if not math.isfinite(stamp):
            raise ValueError(f"its time is {stamp}")
        self.change = ""
        last_stamp = self._last_stamp
        step = self.dt
        if last_stamp is not None:
            step = stamp - last_stamp
        if not 0 < step <= LONGEST_STEP_S:
            problem = "must increase"
            if step > 0:
                problem = "leapt"
            raise ClockWentBack(f"time {problem}, got {stamp:g} s after {last_stamp:g} s")
        self._last_stamp = stamp
        self._rows += 1
        if last_stamp is None:
            return 0

        self._steps.append(step)
        if self._rows % NEWEST == 1:
            self._check_rate()
        if not self.is_right:
            return None
        return max(0, round(step / self.dt) - 1)

    def _check_rate(self) -> None:
        """Compare the newest steps with the memory's."""
        own = median(self._steps)
        was_right = self.is_right
        self.is_right = can_resample(own / self.dt)
        if self.is_right == was_right:
            return
        self.change = f"rows come at {1 / own:.4g} a second"
        if self.is_right:
            self.change += " again"
        else:
            self.change += f", and the memory reads {1 / self.dt:.4g}"


class LiveClock:
    """Tell the stamps of rows by the schema's clock, by the one that is asked for, or by the first.

    Args:
        schema: of the memory.
        wanted: name of the column of times, perhaps with a unit; empty for the schema's.
    """

    def __init__(self, schema: LogSchema, wanted: str) -> None:
        self._schema = schema
        self._wanted = wanted
        self._clock: LogClock | None = None
        self._first: float | None = None  # a number of a clock whose unit is not known yet

    def find(self, row: Mapping[str, Any], read: Collection[str]) -> None:
        """Find the clock among the columns of a row that are not ``read`` as numbers.

        Raises:
            ValueError: the one that is asked for is not there.
        """
        self._first = None
        self._clock = None
        if self._wanted:
            candidates = [clock_called(self._wanted, list(row))]
        elif self._schema.clock is not None and self._schema.clock.is_in(row):
            self._clock = self._schema.clock
            return
        else:
            candidates = clocks_among(row)

        for named in candidates:
            if set(read).isdisjoint(named.columns):
                cells = {name: np.array([row[name]], object) for name in named.columns}
                self._clock = resolve(named, cells, None, "")
                if named.units == (None,) and self._clock.kind == NUMBER:
                    self._first = self._clock.moment(row)
                return

    def stamp(self, row: Mapping[str, Any]) -> float | None:
        """Return the stamp of a row [s]; None if it has none.

        Raises:
            ValueError: it is no time.
        """
        if self._clock is None:
            return None
        return self._clock.moment(row)

    def first_in_new_unit(self, stamp: float) -> float | None:
        """Return the first stamp again if this one tells that the clock counts in another unit.

        The unit of a clock that says none is the one that fits the memory's rate best.
        """
        first = self._first
        if self._clock is None or first is None or stamp == first:
            return None
        self._first = None
        step = stamp - first
        if step < 1.0 or stamp >= SINCE_1970:
            return None
        rate = self._schema.rate
        units = [LONGER[unit] for unit in UNNAMED_UNITS]
        unit = min(units, key=lambda unit: abs(math.log(step * unit * rate)))
        if unit == 1.0:
            return None
        self._clock = LogClock(self._clock.columns, (unit,))
        return first * unit
