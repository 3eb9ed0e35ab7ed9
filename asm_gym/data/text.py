"""Columns of numbers from text: CSV of any country, tables without a header, and JSON lines.

separator   the one of ; tab , | that the first line holds most of, or else blanks
decimals    a point; where the separator is no comma, a comma too: 0,1096
header      names, perhaps behind a # or with blanks; without one, columns are named by whoever reads
last line   cut off in the middle: left out, and said
"""

from __future__ import annotations

import csv
import json
import re
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from itertools import chain, islice
from pathlib import Path
from typing import Any, NamedTuple, TextIO

import numpy as np
from numpy.typing import NDArray

from asm_gym.data.clock_column import is_clock
from asm_gym.data.reader_notes import note
from asm_gym.files import regular_file

AT_ONCE = 4096
"""Lines of text held at a time."""

LONGEST_LINE = 2**22
"""Characters of a line; a row of a robot has some thousand."""

LONGEST_CELL = 4096
"""Characters of a cell that is read; what is longer is no number and no name."""

MOST_COLUMNS = 8192
"""Every number is weighed against every other later on: see ``whitening``."""

SEPARATORS = ";\t,|"

_FLAGS = {"true": 1.0, "false": 0.0}
_NUMBER = re.compile(r"[+-]?(\d+[.,]?\d*|[.,]\d+)(e[+-]?\d+)?|nan|[+-]?inf(inity)?", re.I)

Keeps = Callable[[str], bool]
"""Whether words of a column of this name are kept."""


class Dialect(NamedTuple):
    """How lines are cut into cells, and cells read.

    Attributes:
        separator: between cells; a blank stands for any number of them.
        comma: decimals may stand behind a comma.
    """

    separator: str
    comma: bool

    @classmethod
    def of(cls, line: str) -> Dialect:
        """By the first line of a table."""
        counts = {mark: line.count(mark) for mark in SEPARATORS}
        best = ";" if counts[";"] else max(counts, key=lambda mark: counts[mark])
        separator = best if counts[best] else (" " if len(line.split()) > 1 else ",")
        return cls(separator, separator != ",")

    def cells(self, lines: Iterator[str]) -> Iterator[list[str]]:
        """The cells of each line that is not blank. Raises ValueError where one cannot be cut."""
        if self.separator == " ":
            yield from (line.split() for line in lines if line.strip())
            return
        try:
            yield from (row for row in csv.reader(lines, delimiter=self.separator) if row)
        except csv.Error as error:
            raise ValueError(f"it is no table of text: {error}") from error

    def number(self, cell: str) -> float:
        """NaN of an empty one. Raises ValueError where it is none."""
        if len(cell) > LONGEST_CELL:
            raise ValueError(f"a cell of {len(cell)} characters is no number")
        text = cell.strip() or "nan"
        try:
            return float(text)
        except ValueError:
            return float(text.replace(",", ".") if self.comma and "." not in text else text)


def read_table(path: Path, columns: Sequence[str] = (), keeps: Keeps = is_clock) -> dict[str, NDArray[Any]]:
    """The columns of numbers of a table of text; an empty cell is NaN, true and false are 1 and 0.

    Text is held a few thousand lines at a time; what is kept are numbers.

    Args:
        columns: names of the columns of a table without a header.
        keeps: whose words are kept, by name; other columns of words are left out.

    Raises:
        ValueError: no header or no row, a name that stands twice, rows of several lengths, a column of numbers that
            holds something else.
    """
    regular_file(path)
    with path.open(newline="", encoding="utf-8-sig") as file:
        lines = _lines(file)
        first = next((line for line in lines if line.strip()), "")
        how = Dialect.of(first)
        rows = how.cells(chain([first] if first else [], lines))
        names, rows, before = _begun(next(rows, []), rows, columns)
        if len(names) > MOST_COLUMNS:
            raise ValueError(f"it has {len(names)} columns, and at most {MOST_COLUMNS} can be watched")
        return _Columns(names, how, keeps, path if _cut_off(file) else None, before).read(rows)


