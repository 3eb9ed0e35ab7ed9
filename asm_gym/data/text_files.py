"""Read the columns of text: CSV of any country, tables without a header, and JSON lines.

separator   the one of ; tab , | that the header holds most of, or else blanks
decimals    a point; where the separator is no comma, a comma too: 0,1096
header      names, perhaps behind a # or with blanks, below a preamble; without one, columns are named by the caller
units       may stand in a line of their own below the header
twice       a header that comes again is left out; columns of one name are one where they are equal
last line   cut off in the middle: left out, with a note
"""

from __future__ import annotations

import codecs
import csv
import json
import operator
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from asm_gym.data.column_names import element_name
from asm_gym.data.reader_notes import note
from asm_gym.data.table_layout import MOST_COLUMNS, Columns, check_width
from asm_gym.data.text_exports import check_export, with_unit

if TYPE_CHECKING:
    import pandas as pd

LONGEST_WORD = 64  # characters that are kept of a word, of a label or a time
LONGEST_LINE = LONGEST_WORD * MOST_COLUMNS  # characters of a line
LONGEST_UNIT = 12  # characters of a unit
SEPARATORS = ";\t,|"
FLAGS = {"true": 1.0, "false": 0.0}
MISSING_CELL = re.compile(r"|-|--|n/?a|#n/a|<na>|-?nan|null|none|-?1\.#(ind|qnan)", re.I)
HEADER_MARKS = " #%"  # may stand before a header
COMMENT = r"\s*#"  # begins a line that is no row
COMMA_OF_TIME = r"(:\d\d),(\d)"  # before the fraction of a second: 10:15:00,020
DOUBLED = " #"  # stands, with a number, behind the name of a column that another has
FIRST_LINES = 55  # among them is the header
ROWS_COMPARED = 5  # rows below a header that must have as many cells
LIST_NAMES = ("name", "names", "joint_names")  # keys of the names of elements of lists


class Dialect(NamedTuple):
    """How a line of text is cut into cells, and a cell read."""

    separator: str  # between cells; a blank stands for any number of them
    comma: bool  # decimals may stand behind a comma

    @classmethod
    def of(cls, line: str) -> Dialect:
        """Return the dialect of a table by its first line."""
        separator = max(SEPARATORS, key=line.count)
        if ";" in line:
            separator = ";"
        elif separator not in line:
            separator = " "
        return cls(separator, comma=separator != ",")

    def rows(self, lines: Iterable[str]) -> Iterator[list[str]]:
        """Yield the cells of each line."""
        if self.separator == " ":
            return map(str.split, lines)
        return csv.reader(lines, delimiter=self.separator)

    def cells(self, line: str) -> list[str]:
        """Return the cells of a line."""
        return next(self.rows([line]), [])

    def number(self, cell: str) -> float:
        """Return a cell's number, NaN of an empty one. Raises ValueError where it is none."""
        text = cell.strip().lower() or "nan"
        return float(FLAGS.get(text, self.plain(text)))

    def plain(self, cell: str) -> str:
        """Return a cell with a point before its decimals."""
        if self.comma and "." not in cell:
            return cell.replace(",", ".")
        return cell

    def is_number(self, cell: str) -> bool:
        """Tell whether a cell is a number, a flag, or empty."""
        try:
            self.number(cell)
        except ValueError:
            return False
        return True

    def count_numbers(self, cells: Sequence[str]) -> int:
        """Return how many cells hold a number."""
        filled = filter(str.strip, cells)
        return sum(map(self.is_number, filled))


class _Table(NamedTuple):
    """A table whose cells are not read yet."""

    dialect: Dialect
    names: list[str]
    rows: pd.Series[str]  # lines by their numbers


def read_text(path: Path, columns: Sequence[str] = ()) -> Columns:
    """Return the columns of a table of text; an empty cell is NaN, true and false are 1 and 0, words stay words.

    Args:
        path: the file.
        columns: names of the columns of a table without a header.

    Raises:
        ValueError: it is no table, as it lacks a header or rows, or its rows are of several lengths.
    """
    lines, is_whole = _lines(path)
    top = lines.iloc[:FIRST_LINES].tolist()
    check_export(top)
    start = 0
    if not columns:
        start = _header_place(top)
        if start:
            note(f"{path}: its first {start} lines stand above the table, and are left out")
    table = _table(path, lines.iloc[start:], columns)
    return _by_name(table.names, _columns(path, table, is_whole))


def _lines(path: Path) -> tuple[pd.Series[str], bool]:
    """The lines that are not blank by their numbers, from 1, and whether the last one has an end."""
    import pandas as pd

    raw = path.read_bytes()
    if raw.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)):
        text = raw.decode("utf-16", "replace")
        raw = text.encode()
    if raw.endswith(b"\x00"):
        note(f"{path}: zero bytes at its end, which a loss of power leaves, are left out")
        raw = raw.rstrip(b"\x00")
    if b"\x00" in raw[:LONGEST_LINE]:
        raise ValueError("it is no text")
    lines = {}
    is_mixed = False
    for number, line in enumerate(raw.splitlines(), 1):
        if len(line) > LONGEST_LINE:
            raise ValueError(
                f"line {number} has {len(line)} characters: "
                f"at most {MOST_COLUMNS} columns can be watched"
            )
        text, is_other = decoded(line)
        is_mixed |= is_other
        if text.strip():
            lines[number] = text
    if is_mixed:
        note(f"{path} is not in UTF-8 throughout: other characters are read as Windows-1252")
    is_whole = raw.endswith((b"\n", b"\r"))
    return pd.Series(lines, dtype=object), is_whole


