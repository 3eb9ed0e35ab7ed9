"""Read the columns of text through pandas: CSV of any country, tables without a header, and JSON lines.

separator   the one of ; tab , | that the first line holds most of, or else blanks
decimals    a point; where the separator is no comma, a comma too: 0,1096
header      names, perhaps behind a # or with blanks; without one, columns are named by the caller
last line   cut off in the middle: left out, with a note
"""

from __future__ import annotations

import csv
import io
import json
import re
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from asm_gym.data.names import is_clock, split_unit
from asm_gym.data.reader_notes import note
from asm_gym.files import regular_file

if TYPE_CHECKING:
    import pandas as pd

Columns = dict[str, NDArray[Any]]
KeepWords = Callable[[str], bool]

LONGEST_WORD = 64  # characters that are kept of a word, of a label or a time
MOST_COLUMNS = 8192  # every number is weighed against every other later on: see ``whitening``
LONGEST_LINE = LONGEST_WORD * MOST_COLUMNS  # characters of a line
SEPARATORS = ";\t,|"
FLAGS = {"true": 1.0, "false": 0.0}


class Dialect(NamedTuple):
    """How a line of text is cut into cells, and a cell read."""

    separator: str  # between cells; a blank stands for any number of them
    comma: bool  # decimals may stand behind a comma

    @classmethod
    def of(cls, line: str) -> Dialect:
        """Return the dialect of a table by its first line."""
        counts = {mark: line.count(mark) for mark in SEPARATORS}
        best = ";" if counts[";"] else max(counts, key=lambda mark: counts[mark])
        separator = best if counts[best] else (" " if len(line.split()) > 1 else ",")
        return cls(separator, separator != ",")

    def cells(self, line: str) -> list[str]:
        """Return the cells of a line. Raises ValueError where it cannot be cut."""
        if self.separator == " ":
            return line.split()
        if '"' not in line:
            return line.rstrip("\r\n").split(self.separator)
        try:
            return next(csv.reader([line], delimiter=self.separator), [])
        except csv.Error as error:
            raise ValueError(f"it is no table of text: {error}") from error

    def number(self, cell: str) -> float:
        """Return a cell's number, NaN of an empty one. Raises ValueError where it is none."""
        text = cell.strip().lower() or "nan"
        if text in FLAGS:
            return FLAGS[text]
        return float(text.replace(",", ".") if self.comma and "." not in text else text)

    def is_number(self, cell: str) -> bool:
        """Tell whether a cell is a number, a flag, or empty."""
        with suppress(ValueError):
            self.number(cell)
            return True
        return False


def read_text(path: Path, columns: Sequence[str] = (), keeps: KeepWords = is_clock) -> Columns:
    """Return the columns of numbers of a table of text; an empty cell is NaN, true and false are 1 and 0.

    ``columns`` name those of a table without a header; words are kept of columns that ``keeps`` chooses by name. Raises
    ValueError where it is no table: no header or no row, a name twice, rows of several lengths, words among numbers.
    """
    import pandas as pd

    numbered, complete = _lines(path)
    if not numbered:
        raise ValueError("it needs a header and at least one row, got 0 lines")
    first, rows = numbered[0][1], numbered[1:]
    dialect = Dialect.of(first)
    names, has_header = _header(dialect, first, columns)
    rows = rows if has_header else numbered
    if not complete and len(rows) > 1 and _cut_off(dialect, rows[-2][1], rows[-1][1], len(names)):
        note(f"{path}: its last line was cut off, and is left out")
        rows = rows[:-1]
    if not rows:
        raise ValueError(f"it needs a header and at least one row, got {len(numbered)} lines")
    widest = len(names)
    for n, line in rows:
        cells = dialect.cells(line)
        widest = max(widest, len(cells))
        check_cells(cells, len(names), f"line {n} has")
    try:
        frame = pd.read_csv(
            io.StringIO("\n".join(line for _, line in rows)),
            sep=r"\s+" if dialect.separator == " " else dialect.separator,
            header=None,
            names=list(range(widest)),
            float_precision="round_trip",
            low_memory=False,
        )
    except ValueError as error:
        raise ValueError(f"it is no table of text: {' '.join(str(error).split())}") from error
    return _numbers({name: frame[k] for k, name in enumerate(names)}, keeps, dialect.comma, rows[0][0])


def _lines(path: Path) -> tuple[list[tuple[int, str]], bool]:
    """The lines that are not empty, numbered from 1, and whether the last one has an end."""
    regular_file(path)
    raw = path.read_bytes()
    wide = raw[:2] in (b"\xff\xfe", b"\xfe\xff")
    if b"\x00" in raw[:LONGEST_LINE] and not wide:
        raise ValueError("it is no text")
    try:
        text = raw.decode("utf-16" if wide else "utf-8-sig")
    except UnicodeDecodeError:
        text = raw.decode("cp1252", errors="replace")
        note(f"{path} is not in UTF-8, and is read as Windows-1252")
    lines = re.split(r"\r\n?|\n", text)
    numbered = [(n, line) for n, line in enumerate(lines, 1) if line.strip(" ")]
    n, longest = max(numbered, key=lambda each: len(each[1]), default=(0, ""))
    if len(longest) > LONGEST_LINE:
        raise ValueError(f"line {n} has {len(longest)} characters: at most {MOST_COLUMNS} columns can be watched")
    return numbered, text.endswith(("\n", "\r"))


