"""Read lines of a live source as rows of a stream, at the rate of the memory.

A JSON line is a list of numbers, or an object by channel or by number; CSV begins with a header. A row of each joint
makes one row of all, once the last of them came; so do objects of several publishers. Where there is a time,

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
from asm_gym.data.clock import (
    EPOCHS,
    SLOWEST_WITHOUT_UNIT,
    UNITS,
    Clock,
    clock_called,
    clocks_among,
)
from asm_gym.data.names import element_name, is_clock, split_unit
from asm_gym.data.tables import Named, is_key, named_columns, named_row
from asm_gym.data.text import DOUBLED, Dialect, check_cells, flat_row, header_of
from asm_gym.spec import StreamSpec

NEWEST = 32  # rows that tell the rate, and after which it is told again
LEAP_S = 3600.0  # a clock that goes on by more between two rows was set anew [s]


class SourceDied(Exception):  # noqa: N818 (it is no error of ours)
    """Nothing came for longer than a source may be silent."""


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

        Raises ValueError where it is not finite, ClockWentBack where it is not up to ``LEAP_S`` later than the last.
        """
        if not math.isfinite(stamp):
            raise ValueError(f"its time is {stamp}")
        before, self.change = self._before, ""
        step = self.dt if before is None else stamp - before
        if not 0 < step <= LEAP_S:
            what = "leapt" if step > 0 else "must increase"
            raise ClockWentBack(f"time {what}, got {stamp:g} s after {before:g} s")
        self._before, self._rows = stamp, self._rows + 1
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


class Publishers:
    """Join messages that hold different numbers: a row is a message of most numbers, with the newest of the others."""

    def __init__(self, silence: float) -> None:
        self.silence = silence  # after which the numbers of a publisher are missing [s]
        self._newest = dict[
            frozenset[str], tuple[float, bool, Mapping[str, Any]]
        ]()  # messages by their numbers

    def row(
        self, message: Mapping[str, Any], numbers: Iterable[str], now: float, leads: bool = True
    ) -> Any:
        """Return the row that a message makes at the time ``now`` [s], or None; only one that ``leads`` may make one.

        A message with some of the numbers of another one is of the same publisher, and lacks the others.
        """
        own = frozenset(numbers)
        own = own.union(*(of for of in self._newest if of & own))
        kept = {of: said for of, said in self._newest.items() if of == own or not of & own}
        kept[own] = now, leads, message
        self._newest = {of: said for of, said in kept.items() if now - said[0] <= self.silence}
        if own != max((of for of, said in self._newest.items() if said[1]), key=len, default=None):
            return None
        return {
            name: value for _, _, other in self._newest.values() for name, value in other.items()
        } | dict(message)


class Row(NamedTuple):
    """A row as it came."""

    numbers: NDArray[np.float64]  # (D,) NaN where one was lost
    lost: int = 0  # rows that should have come before it
    read: bool = True  # it stands where the memory reads one
    change: str = ""  # how the rate changed
    problem: str = ""  # why the line is no row, or no successor of the one before


