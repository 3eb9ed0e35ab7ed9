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
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from asm_gym.data.column_match import ColumnMatch
from asm_gym.data.csv_lines import CsvLines
from asm_gym.data.joint_rows import JointRows
from asm_gym.data.live_clock import LONGEST_STEP_S, ClockWentBack, LiveClock, Pace
from asm_gym.data.publishers import Publishers
from asm_gym.data.schema import LogSchema
from asm_gym.data.table_layout import MOST_COLUMNS
from asm_gym.data.text_files import flat_row

# What a line that is no row is.
NO_ROW = "no row of numbers"
OTHER_HEADER = "another robot's header"


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


class _Reading(NamedTuple):
    """What a line holds."""

    numbers: NDArray[np.float64]  # (D,)
    stamp: float | None  # by the robot's own clock; None without one [s]


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
        self._joints = JointRows(schema)
        self._publishers = Publishers(silence)
        self._csv: CsvLines | None = None
        self._match: ColumnMatch | None = None  # of rows by name
        self._is_known = False  # a row was read

        self._now = 0.0  # when the newest line came
        self._lacks_since = math.inf  # when the first line came that lacks columns
        self._lacking: ValueError | None = None  # what all publishers lack up to now
        self._left_out_stamp: float | None = None  # stamp of the last row, if it was left out [s]

    def begin(self) -> None:
        """Begin anew with the clock; columns stay."""
        self._pace = Pace(self._spec.dt)

    def rows(self, lines: Iterable[str], first_s: float = math.inf) -> Iterator[tuple[Row, float]]:
        """Yield each row, and when its line came, by ``time.perf_counter`` [s].

        A line that is no row has a ``problem``: whatever somebody sends, it must not end a watch.

        Args:
            lines: of a source; empty ones say that time goes on.
            first_s: how long the first row may take [s]; each other may take as long as the silence.

        Raises:
            SourceDied: lines came, and no row for too long.
        """
        newest = time.monotonic()
        limit = first_s
        for line in lines:
            if line.strip():
                arrival = self._now = time.perf_counter()
                row = self._row_or_problem(line)
                if row is not None:
                    yield row, arrival
                if row is not None and not row.problem:
                    newest = time.monotonic()
                    limit = self._publishers.silence
            if time.monotonic() - newest > limit:
                raise SourceDied(f"no row came for {limit:g} s")
        if self._lacking is not None and not self._is_known:
            yield self._problem(self._lacking), self._now

    def _row_or_problem(self, line: str) -> Row | None:
        """Return the row of a line, or what is wrong with it; None if more is to come."""
        self.line += 1
        try:
            return self._row_of(line)
        except Exception as error:  # anybody may have sent it: deep, huge or broken
            header = _header_in(line)
            if header is None:
                return self._problem(error)
            return self._begin_anew(header, error)

    def _problem(self, error: Exception, kind: str = NO_ROW) -> Row:
        """Return a line that is no row."""
        if kind == NO_ROW and self._csv is None and not self._is_known:
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
        reading = self._reading(line)
        if reading is None:
            return None
        size = self._spec.size
        shape = reading.numbers.shape
        if shape != (size,):
            raise ValueError(f"it must hold {size} numbers, got the shape {shape}")
        self._is_known = True
        if reading.stamp is None:
            return Row(numbers=reading.numbers)
        return self._stamped(reading.numbers, reading.stamp)

    def _stamped(self, numbers: NDArray[np.float64], stamp: float) -> Row:
        """Return a row at its place in time; one that came late is left out."""
        left_out_stamp = self._left_out_stamp
        self._left_out_stamp = None
        problem = ""
        try:
            lost = self._pace.rows_lost_before(stamp)
        except ClockWentBack as error:
            problem = str(error)
            agrees = left_out_stamp is not None and 0 < stamp - left_out_stamp <= LONGEST_STEP_S
            if not agrees:
                self._left_out_stamp = stamp
                problem += ": the row is left out (--clock NAME chooses)"
                return Row(numbers=numbers, read=False, stamp=stamp, problem=problem)
            # The second late row agrees with the first: the clock was set anew.
            self.begin()
            lost = self._pace.rows_lost_before(stamp)
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
        if self._csv is not None:
            return line.strip() == self._csv.header
        if self._is_known or _is_json(line):
            return False
        csv = CsvLines(line)
        if csv.names_all_columns:
            ColumnMatch(self._schema, csv.names)  # refuses a header that lacks columns at once
        self._csv = csv
        return True

    def _begin_anew(self, header: CsvLines, error: Exception) -> Row | None:
        """Take up a header with all columns of the schema; return any other as a line that is no row.

        Args:
            header: the line, read as a header.
            error: why it is no row.
        """
        try:
            ColumnMatch(self._schema, header.names)
        except Exception as lacking:  # no line may end a watch
            if header.is_of_words:
                return self._problem(lacking, OTHER_HEADER)
            return self._problem(error)
        self._csv = header
        self._match = None
        return None

    def _reading(self, line: str) -> _Reading | None:
        """Return the numbers and the stamp of a row; None if more of it is to come."""
        if line.count(",") > MOST_COLUMNS:
            raise ValueError(f"it holds more than {MOST_COLUMNS} values")
        if self._csv is not None and not _is_json(line):
            read: Sequence[str] = ()
            if self._match is not None:
                read = self._match.headers
            return self._read_cells(self._csv.cells(line, read), self._csv.dialect.number)

        row: Any = json.loads(line)
        if isinstance(row, list):
            return _Reading(np.asarray(row, np.float64), None)
        cells = flat_row(row)
        for channel in self._spec.channels:
            part = row.get(channel.name)
            is_list = isinstance(part, list) and f"{channel.name}[0]" in cells
            if is_list and len(part) != channel.size:
                raise ValueError(
                    f"{channel.name} must hold {channel.size} numbers, got {len(part)}"
                )
        return self._read_cells(cells, _number)

    def _read_cells(
        self, cells: Mapping[str, Any], number: Callable[[Any], float]
    ) -> _Reading | None:
        """Return the numbers and the stamp of a row by name; a number that it lacks is NaN."""
        if self._match is None:
            self._joints.find(cells)
        message = self._joints.complete_row(cells)
        if message is None:
            return None
        match = self._match or ColumnMatch(self._schema, message, whole=False)
        present = [name for name in match.headers if name in message]
        if not present and self._match is not None:
            return None  # of a publisher whose numbers are not read
        row = self._publishers.row(message, present, self._now)
        if row is None or not self._match_columns(row, bool(present)):
            return None
        assert self._match is not None
        numbers = {name: number(row[name]) for name in self._match.headers if name in row}
        return _Reading(self._match.row(numbers), self._stamp(row))

    def _stamp(self, row: Mapping[str, Any]) -> float | None:
        """Return the stamp of a row [s], by a unit that it may be the first to tell."""
        stamp = self._clock.stamp(row)
        if stamp is None:
            return None
        first = self._clock.first_in_new_unit(stamp)
        if first is None:
            return stamp
        # The unit was wrong up to now: count the rows anew, from the first stamp in the new unit.
        self.begin()
        self._pace.rows_lost_before(first)
        return self._clock.stamp(row)

    def _match_columns(self, row: Mapping[str, Any], has_numbers: bool) -> bool:
        """Find the columns of the schema in a row; return whether all are there.

        Another publisher may add some.

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


def _header_in(line: str) -> CsvLines | None:
    """Return a line read as a header; None of what can be none."""
    if _is_json(line) or line.count(",") > MOST_COLUMNS:
        return None
    try:
        return CsvLines(line)
    except Exception:  # csv.Error is no ValueError, and no line may end a watch
        return None


def _is_json(line: str) -> bool:
    """Return whether a line begins as an object or a list does."""
    return line.lstrip()[0] in "[{"


def _number(value: Any) -> float:
    """Return a number of JSON, NaN of null."""
    if value is None:
        return math.nan
    return float(value)
