"""Read the columns of text through pandas: CSV of any country, tables without a header, and JSON lines.

separator   the one of ; tab , | that the first line holds most of, or else blanks
decimals    a point; where the separator is no comma, a comma too: 0,1096
header      names, perhaps behind a # or with blanks; without one, columns are named by the caller
last line   cut off in the middle: left out, with a note
"""

from __future__ import annotations

import csv
import json
import re
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple, TextIO

import numpy as np
from numpy.typing import NDArray

from asm_gym.data.names import is_clock
from asm_gym.data.reader_notes import note
from asm_gym.data.units import bare_name, unit_of
from asm_gym.files import regular_file

if TYPE_CHECKING:
    import pandas as pd

Columns = dict[str, NDArray[Any]]

KeepWords = Callable[[str], bool]
"""Whether the words of a column of this name are kept."""

LONGEST_LINE, LONGEST_CELL = 2**22, 2**16
"""Characters of a line and of a cell; a row of a robot has some thousand."""

LONGEST_WORD = 64
"""Characters that are kept of a word, of a label or a time."""

MOST_COLUMNS = 8192
"""Every number is weighed against every other later on: see ``whitening``."""

SEPARATORS = ";\t,|"

FLAGS = {"true": 1.0, "false": 0.0}
_NUMBER = re.compile(r"[+-]?(\d+[.,]?\d*|[.,]\d+)(e[+-]?\d+)?|nan|[+-]?inf(inity)?", re.I)


class Dialect(NamedTuple):
    """How a line of text is cut into cells, and a cell read.

    Attributes:
        separator: between cells; a blank stands for any number of them.
        comma: decimals may stand behind a comma.
    """

    separator: str
    comma: bool

    @classmethod
    def of(cls, line: str) -> Dialect:
        """Tell by the first line of a table."""
        counts = {mark: line.count(mark) for mark in SEPARATORS}
        best = ";" if counts[";"] else max(counts, key=lambda mark: counts[mark])
        separator = best if counts[best] else (" " if len(line.split()) > 1 else ",")
        return cls(separator, separator != ",")

    def cells(self, line: str) -> list[str]:
        """Return the cells of a line. Raises ValueError where it cannot be cut."""
        if self.separator == " ":
            return line.split()
        try:
            return next(csv.reader([line], delimiter=self.separator), [])
        except csv.Error as error:
            raise ValueError(f"it is no table of text: {error}") from error

    def width(self, line: str) -> int:
        """Return how many cells a line has."""
        if '"' in line:
            return len(self.cells(line))
        return len(line.split()) if self.separator == " " else line.count(self.separator) + 1

    def number(self, cell: str) -> float:
        """Return a cell's number, NaN of an empty one. Raises ValueError where it is none."""
        text = cell.strip() or "nan"
        try:
            return float(text)
        except ValueError:
            if text.lower() in FLAGS:
                return FLAGS[text.lower()]
            return float(text.replace(",", ".") if self.comma and "." not in text else text)

    def is_number(self, cell: str) -> bool:
        """Tell whether a cell is a number, a flag, or empty."""
        try:
            self.number(cell)
        except ValueError:
            return False
        return True


class Text(NamedTuple):
    """What one pass over a file of text found: its dialect and names, and where its rows are."""

    dialect: Dialect
    names: list[str]
    skipped: int  # lines before the first row
    rows: int
    width: int  # cells of the widest line


def read_text(path: Path, columns: Sequence[str] = (), keeps: KeepWords = is_clock) -> Columns:
    """Return the columns of numbers of a table of text; an empty cell is NaN, true and false are 1 and 0.

    Args:
        path: of the file, in UTF-8 or UTF-16, or else in the encoding of Western Windows.
        columns: names of the columns of a table without a header.
        keeps: whose words are kept, by name; other columns of words are left out.

    Raises:
        ValueError: no header or no row, a name that stands twice, rows of several lengths, a column of numbers that
            holds something else.
    """
    import pandas as pd

    regular_file(path)
    with path.open("rb") as file:
        encoding = "utf-16" if file.read(2) in (b"\xff\xfe", b"\xfe\xff") else "utf-8-sig"
    try:
        found = _surveyed(path, encoding, columns)
    except UnicodeDecodeError:
        encoding = "cp1252"
        found = _surveyed(path, encoding, columns)
        note(f"{path} is not in UTF-8, and is read as Windows-1252")
    try:
        frame = pd.read_csv(
            path,
            sep=r"\s+" if found.dialect.separator == " " else found.dialect.separator,
            header=None,
            names=list(range(found.width)),
            skiprows=found.skipped,
            nrows=found.rows,
            encoding=encoding,
            float_precision="round_trip",
            low_memory=False,
        )
    except ValueError as error:
        raise ValueError(f"it is no table of text: {' '.join(str(error).split())}") from error
    named = {name: frame[k] for k, name in enumerate(found.names)}
    return _numbers(named, keeps, found.dialect.comma, found.skipped)