def check_cells(cells: Sequence[str], size: int, where: str) -> None:
    """Raise ValueError where a row has fewer cells than its header, or more that hold something."""
    if len(cells) < size or any(cell.strip() for cell in cells[size:]):
        raise ValueError(f"{where} {len(cells)} cells, its header {size}")


def _cut_off(dialect: Dialect, before: str, last: str, size: int) -> bool:
    """Whether the last line lacks cells, or has a word where the one before it has a number."""
    cells = list(zip(dialect.cells(before), dialect.cells(last), strict=False))
    return len(cells) < size or any(dialect.is_number(was) and not dialect.is_number(now) for was, now in cells)


def _header(dialect: Dialect, line: str, columns: Sequence[str]) -> tuple[list[str], bool]:
    """Names of the columns, and whether the first line holds them."""
    cells = dialect.cells(line)
    if len(cells) > 1 and cells[0] in ("#", "%"):  # in front of a header whose names are separated by blanks
        cells = cells[1:]
    numbers = [dialect.is_number(cell) for cell in cells if cell.strip()]
    if columns:
        if len(columns) != len(cells):
            raise ValueError(f"{len(columns)} columns are named, and its first line has {len(cells)} cells")
        return header_of(columns, "it"), not all(numbers)
    if numbers and all(numbers):
        raise ValueError(f"its first line is of {len(numbers)} numbers and no header: name its columns with --columns")
    return header_of(cells, "it"), True


def header_of(cells: Sequence[str], where: str) -> list[str]:
    """Return the names of columns. Raises ValueError where there are none or too many, or one stands twice."""
    names = [cell.strip().lstrip("#%-").strip() if cell.strip() not in ("%", "#") else "" for cell in cells]
    while names and not names[-1]:  # ;;; at the end of every line
        names.pop()
    if not names:
        raise ValueError(f"{where} needs a header and at least one row, got 0 lines")
    _check_width(len(names))
    doubled = sorted(name for name, count in Counter(names).items() if count > 1)
    if doubled:
        raise ValueError(f"{where} has columns of the same name: {', '.join(map(repr, doubled[:8]))}")
    return names


def _check_width(size: int) -> None:
    if size > MOST_COLUMNS:
        raise ValueError(f"it has {size} columns, and at most {MOST_COLUMNS} can be watched")


def _numbers(series: Mapping[str, pd.Series[Any]], keeps: KeepWords, comma: bool, first: int) -> Columns:
    """Columns of numbers, and the words of those that are kept. Raises ValueError where a column mixes the two."""
    import pandas as pd

    made: Columns = {}
    for name, cells in series.items():
        if cells.dtype.kind in "biuf":
            if name or cells.notna().any():
                made[name] = cells.to_numpy()
            continue
        text = cells.astype("string").str.strip()
        plain = text.str.replace(",", ".", regex=False) if comma else text
        values = pd.to_numeric(plain, errors="coerce").fillna(text.str.lower().map(FLAGS)).astype("Float64")
        empty = text.isna() | (text == "")
        words = values.isna() & ~empty
        if words.any() and keeps(name):
            made[name] = text.fillna("").str[:LONGEST_WORD].to_numpy(dtype=object)
        elif words.any() and not (words | empty).all():
            row = int(np.argmax(words))
            raise ValueError(f"{name}, line {row + first} must be a number, got {str(text.iloc[row])[:40]!r}")
        elif not words.any():
            made[name] = values.to_numpy(np.float64, na_value=np.nan)
    return made


def read_json_lines(path: Path, columns: Sequence[str] = (), keeps: KeepWords = is_clock) -> Columns:
    """Return the columns of a file with an object, or a list of numbers, on each line; a missing number is NaN."""
    import pandas as pd

    rows: list[dict[str, Any]] = []
    numbered, complete = _lines(path)
    for n, line in numbered:
        try:
            rows.append(flat_row(json.loads(line), columns))
            _check_width(len(rows[-1]))
        except (ValueError, RecursionError) as error:
            if rows and isinstance(error, json.JSONDecodeError) and n == numbered[-1][0] and not complete:
                note(f"{path}: its last line was cut off, and is left out")
                continue
            raise ValueError(f"line {n} is no row: {error}") from error
    if not rows:
        raise ValueError("it needs at least one row, got none")
    frame = pd.DataFrame(rows)
    return _numbers({name: frame[name] for name in frame.columns}, keeps, comma=False, first=numbered[0][0])


def flat_row(row: Any, columns: Sequence[str] = ()) -> dict[str, Any]:
    """Return the values of a row of JSON by name: ``tool.force`` of an object within, ``q[0]`` of a list."""
    if isinstance(row, list):
        if len(row) != len(columns):
            raise ValueError(f"it is a list of {len(row)}, and {len(columns)} columns are named (--columns)")
        row = dict(zip(columns, row, strict=True))
    if not isinstance(row, dict):
        raise ValueError(f"it must be an object or a list, got {str(row)[:40]}")
    found: dict[str, Any] = {}
    for name, value in row.items():
        if isinstance(value, dict):
            found |= {f"{name}.{part}": v for part, v in flat_row(value).items()}
        elif isinstance(value, list):
            bare, unit = split_unit(name)
            names = (f"{bare}[{k}] [{unit}]" if unit else f"{bare}[{k}]" for k in range(len(value)))
            found |= {n: v for n, v in zip(names, value, strict=True) if isinstance(v, int | float) or v is None}
        else:
            found[name] = value
    return found