def decoded(line: bytes) -> tuple[str, bool]:
    """Return a line as text without a byte-order mark, and whether it is in Windows-1252 and not in UTF-8."""
    try:
        return line.removeprefix(codecs.BOM_UTF8).decode(), False
    except UnicodeDecodeError:
        return line.decode("cp1252", "replace"), True


def _header_place(lines: Sequence[str]) -> int:
    """How many lines stand above the table.

    The lines below a header have its number of cells, and numbers in them. A header with numbers in it,
    as ``time,1,2``, is one where no other line is.
    """
    with_numbers = 0
    for place, line in enumerate(lines):
        dialect = Dialect.of(line)
        cells = dialect.cells(line.lstrip(HEADER_MARKS))
        below = [other for other in lines[place + 1 :] if not re.match(COMMENT, other)]
        rows = [dialect.cells(other) for other in below[:ROWS_COMPARED]]
        is_table = all(_fits(row, len(cells)) for row in rows)
        if not rows or not is_table:
            continue
        if not dialect.count_numbers(rows[-1]):
            continue
        if place == 0 or not dialect.count_numbers(cells):
            return place
        with_numbers = with_numbers or place
    return with_numbers


def _table(path: Path, lines: pd.Series[str], columns: Sequence[str]) -> _Table:
    """The table in some lines: a header, perhaps units, and rows; ``columns`` name the columns of rows alone."""
    header = "".join(lines.iloc[:1])
    dialect = Dialect.of(header)
    cells = dialect.cells(header.lstrip(HEADER_MARKS))
    names = _names(dialect, cells, columns)
    if columns and dialect.count_numbers(cells):
        header = ""
    is_comment = lines.str.match(COMMENT)
    rows = lines[(lines != header) & ~is_comment]
    left_out = len(lines) - len(rows) - bool(header)
    if left_out:
        note(f"{path}: {left_out} lines are left out: comments, or the header once more")
    if rows.empty:
        raise ValueError(f"it needs a header and at least one row, got {len(lines)} lines")
    units, *below = dialect.rows(rows.iloc[:2])
    if header and _are_units(dialect, units, *below):
        names = list(map(with_unit, names, units))
        rows = rows.iloc[1:]
    return _Table(
        dialect=dialect,
        names=names,
        rows=rows,
    )


def _names(dialect: Dialect, cells: Sequence[str], columns: Sequence[str]) -> list[str]:
    """The names of columns: those that the user gave, or the cells of the first line."""
    size = len(cells)
    if columns:
        if len(columns) != size:
            raise ValueError(
                f"{len(columns)} columns are named, and its first line has {size} cells: "
                "cut off what is no row"
            )
        return header_of(columns)
    filled = list(filter(str.strip, cells))
    if dialect.count_numbers(cells) > len(filled) / 2:
        example = " ".join(f"x{k}" for k in range(size))
        raise ValueError(
            f"its first line is of {size} numbers and no header: "
            f"name its {size} columns, --columns {example[:60]}"
        )
    return header_of(cells)


def header_of(cells: Sequence[str]) -> list[str]:
    """Return the names of columns. Raises ValueError where there are none or too many."""
    names = [cell.strip().lstrip("#%-").strip() for cell in cells]
    while names and not names[-1]:  # ;;; at the end of every line
        names.pop()
    if not names:
        raise ValueError("it needs a header and at least one row, got 0 lines")
    check_width(len(names))
    return names


def _are_units(dialect: Dialect, cells: Sequence[str], *below: Sequence[str]) -> bool:
    """Whether the cells below a header are units: short words above a row with numbers."""
    is_long = max(map(len, cells)) > LONGEST_UNIT
    if is_long or dialect.count_numbers(cells):
        return False
    return any(map(dialect.count_numbers, below))


def _columns(path: Path, table: _Table, is_whole: bool) -> list[NDArray[Any]]:
    """The columns of a table, each (T,); ``is_whole`` where the last line of the file has an end."""
    dialect = table.dialect
    names = set(table.names)
    size = len(table.names)
    rows = table.rows
    newest = dialect.rows(rows.iloc[-2:])
    if not is_whole and len(rows) > 1 and _is_cut_off(dialect, *newest):
        note(f"{path}: its last line was cut off, and is left out")
        rows = rows.iloc[:-1]
    cells: list[str] = []
    for number, row in zip(rows.index, dialect.rows(rows), strict=False):
        if len(row) != size:
            check_cells(row, size, f"line {number} has")
        if names.issuperset(row):
            raise ValueError(f"line {number} is another header: cut the file there")
        cells += row[:size]
    by_row = np.array(cells, object).reshape(-1, size)
    return [_column(column, dialect.comma) for column in by_row.T]


