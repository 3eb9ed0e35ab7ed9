"""Read lines of a live source as rows of a memory's stream.

    line ► cells by name ► one row of all joints ► one row of all publishers ► numbers (D,) and stamp

A JSON line is a list of numbers, or an object by channel or by number; CSV begins with a header. A
row of each joint makes one row of all, once the last of them came; so do objects of several
publishers.
"""

from __future__ import annotations

import json
import math
import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from asm_gym.data.column_match import ColumnMatch
from asm_gym.data.live_clock import LONGEST_STEP_S, ClockWentBack, LiveClock, Pace
from asm_gym.data.names import element_name, is_clock, split_unit
from asm_gym.data.schema import LogSchema
from asm_gym.data.tables import Named, is_key, named_columns, named_row
from asm_gym.data.text import DOUBLED, Dialect, check_cells, flat_row, header_of

NO_DIALECT = Dialect(",", comma=False)


class SourceDied(Exception):  # noqa: N818 (it is no error of ours)
    """Nothing came for longer than a source may be silent."""


@dataclass(frozen=True, kw_only=True)
class Row:
    """A row as it came.

    Args:
        numbers: (D,) NaN where one was lost.
        lost: how many rows should have come before it.
        read: it stands where the memory reads one.
        stamp: by the robot's own clock; None without one [s].
        change: how the rate changed.
        problem: why the line is no row, or no successor of the one before.
    """

    numbers: NDArray[np.float64]
    lost: int = 0
    read: bool = True
    stamp: float | None = None
    change: str = ""
    problem: str = ""


class Publishers:
    """Join messages that hold different numbers.

    A row is a message of most numbers, with the newest of the others.

    Args:
        silence: after which the numbers of a publisher are missing [s].
    """

    def __init__(self, silence: float) -> None:
        self.silence = silence
        # Arrival, whether it may make a row, and the newest message, by its numbers.
        self._newest: dict[frozenset[str], tuple[float, bool, Mapping[str, Any]]] = {}

    def row(
        self, message: Mapping[str, Any], numbers: Iterable[str], now: float, leads: bool = True
    ) -> dict[str, Any] | None:
        """Return the row that a message makes, or None.

        A message with some of the numbers of another one is of the same publisher, and lacks the
        others.

        Args:
            message: values by name.
            numbers: the names that are read.
            now: when it came [s].
            leads: it may make a row.
        """
        own = frozenset(numbers)
        for others in self._newest:
            if others & own:
                own |= others
        kept = {names: newest for names, newest in self._newest.items() if not names & own}
        kept[own] = (now, leads, message)
        self._newest = {
            names: newest for names, newest in kept.items() if now - newest[0] <= self.silence
        }
        leaders = [names for names, newest in self._newest.items() if newest[1]]
        if own != max(leaders, key=len, default=None):
            return None
        row: dict[str, Any] = {}
        for _, _, values in self._newest.values():
            row |= values
        return row | dict(message)


