"""Infer the schema of logs, once, from the first of them.

clock     by names and by what columns hold (``asm_gym.data.clock_inference``)
rate      --rate, or what the file states, or the mean of the clock
columns   the role of each (``asm_gym.data.column_roles``)
noise     the median of a column's noise in the first logs
"""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, replace

import numpy as np

from asm_gym.data.clock import LogClock
from asm_gym.data.clock_inference import infer_clock
from asm_gym.data.column_match import ColumnMatch
from asm_gym.data.column_roles import (
    BY_ACTION,
    BY_IGNORE,
    BY_NAME,
    NOT_CHOSEN,
    RoleHints,
    classify_columns,
)
from asm_gym.data.log_column import CLOCK, IGNORED, LABEL, LogColumn
from asm_gym.data.reader_notes import listed, note
from asm_gym.data.schema import RATE_TOLERANCE, LogSchema, can_resample
from asm_gym.data.table_layout import Columns
from asm_gym.data.timing import recordings, timing_of
from asm_gym.readings import noise_of
from asm_gym.validation import check_number

SLOWEST_HZ = 1e-6  # the least rate of a log [Hz]: a row in eleven days


@dataclass(frozen=True, kw_only=True)
class SchemaHints(RoleHints):
    """What a user says of logs before their schema is inferred, beside the roles of columns.

    Args:
        rate: rows a second, whatever the clock says [Hz].
        clock: name of the column of times, perhaps with a unit behind it; by default the steadiest.
        columns: names of the columns of files without a header.
        stated_rate: rows a second that the files themselves state [Hz].
    """

    rate: float | None = None
    clock: str = ""
    columns: Sequence[str] = ()
    stated_rate: float | None = None

    def __post_init__(self) -> None:
        if self.rate is not None:
            check_number("rate", self.rate, low=SLOWEST_HZ)

    def apply(self, schema: LogSchema) -> LogSchema:
        """Return a schema with what the user says of the clock, of labels and of what to ignore.

        Raises:
            ValueError: logs of this rate cannot be read with the schema.
        """
        chosen = [LogColumn(name=pattern, role=IGNORED) for pattern in self.ignore]
        chosen += [LogColumn(name=pattern, role=LABEL) for pattern in self.labels]
        patterns = (*self.ignore, *self.labels)
        others = [column for column in schema.columns if column.name not in patterns]
        schema = replace(schema, columns=(*chosen, *others))
        if self.clock:
            return replace(schema, find_clock=self.clock)
        if self.rate is None:
            return schema
        if abs(self.rate / schema.rate - 1) > RATE_TOLERANCE:
            raise ValueError(
                f"the memory reads {schema.rate:.4g} rows a second, these come at {self.rate:.4g}"
            )
        return replace(schema, clock=None, find_clock=None)


def infer_schema(tables: Sequence[Columns], hints: SchemaHints) -> LogSchema:
    """Return the schema of logs of one robot.

    Args:
        tables: the first logs, as ``asm_gym.data.table_layout.laid_out`` returns them.
        hints: what the user says.

    Raises:
        ValueError: an option names no column, or no clock can be read.
    """
    clock = find_clock(tables[0], hints)
    parts = [part for table in tables for part in recordings_in(table, clock)]
    rate, clock = _rate_and_clock(parts[0], clock, hints)
    columns = classify_columns(parts, clock, hints)
    return _with_noise(LogSchema(tuple(columns), rate, clock), parts)


def find_clock(table: Columns, hints: SchemaHints) -> LogClock | None:
    """Return the clock of a table; None if it has none, or one that cannot be read and a rate is said."""
    try:
        return infer_clock(table, hints.clock)
    except ValueError:
        if hints.rate is None or hints.clock:
            raise
        return None


def recordings_in(table: Columns, clock: LogClock | None) -> list[Columns]:
    """Return a table cut where its clock begins anew or leaps."""
    cuts: list[tuple[int, int]] = []
    if clock is not None:
        with suppress(ValueError, KeyError):
            cuts = recordings(clock.times(table).seconds)
    if len(cuts) < 2:
        return [table]
    note(f"time begins anew or leaps {len(cuts) - 1} times, and the log is cut there")
    return [{name: values[start:stop] for name, values in table.items()} for start, stop in cuts]


def _rate_and_clock(
    table: Columns, clock: LogClock | None, hints: SchemaHints
) -> tuple[float, LogClock | None]:
    """Return the rows a second [Hz], 0 if nothing tells, and the clock if it is to be read."""
    stated = hints.rate or hints.stated_rate or 0.0
    if clock is None:
        return stated, None
    try:
        dt = timing_of(table, clock).dt
    except ValueError:
        if hints.rate is None:
            raise
        return hints.rate, None
    if dt is None:
        return stated, None

    own = float(f"{1 / dt:.6g}")
    if hints.rate is None:
        if stated and abs(own / stated - 1) <= RATE_TOLERANCE:
            return stated, clock
        return own, clock
    if can_resample(own / hints.rate):
        return hints.rate, clock
    note(
        f"the clock {clock.name!r} says {own:.4g} rows a second: by --rate {hints.rate:g} it is "
        "not read"
    )
    return hints.rate, None


def note_columns(schema: LogSchema) -> None:
    """Tell the user which columns are left out, which are read in another way, and why."""
    left_out: dict[str, list[str]] = {}
    for column in schema.columns:
        if column.is_read:
            if column.reason not in ("", BY_NAME, BY_ACTION):
                note(f"{column.name}: {column.reason}")
        elif column.role != CLOCK and column.reason not in (BY_IGNORE, NOT_CHOSEN):
            left_out.setdefault(column.reason, []).append(column.name)
    for reason, names in left_out.items():
        note(f"left out: {listed(names)}: {reason}")


def _with_noise(schema: LogSchema, tables: Sequence[Columns]) -> LogSchema:
    """Return a schema whose columns have the median of their noise in the tables."""
    columns = []
    for column in schema.columns:
        noise = [0.0]
        if column.is_read:
            noise = [_noise_in(table, column) for table in tables]
        columns.append(replace(column, noise=float(f"{np.median(noise):.3g}")))
    return replace(schema, columns=tuple(columns))


def _noise_in(table: Columns, column: LogColumn) -> float:
    """Return the noise of a column in a table; 0 if it cannot be read there."""
    alone = LogSchema((column,), 1.0)
    with suppress(ValueError):
        numbers = ColumnMatch(alone, table).rows(table)
        return float(np.median([noise_of(values) for values in numbers.T]))
    return 0.0
