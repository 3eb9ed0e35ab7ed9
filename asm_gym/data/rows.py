"""Read lines of a live source as rows of a stream, at the rate of the memory.

A JSON line is a list of numbers, or an object by channel or by number; CSV begins with a header. Where there is a time,

own      median step of the newest 32 rows [s]
right    dt/1.5 <= own <= 1.5 dt    every row is read; (step / dt) - 1 rows were lost before it
wrong    elsewhere                  nothing is judged: a memory cannot judge steps of another length
"""

from __future__ import annotations

import json
import math
import time
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping
from statistics import median
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from asm_gym.data.channels import RESAMPLED, ColumnPlan
from asm_gym.data.clock import EPOCHS, SLOWEST_WITHOUT_UNIT, UNITS, Clock, clocks_among
from asm_gym.data.tables import Named, named_columns, named_row
from asm_gym.data.text import Dialect, check_cells, flat_row, header_of
from asm_gym.spec import StreamSpec


class SourceDied(Exception):  # noqa: N818 (it is no error of ours)
    """Nothing came for longer than a source may be silent."""


NEWEST = 32  # rows that tell the rate, and after which it is told again


LEAP_S = 3600.0  # a clock that goes on by more between two rows was set anew [s]


class ClockWentBack(ValueError):  # noqa: N818 (what happened, and no fault of ours)
    """A row is older than the one before it, or much newer."""


class Pace:
    """Follow the clock of a source for a memory whose rows are ``dt`` [s] apart; ``change`` says a change of rate."""

    def __init__(self, dt: float) -> None:
        self.dt, self.right, self.change = dt, True, ""
        self._steps: deque[float] = deque(maxlen=NEWEST)
        self._rows = 0
        self._before: float | None = None

    def lost(self, stamp: float) -> int | None:
        """Return how many rows were lost before the one of this time [s]; None where it is not to be read.

        Raises:
            ValueError: the time is not finite.
            ClockWentBack: it is no later than the one before, or later than ``LEAP_S``.
        """
        if not math.isfinite(stamp):
            raise ValueError(f"its time is {stamp}")
        before, self.change = self._before, ""
        step = self.dt if before is None else stamp - before
        if not 0 < step <= LEAP_S:
            what = "leapt" if step > 0 else "must increase"
            raise ClockWentBack(f"time {what}, got {stamp:g} s after {before:g} s")
        self._before = stamp
        self._rows += 1
        if before is None:
            return 0
        self._steps.append(step)
        if self._rows % NEWEST == 1:
            own = median(self._steps)
            right = self.dt / RESAMPLED <= own <= self.dt * RESAMPLED
            if right != self.right:
                consequence = " again" if right else f", and the memory reads {1 / self.dt:.4g}"
                self.change = f"rows come at {1 / own:.4g} a second{consequence}"
            self.right = right
        return max(0, round(step / self.dt) - 1) if self.right else None


class Row(NamedTuple):
    """A row as it came."""

    numbers: NDArray[np.float64]  # (D,) NaN where one was lost
    lost: int = 0  # rows that should have come before it
    read: bool = True  # it stands where the memory reads one
    change: str = ""  # how the rate changed
    problem: str = ""  # why the line is no row, or no successor of the one before