def _surveyed(path: Path, encoding: str, columns: Sequence[str]) -> Text:
    """Looks at every line once. Raises ValueError where one is no row."""
    with path.open(encoding=encoding) as file:
        lines = _lines(file)
        first = next(lines, (0, ""))
        if "\x00" in first[1]:
            raise ValueError("it is no text")
        dialect = Dialect.of(first[1])
        names, has_header = _header(dialect.cells(first[1]), columns)
        if len(names) > MOST_COLUMNS:
            raise ValueError(f"it has {len(names)} columns, and at most {MOST_COLUMNS} can be watched")
        rows, widest, before = 0, len(names), ("", "")  # the last two lines
        for n, line in lines if has_header else chain([first], lines):
            width = dialect.width(line)
            if width > len(names):
                widest, width = max(widest, width), dialect.width(line.rstrip().rstrip(dialect.separator))
            if width > len(names) or (width < len(names) and line.endswith("\n")):
                raise ValueError(f"line {n} has {width} cells, its header {len(names)}")
            rows, before = rows + 1, (before[1], line)
    if rows and not before[1].endswith("\n") and _cut_off(dialect, before, len(names)):
        note(f"{path}: its last line was cut off, and is left out")
        rows -= 1
    if not rows:
        raise ValueError(f"it needs a header and at least one row, got {int(bool(first[1]))} lines")
    return Text(dialect, names, first[0] if has_header else 0, rows, widest)


def _lines(file: TextIO) -> Iterator[tuple[int, str]]:
    """The lines that are not empty, numbered from 1."""
    n = 0
    while line := file.readline(LONGEST_LINE):
        n += 1
        if len(line) == LONGEST_LINE:
            raise ValueError(f"a line of {LONGEST_LINE} characters or more is no row")
        if len(line) > LONGEST_CELL and re.search(f"[^{SEPARATORS}\\s]{{{LONGEST_CELL}}}", line):
            raise ValueError(f"it is no table of text: line {n} has a cell of more than {LONGEST_CELL} characters")
        if line.strip(" \r\n"):
            yield n, line


def _cut_off(dialect: Dialect, last_two: tuple[str, str], size: int) -> bool:
    """Whether the last line lacks cells, or has a word where the one before it has a number."""
    before, last = map(dialect.cells, last_two)
    words = (dialect.is_number(was) and not dialect.is_number(now) for was, now in zip(before, last, strict=False))
    return len(last) < size or any(words)


def _header(cells: list[str], columns: Sequence[str]) -> tuple[list[str], bool]:
    """Names of the columns, and whether the first line holds them."""
    if len(cells) > 1 and cells[0] in ("#", "%"):  # in front of a header whose names stand apart by blanks
        cells = cells[1:]
    numbers = [bool(_NUMBER.fullmatch(cell.strip())) for cell in cells if cell.strip()]
    if columns:
        if len(columns) != len(cells):
            raise ValueError(f"{len(columns)} columns are named, and its first line has {len(cells)} cells")
        return header_of(columns, "it"), not all(numbers)
    if numbers and all(numbers):
        raise ValueError(f"its first line is of {len(numbers)} numbers and no header: name its columns with --columns")
    return header_of(cells, "it"), True


def header_of(cells: Sequence[str], where: str) -> list[str]:
    """Return the names of columns. Raises ValueError where there are none, or one stands twice."""
    names = [cell.strip().lstrip("#%-").strip() if cell.strip() not in ("%", "#") else "" for cell in cells]
    while names and not names[-1]:  # ;;; at the end of every line
        names.pop()
    if not names:
        raise ValueError(f"{where} needs a header and at least one row, got 0 lines")
    doubled = sorted(name for name, count in Counter(names).items() if count > 1)
    if doubled:
        raise ValueError(f"{where} has columns of the same name: {', '.join(map(repr, doubled[:8]))}")
    return names


def _numbers(series: Mapping[str, pd.Series[Any]], keeps: KeepWords, comma: bool, skipped: int) -> Columns:
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
            raise ValueError(f"{name}, line {row + skipped + 1} must be a number, got {str(text.iloc[row])[:40]!r}")
        elif not words.any():
            made[name] = values.to_numpy(np.float64, na_value=np.nan)
    return made


def read_json_lines(path: Path, columns: Sequence[str] = (), keeps: KeepWords = is_clock) -> Columns:
    """Return the columns of a file with an object, or a list of numbers, on each line; a missing number is NaN.

    Raises:
        ValueError: a line is neither; it names the line.
    """
    import pandas as pd

    regular_file(path)
    rows: list[dict[str, Any]] = []
    with path.open(encoding="utf-8-sig") as file:
        for n, line in _lines(file):
            try:
                rows.append(flat_row(json.loads(line), columns))
            except (ValueError, RecursionError) as error:
                if rows and isinstance(error, json.JSONDecodeError) and not line.endswith("\n"):
                    note(f"{path}: its last line was cut off, and is left out")
                    continue
                raise ValueError(f"line {n} is no row: {error}") from error
            if len(rows[-1]) > MOST_COLUMNS:
                raise ValueError(f"it has {len(rows[-1])} columns, and at most {MOST_COLUMNS} can be watched")
    if not rows:
        raise ValueError("it needs at least one row, got none")
    frame = pd.DataFrame(rows)
    return _numbers({name: frame[name] for name in frame.columns}, keeps, comma=False, skipped=0)


def flat_row(row: Any, columns: Sequence[str] = ()) -> dict[str, Any]:
    """Return the values of a row of JSON by name: ``tool.force`` of an object within, ``q[0]`` of a list.

    Raises:
        ValueError: it is no object, nor a list as long as ``columns``.
    """
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
            bare, unit = bare_name(name), unit_of(name)
            names = (f"{bare}[{k}] [{unit}]" if unit else f"{bare}[{k}]" for k in range(len(value)))
            found |= {n: v for n, v in zip(names, value, strict=True) if isinstance(v, int | float) or v is None}
        else:
            found[name] = value
    return found