def _lines(file: TextIO) -> Iterator[str]:
    while line := file.readline(LONGEST_LINE):
        if len(line) == LONGEST_LINE:
            raise ValueError(f"a line of {LONGEST_LINE} characters or more is no row")
        yield line


def _cut_off(file: TextIO) -> bool:
    """Whether its last line has no end."""
    with open(file.name, "rb") as raw:
        raw.seek(-1, 2)
        return raw.read(1) not in b"\r\n"


def _begun(
    start: list[str], rows: Iterator[list[str]], columns: Sequence[str]
) -> tuple[list[str], Iterator[list[str]], int]:
    """Names of columns, the rows, and how many lines stand before them."""
    if len(start) > 1 and start[0] in ("#", "%"):  # in front of a header whose names stand apart by blanks
        start = start[1:]
    numbers = [bool(_NUMBER.fullmatch(cell.strip())) for cell in start if cell.strip()]
    if columns:
        if len(columns) != len(start):
            raise ValueError(f"{len(columns)} columns are named, and its first line has {len(start)} cells")
        return (header_of(columns, "it"), chain([start], rows), 0) if all(numbers) else (list(columns), rows, 1)
    if numbers and all(numbers):
        raise ValueError(f"its first line is of {len(numbers)} numbers and no header: name its columns with --columns")
    return header_of(start, "it"), rows, 1


def header_of(cells: Sequence[str], where: str) -> list[str]:
    """The names of columns; one without is ''. Raises ValueError where there are none, or one stands twice."""
    names = [cell.strip().lstrip("#%-").strip() if cell.strip() not in ("%", "#") else "" for cell in cells]
    while names and not names[-1]:  # ;;; at the end of every line
        names.pop()
    if not names:
        raise ValueError(f"{where} needs a header and at least one row, got 0 lines")
    doubled = sorted(name for name, count in Counter(names).items() if count > 1)
    if doubled:
        raise ValueError(f"{where} has columns of the same name: {', '.join(map(repr, doubled[:8]))}")
    return names


class _Columns:
    """Columns in the making."""

    def __init__(self, names: list[str], how: Dialect, keeps: Keeps, cut_off: Path | None, before: int) -> None:
        self.names, self.how, self.before = names, how, before
        self.keeps, self.cut_off = [keeps(name) for name in names], cut_off
        self.parts: list[list[NDArray[Any] | None]] = [[] for _ in names]
        self.wrong: list[tuple[int, str] | None] = [None] * len(names)

    def read(self, rows: Iterator[list[str]]) -> dict[str, NDArray[Any]]:
        done = 0
        block, last = list(islice(rows, AT_ONCE)), None
        while block:
            following = list(islice(rows, AT_ONCE))
            last = block[-2] if len(block) > 1 else last
            if not following and self.cut_off and not self._whole(block[-1], last):
                note(f"{self.cut_off}: its last line was cut off, and is left out")
                block.pop()
            lines = [self._fitted(line, n) for n, line in enumerate(block, done + self.before + 1)]
            for k, cells in enumerate(zip(*lines, strict=True)):
                self._add(k, cells, done + self.before + 1)
            done += len(block)
            last = block[-1] if block else last
            block = following
        if not done:
            raise ValueError(f"it needs a header and at least one row, got {self.before} lines")
        return self._made()

    def _whole(self, line: list[str], before: list[str] | None) -> bool:
        """Whether a line is a row: as long as its header, and numbers where the one before it has numbers."""
        if before is None or len(line) < len(self.names):
            return len(line) >= len(self.names)
        return not any(self._is_word(now) and not self._is_word(then) for now, then in zip(line, before, strict=False))

    def _is_word(self, cell: str) -> bool:
        try:
            self.how.number(cell)
        except ValueError:
            return cell.strip().lower() not in _FLAGS
        return False

    def _fitted(self, line: list[str], n: int) -> list[str]:
        size = len(self.names)
        if len(line) == size:
            return line
        if len(line) < size or any(cell.strip() for cell in line[size:]):
            raise ValueError(f"line {n} has {len(line)} cells, its header {size}")
        return line[:size]

    def _add(self, k: int, cells: Sequence[str], line: int) -> None:
        try:
            # A float that Python reads needs no further look, and nearly all are.
            self.parts[k].append(np.array([float(cell or "nan") for cell in cells]))
            return
        except ValueError:
            pass
        values, wrong = np.full(len(cells), np.nan), []
        for n, cell in enumerate(cells):
            flag = _FLAGS.get(cell.strip().lower()) if len(cell) < 9 else None
            try:
                values[n] = self.how.number(cell) if flag is None else flag
            except ValueError:
                wrong.append(n)
        words = len(wrong) == sum(bool(cell) for cell in cells)
        if self.keeps[k] and wrong:
            self.parts[k].append(np.array([cell[:64] for cell in cells], dtype=object))
            return
        if wrong and self.wrong[k] is None:
            self.wrong[k] = line + wrong[0], cells[wrong[0]][:40]
        self.parts[k].append(None if words and wrong else values)

    def _made(self) -> dict[str, NDArray[Any]]:
        made: dict[str, NDArray[Any]] = {}
        for name, found, bad in zip(self.names, self.parts, self.wrong, strict=True):
            if all(part is None for part in found):
                continue  # of words alone
            if bad is not None:
                raise ValueError(f"{name}, line {bad[0]} must be a number, got {bad[1]!r}")
            values = np.concatenate([part for part in found if part is not None])
            if name or not np.isnan(values.astype(np.float64)).all():
                made[name] = values
        return made