class RowReader:
    """Read lines as rows of the stream of a memory.

    ``clock`` is the column of times, by default the first one; after ``silence`` [s] a publisher's numbers are missing.
    """

    def __init__(self, spec: StreamSpec, clock: str = "", silence: float = 2.0) -> None:
        self.spec, self.line, self._wanted = spec, 0, clock
        self._dialect = Dialect(",", comma=False)
        self._header: list[str] | None = (
            None  # of CSV, as a file's: a name that comes again has a number
        )
        # names with a number, and without
        self._header_line, self._doubled = (
            "",
            list[tuple[str, str]](),
        )
        self._plan: ColumnPlan | None = None  # of rows by name
        self._named: Named = {}  # columns that name others
        self._joint = ""  # column that says whose numbers a row holds
        # of the joints that came, where a row is one of a joint
        self._gathered: dict[str, Any] = {}
        self._publishers = Publishers(silence)
        # when the newest line came, and the first that lacks columns
        self._now, self._since = (
            0.0,
            math.inf,
        )
        self._lacking: ValueError | None = None  # what all publishers lack up to now
        self._clock: Clock | None = None
        self._first: float | None = None  # number of a clock whose unit is not known yet
        self._pace = Pace(spec.dt)
        self._known = False  # a row was read
        self._aside: float | None = (
            None  # time of the last row, where that is no successor of the one before [s]
        )

    def begin(self) -> None:
        """Begin anew with the clock; columns stay."""
        self._pace = Pace(self.spec.dt)

    def rows(self, lines: Iterable[str]) -> Iterator[tuple[Row, float]]:
        """Yield each row, and when its line came, by ``time.perf_counter``; a line that is none has a ``problem``."""
        for line in filter(str.strip, lines):
            arrived = self._now = time.perf_counter()
            self.line += 1
            try:
                if self._begins_with(line):
                    continue
                found = self._row(line)
                if found is None:
                    continue
                row = found
            except (
                Exception
            ) as error:  # anybody may have sent it: deep, huge or broken, it must not end a watch
                row = self._problem(error)
            yield row, arrived
        if self._lacking is not None and not self._known:
            yield self._problem(self._lacking), self._now

    def _problem(self, error: Exception) -> Row:
        kind = "no row of numbers" + (
            ", and no header" if self._header is None and not self._known else ""
        )
        return Row(
            np.full(self.spec.size, np.nan),
            read=False,
            problem=f"line {self.line} is {kind}: {error}",
        )

    def _begins_with(self, line: str) -> bool:
        """Tell whether a line is the header of CSV, for the first time or once more, and take it up."""
        if self._header is not None:
            return line.strip() == self._header_line
        if self._known or line.lstrip()[0] in "[{":
            return False
        self._dialect = Dialect.of(line)
        header, self._header_line = list[str](), line.strip()
        for k, name in enumerate(given := header_of(self._dialect.cells(line))):
            header.append(f"{name}{DOUBLED}{given[:k].count(name) + 1}" if name in header else name)
        self._doubled = [
            (own, name) for own, name in zip(header, given, strict=True) if own != name
        ]
        self._named = named_columns(header)
        if not self._named and not any(map(is_key, header)):
            self._match(header)
        self._header = header
        return True

    def _row(self, line: str) -> Row | None:
        """Return the row of a line, None where more joints are to come; ValueError where it is none."""
        found = self._numbers(line)
        if found is None:
            return None
        numbers, stamp = found
        if numbers.shape != (self.spec.size,):
            raise ValueError(
                f"it must hold {self.spec.size} numbers, got the shape {numbers.shape}"
            )
        self._known = True
        if stamp is None:
            return Row(numbers)
        aside, self._aside = self._aside, None
        try:
            lost = self._pace.lost(stamp)
        except ClockWentBack as error:
            if (
                aside is None or not 0 < stamp - aside <= LEAP_S
            ):  # one row that came late is left out
                self._aside = stamp
                return Row(
                    numbers,
                    read=False,
                    problem=f"{error}: the row is left out (--clock NAME chooses)",
                )
            self.begin()
            self._pace.lost(stamp)
            return Row(numbers, problem=str(error))
        return Row(numbers, lost or 0, lost is not None, self._pace.change)

    def _match(self, names: Iterable[str]) -> ColumnPlan:
        """Find the column of each label, and the clock. Raises ValueError where a column is missing."""
        names = list(names)
        plan = ColumnPlan(names, self.spec)
        self._lacking = None
        found = [clock_called(self._wanted, names)] if self._wanted else clocks_among(names)
        self._clock = next((c for c in found if not set(plan.columns) & set(c.columns)), None)
        self._plan = plan
        return plan

    def _numbers(self, line: str) -> tuple[NDArray[np.float64], float | None] | None:
        """The numbers of a row (D,), and its time [s] where it has one; None where more joints are to come."""
        if self._header is not None:
            cells = self._dialect.cells(line)
            check_cells(cells, len(self._header), "it has")
            given = dict(zip(self._header, map(self._dialect.plain, cells), strict=False))
            for name, first in self._doubled:
                if (
                    given[name] != given[first]
                    and self._plan is not None
                    and name not in self._plan.columns
                ):
                    raise ValueError(f"its columns of the same name differ: {first!r}")
            return self._by_name(given, self._dialect.number)
        row: Any = json.loads(line)
        if isinstance(row, list):
            return np.asarray(row, np.float64), None
        flat = flat_row(row)
        for channel in self.spec.channels:
            part = row.get(channel.name)
            if (
                isinstance(part, list)
                and len(part) != channel.size
                and f"{channel.name}[0]" in flat
            ):
                raise ValueError(
                    f"{channel.name} must hold {channel.size} numbers, got {len(part)}"
                )
        return self._by_name(flat, lambda value: float("nan" if value is None else value))

    def _by_name(
        self, row: Mapping[str, Any], number: Callable[[Any], float]
    ) -> tuple[NDArray[np.float64], float | None] | None:
        """The numbers and the time of a row by name; a number that the row lacks is NaN."""
        row = named_row(row, self._named) if self._named else row
        if self._plan is None:
            joints = {
                label.rpartition("[")[2].rstrip("]") for label in self.spec.labels if "[" in label
            }
            self._joint = next((n for n in row if is_key(n) and str(row[n]).strip() in joints), "")
        message = self._gather(row) if self._joint else row
        if message is None:
            return None
        numbers = (
            ColumnPlan(message, self.spec, whole=False).columns
            if self._plan is None
            else self._plan.columns
        )
        whole = self._publishers.row(
            message, (name for name in numbers if name in message), self._now
        )
        plan = self._plan if whole is None else self._plan or self._whole_plan(whole, bool(numbers))
        if whole is None or plan is None:
            return None
        return plan.row(
            {name: number(whole[name]) for name in plan.columns if name in whole}
        ), self._moment(whole)

    def _whole_plan(self, row: Mapping[str, Any], some: bool) -> ColumnPlan | None:
        """Return the plan of a row with all columns; None while another publisher may add some, ValueError later."""
        self._since = min(self._since, self._now)
        try:
            return self._match(row)
        except ValueError as error:
            if not some or self._now - self._since > self._publishers.silence:
                raise
            self._lacking = error
            return None

    def _gather(self, row: Mapping[str, Any]) -> Mapping[str, Any] | None:
        """The row of all joints, once it is complete, or one of a later moment comes; None before."""
        joint, before = str(row[self._joint]).strip(), self._gathered
        own = {
            n if is_clock(n) else element_name(n, joint): v
            for n, v in row.items()
            if n != self._joint
        }
        stamps = [clock.moment(each) for clock in clocks_among(row)[:1] for each in (before, row)]
        later = bool(stamps) and None not in stamps and stamps[1] - stamps[0] > 0.5 * self.spec.dt  # type: ignore[operator]
        if later or any(n in before and not is_clock(n) for n in own):
            self._gathered = own
            return before
        self._gathered = own | before  # the time is that of the first
        if not set(self.spec.labels) <= {split_unit(n)[0] for n in self._gathered}:
            return None
        whole, self._gathered = self._gathered, {}
        return whole

    def _moment(self, row: Mapping[str, Any]) -> float | None:
        """The time of a row [s]; the unit of a clock that says none is the one that fits the memory's rate best."""
        if self._clock is None or (stamp := self._clock.moment(row)) is None:
            return None
        first, self._first = self._first, stamp if self._first is None else self._first
        if first is None or self._clock.units != (None,) or stamp >= EPOCHS[-1][0]:
            return stamp
        step = stamp - first
        unit = 1.0
        if step >= SLOWEST_WITHOUT_UNIT:
            unit = min(UNITS, key=lambda unit: abs(np.log(step * unit / self.spec.dt)))
        self._clock = Clock(self._clock.columns, (unit,))
        if unit != 1.0:
            self.begin()
            self._pace.lost(first * unit)
        return stamp * unit
