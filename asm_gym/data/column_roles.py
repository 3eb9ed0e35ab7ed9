"""Tell the role of each column of logs: by options, by its name, by its cells, and by what it does.

The rules are asked in this order, and the first that says a role gives it:

    clock     the clock of the rows
    ignored   --ignore
    label     by its name and whole numbers or words, or --label
    ignored   not among --channels
    unclear   one name twice with other numbers: the user decides
    clock     a column of dates                    ignored   holds words or nothing
    unclear   numbers with words among them
    clock     another column that is called a clock
    constant  never moves, and stands alone        counter   counts rows, or goes on as the clock does
    copy      equals another column
    command   by its name, or --action             sense     all others

``--channels`` reads what would be set aside by what it does.
"""

from __future__ import annotations

import math
from collections import Counter, defaultdict
from collections.abc import Collection, Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from asm_gym.data.clock import LogClock
from asm_gym.data.clock_inference import clocks_among
from asm_gym.data.column_behaviour import (
    FEWEST_JUDGED_ROWS,
    counts,
    is_constant,
    is_second_clock,
    missing_value_sentinel,
    wrap_period,
)
from asm_gym.data.column_names import (
    BASE_UNITS,
    COUNTERS,
    SENSE_NAME,
    element_of,
    is_command,
    split_unit,
)
from asm_gym.data.log_column import (
    CLOCK,
    COMMAND,
    CONSTANT,
    COPY,
    COUNTER,
    IGNORED,
    LABEL,
    SENSE,
    UNCLEAR,
    LogColumn,
)
from asm_gym.data.schema import is_called_label
from asm_gym.data.table_layout import Columns, is_numeric
from asm_gym.data.text_files import DOUBLED, numbers_in

Floats = NDArray[np.float64]

# Reasons of roles.
READ_IT = "; --channels reads it"
BY_NAME = "commanded, by its name"
BY_ACTION = "by --action"
BY_IGNORE = "by --ignore"
NOT_CHOSEN = "not among --channels"

MOSTLY_NUMBERS = 0.5  # share of numbers from which on words among them are a mistake


@dataclass(frozen=True, kw_only=True)
class RoleHints:
    """What a user says of the roles of columns, as patterns of their names.

    Args:
        channels: columns that are read; all senses and commands if empty.
        action: columns that were commanded; by their names if empty.
        labels: columns that label faults, beside those that are called so.
        ignore: columns that are left out.
    """

    channels: Sequence[str] = ()
    action: Sequence[str] = ()
    labels: Sequence[str] = ()
    ignore: Sequence[str] = ()


def classify_columns(
    tables: Sequence[Columns], clock: LogClock | None, hints: RoleHints
) -> list[LogColumn]:
    """Return what each column of the first table is, by what it does in all tables.

    Raises:
        ValueError: a pattern of ``channels`` or ``action`` matches no column.
    """
    columns = _columns_by_header(tables[0])
    chosen = (*hints.channels, *hints.action)
    own_stamps: Sequence[str] = ()  # columns of the clock
    if clock is not None:
        own_stamps = clock.columns
    others = [column for header, column in columns.items() if header not in own_stamps]
    _check_patterns(chosen, others)

    stamps: set[str] = set()  # columns that are called clocks
    if not hints.channels:
        for clock_columns in clocks_among(tables[0]):
            stamps.update(clock_columns.columns)
    numbers = _numbers_by_header(tables)
    times = [_times_of(table, clock) for table in tables]
    originals: dict[tuple[int, ...], str] = {}  # names of columns by their cells in all tables
    classified = []
    for header, column in columns.items():
        column = _by_name(header, column, tables[0][header], hints)
        column = _by_clock(header, column, clock, stamps)
        if column.role == SENSE and not column.matches(chosen):
            column = _by_behaviour(column, numbers[header], times)
            column = _unless_copy(column, numbers[header], originals)
        if column.role == SENSE:
            column = _as_number(column, numbers[header])
        classified.append(column)
    return _with_commands(_with_still_elements(classified), hints)


def _numbers_by_header(tables: Sequence[Columns]) -> dict[str, list[NDArray[Any]]]:
    """Return the numbers (T,) of each column in every table."""
    numbers: dict[str, list[NDArray[Any]]] = defaultdict(list)
    for table in tables:
        for header, values in table.items():
            if is_numeric(values):
                numbers[header].append(values)
    return numbers


def _check_patterns(patterns: Iterable[str], columns: Sequence[LogColumn]) -> None:
    """Raise ValueError if a pattern names no column."""
    for pattern in patterns:
        if not any(column.matches([pattern]) for column in columns):
            names = ", ".join(column.name for column in columns) or "none"
            raise ValueError(
                f"no column of these channels is called {pattern!r}; there are: {names}"
            )


def _times_of(table: Columns, clock: LogClock | None) -> Floats:
    """Return when rows were sensed (T,) [s]; their numbers if no clock tells."""
    if clock is not None and clock.is_in(table):
        return clock.times(table).seconds
    rows = max(map(len, table.values()), default=0)
    return np.arange(rows, dtype=np.float64)


def _columns_by_header(table: Columns) -> dict[str, LogColumn]:
    """Return the columns by their headers, with unit, channel and element."""
    columns = {}
    elements = {}
    for header, values in table.items():
        name, unit = split_unit(header)
        columns[header] = LogColumn(name=name, unit=unit, channel=name)
        element = element_of(name)
        if element is not None and is_numeric(values):
            elements[header] = element

    sizes = Counter(element.channel for element in elements.values())
    names = {column.name for column in columns.values()}
    for header, element in elements.items():
        is_one_of_several = element.named or sizes[element.channel] > 1
        if is_one_of_several and element.channel not in names:
            columns[header] = replace(
                columns[header], channel=element.channel, element=element.name
            )
    return columns


