"""Find the columns of a schema in a table or a line, and make the numbers of a stream of their cells.

number of a stream   x = scale · ratio(unit of the header, unit) · cell, NaN if the cell is ``missing``
wrapped angle        sin(2π x / wrap) and cos(2π x / wrap)
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from asm_gym.data.column_names import TAU, factor, label_of, split_unit
from asm_gym.data.log_column import LogColumn
from asm_gym.data.table_layout import Columns, is_numeric

if TYPE_CHECKING:
    from asm_gym.data.schema import LogSchema


class ColumnMatch:
    """Find the numbers of a stream's row among the columns of a table or the names of a line.

    A column is found by its name, or by the stream's label. Where the numbers of a channel have no
    names, they are also found by place in a list.

    Args:
        schema: how logs are read.
        names: of the columns that are there, perhaps with units.
        whole: all columns of the schema must be there.

    Attributes:
        headers: names of the columns that were found.

    Raises:
        ValueError: columns are missing, or of another unit.
    """

    def __init__(self, schema: LogSchema, names: Iterable[str], whole: bool = True) -> None:
        by_name = _headers_by_name(names)
        self.headers: list[str] = []
        self._columns: list[LogColumn] = []
        scales = []
        sentinels = []
        lacking = []
        for column, place in _with_places(schema.stream_columns, by_name):
            candidates = (column.name, column.label, place)
            headers = [by_name[name] for name in candidates if name in by_name]
            if not headers:
                lacking.append(column.label)
                continue
            name, unit = split_unit(headers[0])
            units = factor(name, unit, column.unit or "1")
            self.headers.append(headers[0])
            self._columns.append(column)
            scales.append(column.scale * units)
            sentinels.append(column.missing)
        if lacking and whole:
            raise ValueError(_what_is_missing(lacking, schema, by_name))
        self._scales = np.array(scales)
        self._sentinels = np.array(sentinels, np.float64)  # None becomes NaN
        self._wraps = any(column.wrap for column in self._columns)

    def row(self, values: Mapping[str, Any]) -> NDArray[np.float64]:
        """Return the numbers (D,) of a line, by the names of its columns; NaN of those it lacks."""
        cells = [values.get(header) for header in self.headers]
        return self._numbers(np.array(cells, np.float64))

    def rows(self, table: Columns) -> NDArray[np.float64]:
        """Return the rows (T, D) of a table.

        Raises:
            ValueError: a column holds words.
        """
        cells = []
        for header in self.headers:
            values = table[header]
            if not is_numeric(values):
                raise ValueError(
                    f"{header} must hold numbers, as its schema says, got {values[0]!r}"
                )
            cells.append(values)
        return self._numbers(np.column_stack(cells).astype(np.float64))

    def _numbers(self, cells: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the numbers (..., D) of a stream of those of its columns (..., C)."""
        known = np.where(cells == self._sentinels, np.nan, cells)
        scaled = known * self._scales
        if not self._wraps:
            return scaled
        parts = []
        for place, column in enumerate(self._columns):
            numbers = scaled[..., place]
            if column.wrap:
                angle = numbers * TAU / column.wrap
                parts += [np.sin(angle), np.cos(angle)]
            else:
                parts.append(numbers)
        return np.stack(parts, axis=-1)


def _headers_by_name(names: Iterable[str]) -> dict[str, str]:
    """Return the headers by their names without a unit, and by the labels that these stand for."""
    bare = {split_unit(header)[0]: header for header in names}
    labels = {label_of(name): header for name, header in bare.items()}
    return labels | bare


def _with_places(
    columns: Sequence[LogColumn], by_name: Mapping[str, str]
) -> Iterator[tuple[LogColumn, str]]:
    """Yield each column, and its place in a list of its channel, ``q[1]``, where its numbers have no names.

    Which of several names comes first in a list, nothing tells.
    """
    named = set()  # channels whose numbers have names, or of which a column is there by name
    for column in columns:
        has_name = bool(column.element) and not column.element.isdecimal()
        if has_name or column.name in by_name or column.label in by_name:
            named.add(column.channel)
    count = Counter[str]()
    for column in columns:
        channel = column.channel
        place = ""
        if channel not in named:
            place = f"{channel}[{count[channel]}]"
        count[channel] += 1
        yield column, place


def _what_is_missing(lacking: list[str], schema: LogSchema, by_name: Mapping[str, str]) -> str:
    """Say which columns of a schema are not there, and which are there that it does not know."""
    message = f"the memory reads channels that are not there: {', '.join(lacking)}"
    known = {by_name.get(name) for name in schema.names}
    unknown = set(by_name.values()).difference(known)
    if unknown:
        names = ", ".join(sorted(unknown))
        message += f"; there are, and its schema lacks them: {names[:120]}"
    return message