class RowReader:
    """Read lines as rows of the stream of a memory.

    Example:
        >>> from asm_gym import Channel, StreamSpec
        >>> reader = RowReader(StreamSpec((Channel("q", 2, "rad"),), dt=0.01))
        >>> [row.numbers.tolist() for row, _ in reader.rows(["[1, 2]", "[3, 4]"])]
        [[1.0, 2.0], [3.0, 4.0]]
    """

    def __init__(self, spec: StreamSpec) -> None:
        self.spec, self.line = spec, 0
        self._dialect = Dialect(",", comma=False)
        self._header: list[str] | None = None  # of CSV
        self._plan: ColumnPlan | None = None  # of rows by name
        self._named: Named = {}  # columns that name others
        self._clock: Clock | None = None
        self._first: float | None = None  # number of a clock whose unit is not known yet
        self._pace = Pace(spec.dt)
        self._known = False  # a row was read
        self._aside: float | None = None  # time of the last row, where that is no successor of the one before [s]

    def begin(self) -> None:
        """Begin anew with the clock; columns stay."""
        self._pace = Pace(self.spec.dt)

    def rows(self, lines: Iterable[str]) -> Iterator[tuple[Row, float]]:
        """Yield each row, and when its line came, by ``time.perf_counter``; a line that is none has a ``problem``."""
        for line in filter(str.strip, lines):
            arrived = time.perf_counter()
            self.line += 1
            try:
                if self._begins_with(line):
                    continue
                row = self._row(line)
            except Exception as error:  # anybody may have sent it: deep, huge or broken, it must not end a watch
                kind = "no row of numbers" + (", and no header" if self._header is None and not self._known else "")
                row = Row(np.full(self.spec.size, np.nan), read=False, problem=f"line {self.line} is {kind}: {error}")
            yield row, arrived

    def _begins_with(self, line: str) -> bool:
        """Tell whether a line is the header of CSV, for the first time or once more, and take it up."""
        if self._header is not None:
            return self._dialect.cells(line) == self._header
        if self._known or line.lstrip()[0] in "[{":
            return False
        self._dialect = Dialect.of(line)
        header = header_of(self._dialect.cells(line), "the header")
        self._named = named_columns(header)
        if not self._named:
            self._match(header)
        self._header = header
        return True

    def _row(self, line: str) -> Row:
        """Return the row of a line; ValueError where it is none."""
        numbers, stamp = self._numbers(line)
        if numbers.shape != (self.spec.size,):
            raise ValueError(f"it must hold {self.spec.size} numbers, got the shape {numbers.shape}")
        self._known = True
        if stamp is None:
            return Row(numbers)
        aside, self._aside = self._aside, None
        try:
            lost = self._pace.lost(stamp)
        except ClockWentBack as error:
            if aside is None or not 0 < stamp - aside <= LEAP_S:  # one row that came late is left out
                self._aside = stamp
                return Row(numbers, read=False, problem=f"{error}: the row is left out")
            self.begin()
            self._pace.lost(stamp)
            return Row(numbers, problem=str(error))
        return Row(numbers, lost or 0, lost is not None, self._pace.change)

    def _match(self, names: Iterable[str]) -> None:
        """Find the column of each label, and the clock. Raises ValueError where a column is missing."""
        names = list(names)
        plan = ColumnPlan(names, self.spec)
        doubled = [name for name in plan.columns if names.count(name) > 1]
        if doubled:
            raise ValueError(f"it has columns of the same name: {', '.join(map(repr, doubled[:8]))}")
        self._plan = plan
        read = set(self._plan.columns)
        self._clock = next((clock for clock in clocks_among(names) if not read & set(clock.columns)), None)

    def _numbers(self, line: str) -> tuple[NDArray[np.float64], float | None]:
        """The numbers of a row (D,), and its time [s] where it has one."""
        if self._header is not None:
            cells = self._dialect.cells(line)
            check_cells(cells, len(self._header), "it has")
            return self._by_name(dict(zip(self._header, cells, strict=False)), self._dialect.number)
        row: Any = json.loads(line)
        if isinstance(row, list):
            return np.asarray(row, np.float64), None
        flat = flat_row(row)
        for channel in self.spec.channels:
            if isinstance(part := row.get(channel.name), list) and len(part) != channel.size:
                raise ValueError(f"{channel.name} must hold {channel.size} numbers, got {len(part)}")
        return self._by_name(flat, lambda value: float("nan" if value is None else value))

    def _by_name(
        self, row: Mapping[str, Any], number: Callable[[Any], float]
    ) -> tuple[NDArray[np.float64], float | None]:
        """The numbers and the time of a row by name; a number that the row lacks is NaN."""
        row = named_row(row, self._named) if self._named else row
        if self._plan is None:
            self._match(row)
        assert self._plan is not None
        numbers = self._plan.row({name: number(row[name]) for name in self._plan.columns if name in row})
        return numbers, self._moment(row)

    def _moment(self, row: Mapping[str, Any]) -> float | None:
        """The time of a row [s]; the unit of a clock that says none is the one that fits the memory's rate best."""
        if self._clock is None or (stamp := self._clock.moment(row)) is None:
            return None
        first, self._first = self._first, stamp if self._first is None else self._first
        if first is not None and self._clock.units == (None,) and stamp < EPOCHS[-1][0]:
            step = stamp - first
            fits = min(UNITS, key=lambda unit: abs(np.log(step * unit / self.spec.dt))) if step > 0 else 1.0
            unit = fits if step >= SLOWEST_WITHOUT_UNIT else 1.0
            self._clock, stamp = Clock(self._clock.columns, (unit,)), stamp * unit
            if unit != 1.0:
                self._pace = Pace(self.spec.dt)
                self._pace.lost(first * unit)
        return stamp