def _by_name(header: str, column: LogColumn, values: NDArray[Any], hints: RoleHints) -> LogColumn:
    """Return a column with its role by options, its name and the kind of its cells, and why."""
    if header in hints.ignore or column.matches(hints.ignore):
        return replace(column, role=IGNORED, reason=BY_IGNORE)
    is_label = is_called_label(column.name, values) or column.matches(hints.labels)
    if is_label and column.name not in hints.channels:
        return replace(column, role=LABEL, reason=f"rows it marks are not learned from{READ_IT}")
    if hints.channels and not column.matches(hints.channels):
        return replace(column, role=IGNORED, reason=NOT_CHOSEN)
    if DOUBLED in header:
        other = header.partition(DOUBLED)[0]
        reason = (
            f"differs from another column of the name {other!r}; --ignore '{header}' leaves it out"
        )
        return replace(column, role=UNCLEAR, reason=reason)
    if not is_numeric(values):
        return _by_text(column, values)
    if not np.isfinite(values).any():
        return replace(column, role=IGNORED, reason="holds no number")
    return column


def _by_clock(
    header: str, column: LogColumn, clock: LogClock | None, stamps: Collection[str]
) -> LogColumn:
    """Return a column, as a clock if it is that of the rows, or a sense among ``stamps``."""
    if clock is not None and header in clock.columns:
        return replace(column, role=CLOCK, reason=clock.reason)
    if column.role == SENSE and header in stamps:
        return replace(column, role=CLOCK, reason=f"another clock{READ_IT}")
    return column


def _by_text(column: LogColumn, values: NDArray[Any]) -> LogColumn:
    """Return a column of dates, of words, or of numbers with words among them, with its role."""
    if values.dtype.kind in "Mm":
        return replace(column, role=CLOCK, reason=f"another clock{READ_IT}")
    is_filled = np.array([bool(str(cell).strip()) for cell in values], np.bool_)
    if not is_filled.any():
        return replace(column, role=IGNORED, reason="holds nothing")
    is_number = np.isfinite(numbers_in(values))
    if is_number[is_filled].mean() < MOSTLY_NUMBERS:
        return replace(column, role=IGNORED, reason="holds words")
    row = int(np.argmax(is_filled & ~is_number))
    word = str(values[row])[:40]
    reason = (
        f"must hold numbers, got {word!r} in row {row + 1}; --ignore '{column.name}' leaves it out"
    )
    return replace(column, role=UNCLEAR, reason=reason)


def _by_behaviour(
    column: LogColumn, tables: Sequence[NDArray[Any]], times: Sequence[Floats]
) -> LogColumn:
    """Return a column with the role that its numbers in every table show."""
    moving = [values for values in tables if not is_constant(values)]
    if not moving:
        return replace(column, role=CONSTANT, reason=f"never moves{READ_IT}")
    if column.unit in BASE_UNITS or SENSE_NAME.fullmatch(column.name):
        return column

    fewest = FEWEST_JUDGED_ROWS
    if column.name.lower() in COUNTERS:
        fewest = 2
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
    arrays = [np.ascontiguousarray(values, np.float64) for values in tables]
    cells = tuple(hash(array.tobytes()) for array in arrays)
    original = originals.setdefault(cells, column.name)
    are_alike = is_command(original) == is_command(column.name)
    if column.role == SENSE and are_alike and original != column.name:
        return replace(column, role=COPY, reason=f"equals {original}{READ_IT}")
    return column


def _as_number(column: LogColumn, tables: Sequence[NDArray[Any]]) -> LogColumn:
    """Return a sense with the turn of its angle and its number for missing data."""
    reasons = []
    wrap = max(wrap_period(values, column.unit) for values in tables)
    if wrap:
        reasons.append(f"turns over at {wrap:g}: read as its sine and cosine")
    missing = None
    sentinel = missing_value_sentinel(np.concatenate(tables))
    if not math.isnan(sentinel):
        missing = sentinel
        reasons.append(f"{sentinel:g} is taken for missing data")
    return replace(column, wrap=wrap, missing=missing, reason="; ".join(reasons))


def _with_still_elements(columns: list[LogColumn]) -> list[LogColumn]:
    """Return the columns with joints that stand, or turn steadily, read beside others that move."""
    moving = {column.channel for column in columns if column.is_read and column.element}
    nothing_else = not any(column.is_read for column in columns)
    kept = []
    for column in columns:
        reason = f"{column.reason.removesuffix(READ_IT)}, beside others that do not"
        if nothing_else:
            reason = ""
        if column.role in (CONSTANT, COUNTER) and (nothing_else or column.channel in moving):
            column = replace(column, role=SENSE, reason=reason)
        kept.append(column)
    return kept


def _with_commands(columns: list[LogColumn], hints: RoleHints) -> list[LogColumn]:
    """Return the columns with the role of those that were commanded."""
    senses = [column for column in columns if column.role == SENSE]
    if hints.action:
        commanded = {column.name for column in senses if column.matches(hints.action)}
        reason = BY_ACTION
    else:
        sensed = {column.channel for column in senses if not is_command(column.name)}
        commanded = {column.name for column in senses if sensed and column.channel not in sensed}
        reason = BY_NAME
    marked = []
    for column in columns:
        if column.role == SENSE and column.name in commanded:
            column = replace(column, role=COMMAND, reason=column.reason or reason)
        marked.append(column)
    return marked