def read_json_lines(path: Path, columns: Sequence[str] = (), keeps: Keeps = is_clock) -> dict[str, NDArray[Any]]:
    """The columns of a file with an object, or a list of numbers, on each line; objects within objects are flattened.

    A number that a line lacks is NaN, and so is null.

    Raises:
        ValueError: a line is neither; it names the line.
    """
    regular_file(path)
    rows: list[dict[str, Any]] = []
    with path.open(encoding="utf-8-sig") as file:
        for n, line in enumerate(_lines(file), 1):
            if not line.strip():
                continue
            try:
                rows.append(_flat(json.loads(line), columns))
            except (ValueError, RecursionError) as error:
                if isinstance(error, json.JSONDecodeError) and not line.endswith("\n"):
                    note(f"{path}: its last line was cut off, and is left out")
                    continue
                raise ValueError(f"line {n} is no row: {error}") from error
            if len(rows[-1]) > MOST_COLUMNS:
                raise ValueError(f"it has {len(rows[-1])} columns, and at most {MOST_COLUMNS} can be watched")
    if not rows:
        raise ValueError("it needs at least one row, got none")
    made: dict[str, NDArray[Any]] = {}
    for name in dict.fromkeys(name for row in rows for name in row):
        cells = [row.get(name) for row in rows]
        if all(cell is None or isinstance(cell, int | float) for cell in cells):
            made[name] = np.array([np.nan if cell is None else float(cell) for cell in cells])
        elif keeps(name) and not any(isinstance(cell, list) for cell in cells):
            made[name] = np.array(["" if cell is None else str(cell)[:64] for cell in cells], dtype=object)
    return made


def _flat(said: Any, columns: Sequence[str]) -> dict[str, Any]:
    """By name; the numbers of a list by the list's name and their place."""
    if isinstance(said, list):
        if len(said) != len(columns):
            raise ValueError(f"it is a list of {len(said)}, and {len(columns)} columns are named (--columns)")
        said = dict(zip(columns, said, strict=True))
    if not isinstance(said, dict):
        raise ValueError(f"it must be an object or a list, got {str(said)[:40]}")
    found: dict[str, Any] = {}
    for name, value in said.items():
        if isinstance(value, dict):
            found |= {f"{name}.{part}": v for part, v in _flat(value, ()).items()}
        elif isinstance(value, list):
            found |= {f"{name}[{k}]": v for k, v in enumerate(value) if isinstance(v, int | float) or v is None}
        else:
            found[name] = value
    return found