def _is_cut_off(dialect: Dialect, before: Sequence[str], last: Sequence[str]) -> bool:
    """Whether the last row lacks cells, or has a word where the one before it has a number."""
    if len(last) < len(before):
        return True
    are_numbers = map(dialect.is_number, before)
    are_still = map(dialect.is_number, last)
    return any(map(operator.gt, are_numbers, are_still))


def check_cells(cells: Sequence[str], size: int, where: str) -> None:
    """Raise ValueError where a row has fewer cells than its header, or more that hold something."""
    if not _fits(cells, size):
        raise ValueError(
            f"{where} {len(cells)} cells, its header {size}: mend it, or cut the file there"
        )


def _fits(cells: Sequence[str], size: int) -> bool:
    """Whether a row has a cell for each of so many columns, and no more that hold something."""
    surplus = "".join(cells[size:])
    return len(cells) >= size and not surplus.strip()


def _column(cells: Any, comma: bool) -> NDArray[Any]:
    """A column (T,) of numbers, or of words where it holds one; times have a point before their fraction."""
    import pandas as pd

    numbers = numbers_in(cells, comma)
    is_lost = np.isnan(numbers)
    if not is_lost.any():
        return numbers
    text = pd.Series(cells, dtype=object).fillna("")
    words = text.astype(str).str.strip()
    is_missing = words.str.fullmatch(MISSING_CELL)
    words[is_missing] = ""
    if is_missing[is_lost].all():
        return numbers
    words = words.str.replace(COMMA_OF_TIME, r"\1.\2", regex=True)
    return words.str[:LONGEST_WORD].to_numpy(object)


def numbers_in(cells: Any, comma: bool = False) -> NDArray[Any]:
    """Return the numbers (T,) of cells: decimals, true and false; NaN of empty cells and of words."""
    import pandas as pd

    text = pd.Series(cells, dtype=object)
    if comma:
        text = text.str.replace(",", ".", regex=False)
    numbers = pd.to_numeric(text, errors="coerce")
    if numbers.isna().any():
        words = text.astype(str).str.strip()
        flags = words.str.lower().map(FLAGS)
        numbers = numbers.fillna(flags)
    return numbers.to_numpy()


def _by_name(names: Sequence[str], columns: Sequence[NDArray[Any]]) -> Columns:
    """The columns by name; of one name, equal ones are one, others get a number."""
    import pandas as pd

    table: Columns = {}
    for place, name in enumerate(names):
        values = columns[place]
        first = table.setdefault(name, values)
        if first is values:
            continue
        if pd.Series(values).equals(pd.Series(first)):
            note(f"columns of the same name are equal, and read as one: {name}")
        else:
            number = names[:place].count(name) + 1
            table[f"{name}{DOUBLED}{number}"] = values
    return table


def read_json_lines(path: Path, columns: Sequence[str] = ()) -> Columns:
    """Return the columns of a file with an object, or a list of numbers, on each line; a missing number is NaN.

    Args:
        path: the file.
        columns: names of the numbers of a list.

    Raises:
        ValueError: a line is no row, or there is none.
    """
    import pandas as pd

    rows: list[dict[str, Any]] = []
    lines, is_whole = _lines(path)
    for number, line in lines.items():
        try:
            row = flat_row(json.loads(line), columns)
            check_width(len(row))
        except (ValueError, RecursionError) as error:
            is_last = number == lines.index[-1]
            if rows and is_last and not is_whole:
                note(f"{path}: its last line was cut off, and is left out")
                break
            raise ValueError(f"line {number} is no row: {error}") from error
        rows.append(row)
    if not rows:
        raise ValueError("it needs at least one row, got none")
    frame = pd.DataFrame(rows)
    return {name: _column(frame[name], comma=False) for name in frame}


def flat_row(row: Any, columns: Sequence[str] = ()) -> dict[str, Any]:
    """Return the values of a row of JSON by name: ``tool.force`` of an object within, ``q[0]`` of a list."""
    if isinstance(row, list):
        if len(row) != len(columns):
            raise ValueError(
                f"it is a list of {len(row)}, and {len(columns)} columns are named (--columns)"
            )
        row = dict(zip(columns, row, strict=True))
    if not isinstance(row, dict):
        raise ValueError(f"it must be an object or a list, got {str(row)[:40]}")
    flat: dict[str, Any] = {}
    for name, value in row.items():
        if isinstance(value, dict):
            for part, inner in flat_row(value).items():
                flat[f"{name}.{part}"] = inner
        elif isinstance(value, list):
            elements = _elements(row, len(value))
            for element, item in zip(elements, value, strict=True):
                if not isinstance(item, str):
                    flat[element_name(name, element)] = item
        else:
            flat[name] = value
    return flat


def _elements(row: Mapping[str, Any], size: int) -> Sequence[object]:
    """The names of the elements of lists of one size in a row, or else their places."""
    for key in LIST_NAMES:
        names = row.get(key)
        if isinstance(names, list) and len(names) == size:
            return names
    return range(size)
