"""Read the columns of text through pandas: CSV of any country, tables without a header, and JSON lines.

separator   the one of ; tab , | that the header holds most of, or else blanks
decimals    a point; where the separator is no comma, a comma too: 0,1096
header      names, perhaps behind a # or with blanks, below a preamble; without one, columns are named by the caller
units       may stand in a line of their own below the header
twice       a header that comes again is left out; columns of one name are one where they are equal
last line   cut off in the middle: left out, with a note
"""

from __future__ import annotations

import csv
import io
import json
import re
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from asm_gym.data.names import element_name
from asm_gym.data.reader_notes import note
from asm_gym.data.tables import MOST_COLUMNS, Columns, check_width

if TYPE_CHECKING:
    import pandas as pd


LONGEST_WORD = 64  # characters that are kept of a word, of a label or a time
LONGEST_LINE = LONGEST_WORD * MOST_COLUMNS  # characters of a line
SEPARATORS = ";\t,|"
FLAGS = {"true": 1.0, "false": 0.0}
BEFORE = " #%"  # a header
DOUBLED = " #"  # stands, with a number, behind the name of a column that another has
MOST_PREAMBLE, AGREE = 50, 5  # lines above a header; lines below it that must have as many cells
LONGEST_UNIT = 12  # characters of a unit


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
        try:
            return next(csv.reader([line.rstrip("\r\n")], delimiter=self.separator), [])
        except csv.Error as error:
            raise ValueError(f"it is no table of text: {error}") from error

    def number(self, cell: str) -> float:
        """Return a cell's number, NaN of an empty one. Raises ValueError where it is none."""
        text = cell.strip().lower() or "nan"
        if text in FLAGS:
            return FLAGS[text]
        return float(self.plain(text))

    def plain(self, cell: str) -> str:
        """Return a cell with a point before its decimals."""
        return cell.replace(",", ".") if self.comma and "." not in cell else cell

    def is_number(self, cell: str) -> bool:
        """Tell whether a cell is a number, a flag, or empty."""
        with suppress(ValueError):
            self.number(cell)
            return True
        return False

    def numbers_among(self, cells: Sequence[str]) -> list[bool]:
        """Tell of the cells that are not empty which are numbers."""
        return [self.is_number(cell) for cell in cells if cell.strip()]


def read_text(path: Path, columns: Sequence[str] = ()) -> Columns:
    """Return the columns of a table of text; an empty cell is NaN, true and false are 1 and 0, words stay words.

    ``columns`` name those of a table without a header. Raises ValueError where it is no table: no header or no row, or
    rows of several lengths.
    """
    import pandas as pd

    lines, complete = _lines(path)
    at = 0 if columns else _header_at(lines.iloc[: MOST_PREAMBLE + AGREE].tolist())
    if at:
        note(f"{path}: its first {at} lines are no part of the table, and are left out")
    first, rows = lines.iloc[at] if len(lines) else "", lines.iloc[at + 1 :]
    dialect = Dialect.of(first)
    names, has_header = _header(dialect, first, columns)
    if not has_header:
        rows = lines
    elif (
        len(rows) > 1
        and rows.iloc[0].strip() != first.strip()
        and _are_units(dialect, *rows.iloc[:2])
    ):
        units = [cell.strip().strip("[]()") for cell in dialect.cells(rows.iloc[0])]
        names = [f"{n} [{u}]" if u and n else n for n, u in zip(names, units, strict=False)]
        rows = rows.iloc[1:]
    for what, left_out in (
        ("its header once more", (rows.str.strip() == first.strip()) & has_header),
        ("behind a #", rows.str.lstrip().str.startswith("#")),
    ):
        if left_out.any():
            note(f"{path}: {left_out.sum()} lines are left out, {what}")
            rows = rows[~left_out]
    cells = rows.map(dialect.cells)
    if (
        not complete
        and len(rows) > 1
        and _cut_off(dialect, cells.iloc[-2], cells.iloc[-1], len(names))
    ):
        note(f"{path}: its last line was cut off, and is left out")
        rows, cells = rows.iloc[:-1], cells.iloc[:-1]
    if rows.empty:
        raise ValueError(f"it needs a header and at least one row, got {len(lines)} lines")
    for n, found in cells.items():
        if (
            has_header
            and found
            and found[0].strip() in names
            and {cell.strip() for cell in found} <= set(names)
        ):
            raise ValueError(f"line {n} is another header: cut the file there")
        check_cells(found, len(names), f"line {n} has")
    try:
        frame = pd.read_csv(
            io.StringIO("\n".join(rows)),
            sep=r"\s+" if dialect.separator == " " else dialect.separator,
            header=None,
            names=list(range(cells.str.len().max())),
            na_values=["-", "--"],
            float_precision="round_trip",
            low_memory=False,
        )
    except ValueError as error:
        raise ValueError(f"it is no table of text: {' '.join(str(error).split())}") from error
    return _merged(names, [_column(frame[k], dialect.comma) for k in range(len(names))])