class RowReader:
    """Read lines as rows of the stream of a memory.

    Args:
        schema: how the memory reads logs.
        clock: the column of times; by default the schema's, or the first.
        silence: after which the numbers of one of several publishers are missing [s].
    """

    def __init__(self, schema: LogSchema, clock: str = "", silence: float = 2.0) -> None:
        self.line = 0
        self._schema = schema
        self._spec = schema.spec
        self._clock = LiveClock(schema, clock)
        self._pace = Pace(self._spec.dt)
        self._publishers = Publishers(silence)
        self._match: ColumnMatch | None = None  # of rows by name
        self._is_known = False  # a row was read

        # The header of CSV, as in a file: a name that comes again has a number.
        self._dialect = NO_DIALECT
        self._header: list[str] | None = None
        self._header_line = ""
        self._doubled: dict[str, str] = {}  # names without the number, by those with it
        self._named: Named = {}  # columns that name others

        # A row of each joint.
        self._joint = ""  # the column that says whose numbers a row holds
        self._gathered: dict[str, Any] = {}  # of the joints that came

        self._now = 0.0  # when the newest line came
        self._lacks_since = math.inf  # when the first line came that lacks columns
        self._lacking: ValueError | None = None  # what all publishers lack up to now
        self._aside: float | None = None  # stamp of the last row, if it was left out [s]

    def begin(self) -> None:
        """Begin anew with the clock; columns stay."""
        self._pace = Pace(self._spec.dt)

    def rows(self, lines: Iterable[str]) -> Iterator[tuple[Row, float]]:
        """Yield each row, and when its line came, by ``time.perf_counter`` [s].

        A line that is no row has a ``problem``: whatever somebody sends, it must not end a watch.
        """
        for line in filter(str.strip, lines):
            arrival = self._now = time.perf_counter()
            self.line += 1
            try:
                row = self._row_of(line)
            except Exception as error:
                row = self._problem(error)
            if row is not None:
                yield row, arrival
        if self._lacking is not None and not self._is_known:
            yield self._problem(self._lacking), self._now

    def _problem(self, error: Exception) -> Row:
        """Return a line that is no row."""
        kind = "no row of numbers"
        if self._header is None and not self._is_known:
            kind += ", and no header"
        missing = np.full(self._spec.size, np.nan)
        return Row(numbers=missing, read=False, problem=f"line {self.line} is {kind}: {error}")

    def _row_of(self, line: str) -> Row | None:
        """Return the row of a line; None of a header, or if more joints or publishers are to come.

        Raises:
            ValueError: it is no row.
        """
        if self._is_header(line):
            return None
        given = self._numbers_and_stamp(line)
        if given is None:
            return None
        numbers, stamp = given
        if numbers.shape != (self._spec.size,):
            raise ValueError(
                f"it must hold {self._spec.size} numbers, got the shape {numbers.shape}"
            )
        self._is_known = True
        if stamp is None:
            return Row(numbers=numbers)
        return self._stamped(numbers, stamp)

    def _stamped(self, numbers: NDArray[np.float64], stamp: float) -> Row:
        """Return a row at its place in time; one that came late is left out."""
        aside = self._aside
        self._aside = None
        problem = ""
        try:
            lost = self._pace.lost(stamp)
        except ClockWentBack as error:
            problem = str(error)
            if aside is None or not 0 < stamp - aside <= LONGEST_STEP_S:
                self._aside = stamp
                problem += ": the row is left out (--clock NAME chooses)"
                return Row(numbers=numbers, read=False, stamp=stamp, problem=problem)
            self.begin()
            lost = self._pace.lost(stamp)
        return Row(
            numbers=numbers,
            lost=lost or 0,
            read=lost is not None,
            stamp=stamp,
            change=self._pace.change,
            problem=problem,
        )

    def _is_header(self, line: str) -> bool:
        """Return whether a line is the header of CSV, and take it up if it is the first."""
        if self._header is not None:
            return line.strip() == self._header_line
        if self._is_known or line.lstrip()[0] in "[{":
            return False

        self._dialect = Dialect.of(line)
        self._header_line = line.strip()
        names = header_of(self._dialect.cells(line))
        header: list[str] = []
        for place, name in enumerate(names):
            unique = name
            if name in header:
                unique = f"{name}{DOUBLED}{names[:place].count(name) + 1}"
                self._doubled[unique] = name
            header.append(unique)
        self._named = named_columns(header)
        if not self._named and not any(map(is_key, header)):
            ColumnMatch(self._schema, header)  # refuses a header that lacks columns at once
        self._header = header
        return True

    def _numbers_and_stamp(self, line: str) -> tuple[NDArray[np.float64], float | None] | None:
        """Return the numbers of a row (D,) and its stamp [s], None without one; or None: more is to come."""
        if self._header is not None:
            return self._read_cells(self._cells_of_csv(line), self._dialect.number)
        row: Any = json.loads(line)
        if isinstance(row, list):
            return np.asarray(row, np.float64), None
        cells = flat_row(row)
        for channel in self._spec.channels:
            part = row.get(channel.name)
            is_list = isinstance(part, list) and f"{channel.name}[0]" in cells
            if is_list and len(part) != channel.size:
                raise ValueError(
                    f"{channel.name} must hold {channel.size} numbers, got {len(part)}"
                )
        return self._read_cells(cells, _number)

    def _cells_of_csv(self, line: str) -> dict[str, str]:
        """Return the cells of a line by the names of the header."""
        assert self._header is not None
        cells = self._dialect.cells(line)
        check_cells(cells, len(self._header), "it has")
        given = dict(zip(self._header, map(self._dialect.plain, cells), strict=False))
        for name, first in self._doubled.items():
            is_read = self._match is not None and name in self._match.headers
            if given[name] != given[first] and not is_read:
                raise ValueError(f"its columns of the same name differ: {first!r}")
        return given

    def _read_cells(
        self, cells: Mapping[str, Any], number: Callable[[Any], float]
    ) -> tuple[NDArray[np.float64], float | None] | None:
        """Return the numbers and the stamp of a row by name; a number that it lacks is NaN."""
        message = self._all_joints(named_row(cells, self._named) if self._named else cells)
        if message is None:
            return None
        match = self._match or ColumnMatch(self._schema, message, whole=False)
        present = [name for name in match.headers if name in message]
        row = self._publishers.row(message, present, self._now)
        if row is None or not self._is_whole(row, bool(present)):
            return None
        assert self._match is not None
        numbers = {name: number(row[name]) for name in self._match.headers if name in row}
        stamp = self._clock.stamp(row)
        if stamp is not None:
            first = self._clock.told_unit(stamp)
            if first is not None:
                self.begin()
                self._pace.lost(first)
                stamp = self._clock.stamp(row)
        return self._match.row(numbers), stamp

    def _is_whole(self, row: Mapping[str, Any], has_numbers: bool) -> bool:
        """Return whether all columns of the schema are there; another publisher may add some.

        Raises:
            ValueError: columns are missing, and no publisher can add them any more.
        """
        if self._match is not None:
            return True
        self._lacks_since = min(self._lacks_since, self._now)
        try:
            match = ColumnMatch(self._schema, row)
        except ValueError as error:
            if not has_numbers or self._now - self._lacks_since > self._publishers.silence:
                raise
            self._lacking = error
            return False
        self._clock.find(row, match.headers)
        self._match = match
        self._lacking = None
        return True

    def _all_joints(self, row: Mapping[str, Any]) -> Mapping[str, Any] | None:
        """Return the row of all joints, if rows are of one joint each; None while more are to come."""
        if self._match is None:
            labels = self._spec.labels
            joints = {label.partition("[")[2].rstrip("]") for label in labels if "[" in label}
            keys = [name for name in row if is_key(name) and str(row[name]).strip() in joints]
            self._joint = keys[0] if keys else ""
        if not self._joint:
            return row
        return self._gather(row)

    def _gather(self, row: Mapping[str, Any]) -> Mapping[str, Any] | None:
        """Return the row of all joints once it is complete, or one of a later moment comes."""
        joint = str(row[self._joint]).strip()
        own = {}
        for name, value in row.items():
            if name != self._joint:
                own[name if is_clock(name) else element_name(name, joint)] = value

        before = self._gathered
        has_joint = any(name in before and not is_clock(name) for name in own)
        if has_joint or self._is_later(before, row):
            self._gathered = own
            return before
        self._gathered = own | before  # the time is that of the first
        if not set(self._spec.labels) <= {split_unit(name)[0] for name in self._gathered}:
            return None
        whole = self._gathered
        self._gathered = {}
        return whole

    def _is_later(self, before: Mapping[str, Any], row: Mapping[str, Any]) -> bool:
        """Return whether a row is of a later moment than the joints before it."""
        clock = LiveClock(self._schema, "")
        clock.find(row, ())
        stamps = [clock.stamp(before), clock.stamp(row)]
        if stamps[0] is None or stamps[1] is None:
            return False
        return stamps[1] - stamps[0] > 0.5 * self._spec.dt


def _number(value: Any) -> float:
    """Return a number of JSON, NaN of null."""
    if value is None:
        return math.nan
    return float(value)
