"""Infer the schema of logs, once, from the first of them: by names, by options, and by what columns do.

    label     by its name and whole numbers or words, or --label
    clock     the clock of the rows, and other clocks
    ignored   --ignore; not among --channels; holds words or nothing
    unclear   numbers with words among them, or one name twice with other numbers: the user decides
    constant  never moves, and stands alone            copy     equals another column
    counter   counts rows, or goes on as the clock does
    command   by its name, or --action                 sense    all others

``--channels`` reads what was set aside by what it does.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from asm_gym.data.clock import LogClock
from asm_gym.data.clock_inference import clocks_among, infer_clock
from asm_gym.data.column_behaviour import (
    FEWEST,
    counts,
    is_constant,
    is_second_clock,
    missing_value_sentinel,
    wrap_period,
)
from asm_gym.data.names import (
    COUNTERS,
    SENSE_NAME,
    UNITS,
    element_of,
    is_command,
    is_label,
    split_unit,
)
from asm_gym.data.reader_notes import note
from asm_gym.data.schema import (
    CLOCK,
    COMMAND,
    CONSTANT,
    COPY,
    COUNTER,
    IGNORED,
    LABEL,
    RATE_TOLERANCE,
    RESAMPLED,
    SENSE,
    UNCLEAR,
    ColumnMatch,
    LogColumn,
    LogSchema,
    are_whole,
)
from asm_gym.data.tables import Columns, is_numeric
from asm_gym.data.text import DOUBLED, numbers_in
from asm_gym.data.timing import recordings, timing_of
from asm_gym.readings import noise_of
from asm_gym.validation import check_number

Floats = NDArray[np.float64]

# Reasons of roles.
READ_IT = "; --channels reads it"
BY_NAME = "commanded, by its name"
BY_ACTION = "by --action"
BY_IGNORE = "by --ignore"
NOT_CHOSEN = "not among --channels"

SLOWEST_HZ = 1e-6  # the least rate of a log [Hz]: a row in eleven days
MOSTLY_NUMBERS = 0.5  # share of numbers from which on words among them are a mistake


@dataclass(frozen=True, kw_only=True)
class SchemaHints:
    """What a user says of logs before their schema is inferred.

    Args:
        rate: rows a second, whatever the clock says [Hz].
        clock: name of the column of times, perhaps with a unit behind it; by default the steadiest.
        channels: patterns of the columns that are read; all senses and commands if empty.
        action: patterns of the columns that were commanded; by their names if empty.
        labels: patterns of the columns that label faults, beside those that are called so.
        ignore: patterns of the columns that are left out.
        columns: names of the columns of files without a header.
        stated_rate: rows a second that the files themselves state [Hz].
    """

    rate: float | None = None
    clock: str = ""
    channels: Sequence[str] = ()
    action: Sequence[str] = ()
    labels: Sequence[str] = ()
    ignore: Sequence[str] = ()
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
        for pattern in self.labels:
            schema = schema.with_column(pattern, role=LABEL)
        for pattern in self.ignore:
            schema = schema.with_column(pattern, role=IGNORED)
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
        tables: the first logs, as ``asm_gym.data.tables.laid_out`` returns them.
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
    try:
        cuts = [] if clock is None else recordings(clock.times(table).seconds)
    except (ValueError, KeyError):
        cuts = []
    if len(cuts) < 2:
        return [table]
    note(f"time begins anew or leaps {len(cuts) - 1} times, and the log is cut there")
    return [{name: values[start:stop] for name, values in table.items()} for start, stop in cuts]


def _rate_and_clock(
    table: Columns,
    clock: LogClock | None,
    hints: SchemaHints,
) -> tuple[float, LogClock | None]:
    """Return the rows a second [Hz], 0 if nothing tells, and the clock if it is to be read."""
    said = hints.rate or hints.stated_rate or 0.0
    try:
        dt = None if clock is None else timing_of(table, clock).dt
    except ValueError:
        if hints.rate is None:
            raise
        return hints.rate, None
    if dt is None or clock is None:
        return said, None

    own = float(f"{1 / dt:.6g}")
    if hints.rate is None:
        stated = hints.stated_rate or own
        return (stated if abs(own / stated - 1) <= RATE_TOLERANCE else own), clock
    if 1 / RESAMPLED <= own / hints.rate <= RESAMPLED:
        return hints.rate, clock
    note(
        f"the clock {clock.name!r} says {own:.4g} rows a second: by --rate {hints.rate:g} it is "
        "not read"
    )
    return hints.rate, None


def classify_columns(
    tables: Sequence[Columns],
    clock: LogClock | None,
    hints: SchemaHints,
) -> list[LogColumn]:
    """Return what each column of the first table is, by what it does in all tables.

    Raises:
        ValueError: a pattern of ``channels`` or ``action`` matches no column.
    """
    first = tables[0]
    columns = _named_columns(first)
    clock_columns = () if clock is None else clock.columns
    senses = [column for header, column in columns.items() if header not in clock_columns]
    for pattern in (*hints.channels, *hints.action):
        check_pattern(pattern, senses)

    times = [_times_of(table, clock) for table in tables]
    stamps = {name for other in clocks_among(first) for name in other.columns}
    originals: dict[tuple[int, ...], str] = {}  # names of columns by their cells in all tables
    classified = []
    for header, column in columns.items():
        values = first[header]
        role, reason = _role_by_name(header, column, values, hints)
        if header in clock_columns:
            role, reason = CLOCK, clock.reason if clock else ""
        elif role == SENSE and header in stamps and not hints.channels:
            role, reason = CLOCK, f"another clock{READ_IT}"
        column = replace(column, role=role, reason=reason)
        if role == SENSE:
            same_column = [t[header] for t in tables if header in t and is_numeric(t[header])]
            if not _is_chosen(column, hints):
                column = _by_behaviour(column, same_column, times)
                column = _unless_copy(column, same_column, originals)
            if column.role == SENSE:
                column = _as_number(column, same_column)
        classified.append(column)
    return _with_commands(_with_still_elements(classified), hints)


def check_pattern(pattern: str, columns: Iterable[LogColumn]) -> None:
    """Raise ValueError if no column is called so."""
    columns = list(columns)
    if not any(column.matches(pattern) for column in columns):
        names = ", ".join(column.name for column in columns) or "none"
        raise ValueError(f"no column of these channels is called {pattern!r}; there are: {names}")


def _is_chosen(column: LogColumn, hints: SchemaHints) -> bool:
    """Return whether the user names a column as one to be read."""
    return any(column.matches(pattern) for pattern in (*hints.channels, *hints.action))


def _times_of(table: Columns, clock: LogClock | None) -> Floats:
    """Return when rows were sensed (T,) [s]; their numbers if no clock tells."""
    if clock is not None and set(clock.columns) <= set(table):
        return clock.times(table).seconds
    return np.arange(len(next(iter(table.values()), ())), dtype=np.float64)


def _named_columns(table: Columns) -> dict[str, LogColumn]:
    """Return the columns by their headers, with unit, channel and element."""
    names = {header: split_unit(header) for header in table}
    elements = {}
    for header, (name, _) in names.items():
        element = element_of(name)
        if element is not None and is_numeric(table[header]):
            elements[header] = element
    sizes = Counter(element.channel for element in elements.values())
    bare_names = {name for name, _ in names.values()}

    columns = {}
    for header, (name, unit) in names.items():
        column = LogColumn(name=name, unit=unit, channel=name)
        element = elements.get(header)
        is_one_of_several = element is not None and (element.named or sizes[element.channel] > 1)
        if element is not None and is_one_of_several and element.channel not in bare_names:
            column = replace(column, channel=element.channel, element=element.name)
        columns[header] = column
    return columns


def _role_by_name(
    header: str, column: LogColumn, values: NDArray[Any], hints: SchemaHints
) -> tuple[str, str]:
    """Return the role of a column by options, its name and the kind of its cells, and why."""
    if any(column.matches(pattern) or header == pattern for pattern in hints.ignore):
        return IGNORED, BY_IGNORE
    is_called_label = is_label(column.name) and are_whole(values)
    is_said_label = any(column.matches(pattern) for pattern in hints.labels)
    if (is_called_label or is_said_label) and column.name not in hints.channels:
        return LABEL, f"rows it marks are not learned from{READ_IT}"
    if hints.channels and not any(column.matches(pattern) for pattern in hints.channels):
        return IGNORED, NOT_CHOSEN
    if DOUBLED in header:
        other = header.partition(DOUBLED)[0]
        return UNCLEAR, (
            f"differs from another column of the name {other!r}; --ignore '{header}' leaves it out"
        )
    if not is_numeric(values):
        return _role_of_text(column, values)
    if not np.isfinite(values).any():
        return IGNORED, "holds no number"
    return SENSE, ""


def _role_of_text(column: LogColumn, values: NDArray[Any]) -> tuple[str, str]:
    """Return the role of a column of dates, of words, or of numbers with words among them."""
    if values.dtype.kind in "Mm":
        return CLOCK, f"another clock{READ_IT}"
    filled = np.array([bool(str(cell).strip()) for cell in values], np.bool_)
    is_number = np.isfinite(numbers_in(values))
    if not filled.any():
        return IGNORED, "holds nothing"
    if is_number[filled].mean() < MOSTLY_NUMBERS:
        return IGNORED, "holds words"
    row = int(np.argmax(filled & ~is_number))
    return UNCLEAR, (
        f"must hold numbers, got {str(values[row])[:40]!r} in row {row + 1}; "
        f"--ignore '{column.name}' leaves it out"
    )


def _by_behaviour(
    column: LogColumn, tables: Sequence[NDArray[Any]], times: Sequence[Floats]
) -> LogColumn:
    """Return a column with the role that its numbers in every table show."""
    moving = [values for values in tables if not is_constant(values)]
    if not moving:
        return replace(column, role=CONSTANT, reason=f"never moves{READ_IT}")
    if column.unit in UNITS or SENSE_NAME.fullmatch(column.name):
        return column

    fewest = 2 if column.name.lower() in COUNTERS else FEWEST
    for direction, sign in (("rises", 1.0), ("falls", -1.0)):
        if all(_goes_on(sign * values, times, fewest) for values in moving):
            return replace(column, role=COUNTER, reason=f"{direction} by a constant{READ_IT}")
    return column


def _goes_on(values: NDArray[Any], times: Sequence[Floats], fewest: int) -> bool:
    """Return whether a column counts, or goes on as a clock of the same length does."""
    if counts(values, fewest):
        return True
    return any(len(values) == len(t) and is_second_clock(values, t) for t in times)


def _unless_copy(
    column: LogColumn, tables: Sequence[NDArray[Any]], originals: dict[tuple[int, ...], str]
) -> LogColumn:
    """Return a sense as a copy if another one has the same numbers in every table."""
    cells = tuple(hash(np.ascontiguousarray(v, np.float64).tobytes()) for v in tables)
    original = originals.setdefault(cells, column.name)
    is_copy = original != column.name and is_command(original) == is_command(column.name)
    if column.role == SENSE and is_copy:
        return replace(column, role=COPY, reason=f"equals {original}{READ_IT}")
    return column


def _as_number(column: LogColumn, tables: Sequence[NDArray[Any]]) -> LogColumn:
    """Return a sense with the turn of its angle and its number for missing data."""
    reasons = []
    wrap = max(wrap_period(values, column.unit) for values in tables)
    if wrap:
        reasons.append(f"turns over at {wrap:g}: read as its sine and cosine")
    missing = None
    for values in tables:
        sentinel = missing_value_sentinel(values)
        if not math.isnan(sentinel):
            missing = sentinel
            reasons.append(f"{sentinel:g} is taken for missing data")
            break
    return replace(column, wrap=wrap, missing=missing, reason="; ".join(reasons))


def _with_still_elements(columns: list[LogColumn]) -> list[LogColumn]:
    """Return the columns with joints that stand, or turn steadily, read beside others that move."""
    moving = {column.channel for column in columns if column.is_read and column.element}
    nothing_else = not any(column.is_read for column in columns)
    kept = []
    for column in columns:
        if column.role in (CONSTANT, COUNTER) and (nothing_else or column.channel in moving):
            reason = ""
            if not nothing_else:
                reason = f"{column.reason.removesuffix(READ_IT)}, beside others that do not"
            column = replace(column, role=SENSE, reason=reason)
        kept.append(column)
    return kept


def _with_commands(columns: list[LogColumn], hints: SchemaHints) -> list[LogColumn]:
    """Return the columns with the role of those that were commanded."""
    read = [column for column in columns if column.role == SENSE]
    if hints.action:
        commanded = {c.name for c in read for p in hints.action if c.matches(p)}
        reason = BY_ACTION
    else:
        sensed = {column.channel for column in read if not is_command(column.name)}
        commanded = {column.name for column in read if sensed and column.channel not in sensed}
        reason = BY_NAME
    marked = []
    for column in columns:
        if column.role == SENSE and column.name in commanded:
            column = replace(column, role=COMMAND, reason=column.reason or reason)
        marked.append(column)
    return marked


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
        others = f" and {len(names) - 6} others" if len(names) > 6 else ""
        note(f"left out: {', '.join(names[:6])}{others}: {reason}")


def _with_noise(schema: LogSchema, tables: Sequence[Columns]) -> LogSchema:
    """Return a schema whose columns have the median of their noise in the tables."""
    columns = []
    for column in schema.columns:
        noise = [0.0]
        if column.is_read:
            noise = [_noise_in(table, column) for table in tables]
        columns.append(replace(column, noise=float(np.median(noise))))
    return replace(schema, columns=tuple(columns))


def _noise_in(table: Columns, column: LogColumn) -> float:
    """Return the noise of a column in a table; 0 if it cannot be read there."""
    alone = LogSchema((column,), 1.0)
    with suppress(ValueError):
        numbers = ColumnMatch(alone, table).rows(table)
        return float(np.median([noise_of(values) for values in numbers.T]))
    return 0.0