def _header_at(lines: Sequence[str]) -> int:
    """The number of the line that is the header: those below it have as many cells, and numbers among them."""
    first_row = 0
    for at, line in enumerate(lines[:MOST_PREAMBLE]):
        dialect = Dialect.of(line)
        with suppress(ValueError):
            size = len(dialect.cells(line.lstrip(BEFORE)))
            below = [
                dialect.cells(other)
                for other in lines[at + 1 :]
                if not other.lstrip().startswith("#")
            ][:AGREE]
            agree = all(
                len(cells) >= size and not any(c.strip() for c in cells[size:]) for cells in below
            )
            numbers = [sum(dialect.numbers_among(cells[:size])) for cells in below]
            if below and agree and max(numbers) > 0 and numbers[-1] > 0:
                if not at or not any(dialect.numbers_among(dialect.cells(line))):
                    return at
                first_row = first_row or at
    return first_row


def _are_units(dialect: Dialect, line: str, below: str) -> bool:
    """Whether the line below a header holds units: short words where the next line has numbers."""
    given = [cell.strip() for cell in dialect.cells(line) if cell.strip()]
    words = all(len(cell) <= LONGEST_UNIT and not dialect.is_number(cell) for cell in given)
    return bool(given) and words and any(dialect.numbers_among(dialect.cells(below)))


def _merged(names: Sequence[str], columns: Sequence[NDArray[Any]]) -> Columns:
    """The columns by name, but for empty ones without a name; of one name, equal ones are one, others get a number."""
    made: Columns = {}
    for name, values in zip(names, columns, strict=True):
        if not name and values.dtype.kind != "O" and not np.isfinite(values).any():
            continue
        others = [other for other in made if other.partition(DOUBLED)[0] == name]
        if any(
            np.array_equal(
                made[o], values, equal_nan=made[o].dtype.kind == values.dtype.kind == "f"
            )
            for o in others
        ):
            note(f"columns of the same name are equal, and read as one: {name}")
        else:
            made[f"{name}{DOUBLED}{len(others) + 1}" if others else name] = values
    return made


def _lines(path: Path) -> tuple[pd.Series[str], bool]:
    """The lines that are not empty by their numbers, from 1, and whether the last one has an end."""
    import pandas as pd

    raw = path.read_bytes()
    if raw[:2] in (b"\xff\xfe", b"\xfe\xff") or raw[1:200:2].count(0) > 80:  # UTF-16 of Windows
        raw = raw.decode("utf-16", "replace").encode()
    if raw.endswith(b"\x00"):
        note(f"{path}: zero bytes at its end, which a loss of power leaves, are left out")
        raw = raw.rstrip(b"\x00")
    if b"\x00" in raw[:LONGEST_LINE]:
        raise ValueError("it is no text")
    found = [decoded(line) for line in re.split(rb"\r\n?|\n", raw)]
    if any(other for _, other in found):
        note(f"{path} is not in UTF-8 throughout: other characters are read as Windows-1252")
    lines = pd.Series([line for line, _ in found], range(1, len(found) + 1), dtype=object)
    lines = lines[lines.str.strip(" ") != ""]
    sizes = lines.str.len()
    if sizes.max() > LONGEST_LINE:
        n, size = sizes.idxmax(), sizes.max()
        raise ValueError(
            f"line {n} has {size} characters: at most {MOST_COLUMNS} columns can be watched"
        )
    return lines, raw.endswith((b"\n", b"\r"))


def decoded(line: bytes) -> tuple[str, bool]:
    """A line as text without a byte-order mark, and whether it is not in UTF-8 but in Windows-1252."""
    with suppress(UnicodeDecodeError):
        return line.decode("utf-8-sig"), False
    return line.decode("cp1252", "replace"), True


def check_cells(cells: Sequence[str], size: int, where: str) -> None:
    """Raise ValueError where a row has fewer cells than its header, or more that hold something."""
    if len(cells) < size or any(cell.strip() for cell in cells[size:]):
        raise ValueError(
            f"{where} {len(cells)} cells, its header {size}: mend it, or cut the file there"
        )


def _cut_off(dialect: Dialect, before: Sequence[str], last: Sequence[str], size: int) -> bool:
    """Whether the last line lacks cells, or has a word where the one before it has a number."""
    cells = list(zip(before, last, strict=False))
    return len(cells) < size or any(
        dialect.is_number(was) and not dialect.is_number(now) for was, now in cells
    )


def _header(dialect: Dialect, line: str, columns: Sequence[str]) -> tuple[list[str], bool]:
    """Names of the columns, and whether the first line holds them."""
    cells = dialect.cells(line.lstrip(BEFORE))
    numbers = dialect.numbers_among(cells)
    size = len(cells) - (bool(cells) and not cells[0].strip())
    if columns:
        columns = ["", *columns] if len(columns) == size < len(cells) else columns
        if len(columns) != len(cells):
            raise ValueError(
                f"{len(columns)} columns are named, and its first line has {len(cells)} cells: cut off what is no row"
            )
        return header_of(columns), not any(numbers)
    if sum(numbers) > len(numbers) / 2:
        said = f"is of {len(numbers)} numbers" if all(numbers) else f"holds {sum(numbers)} numbers"
        example = " ".join(f"x{k}" for k in range(size))
        raise ValueError(
            f"its first line {said} and no header: name its {size} columns, --columns {example[:60]}"
        )
    return header_of(cells), True


def header_of(cells: Sequence[str]) -> list[str]:
    """Return the names of columns. Raises ValueError where there are none or too many."""
    names = [cell.strip().lstrip("#%-").strip() for cell in cells]
    while names and not names[-1]:  # ;;; at the end of every line
        names.pop()
    if not names:
        raise ValueError("it needs a header and at least one row, got 0 lines")
    check_width(len(names))
    return names


def numbers_in(cells: Any, comma: bool = False) -> NDArray[np.float64]:
    """Return the numbers (T,) of cells of text: decimals, true and false; NaN of empty cells and of words."""
    import pandas as pd

    text = pd.Series(cells).astype("string").str.strip()
    plain = text.str.replace(",", ".", regex=False) if comma else text
    found = (
        pd.to_numeric(plain, errors="coerce").fillna(text.str.lower().map(FLAGS)).astype("Float64")
    )
    return found.to_numpy(np.float64, na_value=np.nan)


def _column(cells: pd.Series[Any], comma: bool) -> NDArray[Any]:
    """A column of numbers, or of words where it holds one."""
    if cells.dtype.kind in "biuf":
        return np.asarray(cells)
    text = cells.astype("string").str.strip().fillna("")
    values = numbers_in(text, comma)
    if not np.isnan(values[(text != "").to_numpy(bool)]).any():
        return values
    return np.asarray(text.str[:LONGEST_WORD], object)


def read_json_lines(path: Path, columns: Sequence[str] = ()) -> Columns:
    """Return the columns of a file with an object, or a list of numbers, on each line; a missing number is NaN."""
    import pandas as pd

    rows, lost = list[dict[str, Any]](), list[str]()
    lines, complete = _lines(path)
    for n, line in lines.items():
        try:
            row = json.loads(line)
            rows.append(flat_row(row, columns))
            check_width(len(rows[-1]))
        except (ValueError, RecursionError) as error:
            if (
                rows
                and isinstance(error, json.JSONDecodeError)
                and n == lines.index[-1]
                and not complete
            ):
                note(f"{path}: its last line was cut off, and is left out")
                continue
            raise ValueError(f"line {n} is no row: {error}") from error
        if isinstance(row, dict) and len(rows) == 1:
            lost = [
                k
                for k, v in row.items()
                if isinstance(v, list) and v and isinstance(v[0], dict | list)
            ]
    if not rows:
        raise ValueError("it needs at least one row, got none")
    if lost:
        note(f"left out: {', '.join(lost)}: lists of objects; a row is to be a line of its own")
    frame = pd.DataFrame(rows)
    return {name: _column(frame[name], comma=False) for name in frame.columns}


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
    words: list[Any] = next(
        (row[key] for key in ("name", "names", "joint_names") if isinstance(row.get(key), list)), []
    )
    found: dict[str, Any] = {}
    for name, value in row.items():
        if isinstance(value, dict):
            found |= {f"{name}.{part}": v for part, v in flat_row(value).items()}
        elif isinstance(value, list):
            elements = words if len(words) == len(value) else range(len(value))
            numbers = zip(elements, value, strict=True)
            found |= {
                element_name(name, k): v
                for k, v in numbers
                if isinstance(v, int | float) or v is None
            }
        else:
            found[name] = value
    return found
