"""Columns of numbers from files: CSV, Parquet and NumPy, looked at before they are read."""

from __future__ import annotations

import csv
from collections.abc import Iterator, Sequence
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from asm_gym.data.hdf5 import MOST_EXPANDED, SMALL
from asm_gym.extras import require
from asm_gym.files import regular_file

AT_ONCE = 4096
"""Lines of text held at a time."""


def read_table(path: Path) -> dict[str, NDArray[Any]]:
    """The columns of numbers of a ``.csv`` file with a header: text is left out, an empty cell is NaN.

    Text is held a few thousand lines at a time; what is kept are numbers.

    Raises:
        ValueError: no header or no row, a name that stands twice, rows of several lengths, a column of numbers that
            holds something else.
    """
    with path.open(newline="", encoding="utf-8-sig") as file:
        lines = (line for line in csv.reader(file) if line)
        header = header_of(next(lines, []), str(path))
        parts: list[list[NDArray[Any] | None]] = [[] for _ in header]
        wrong: list[tuple[int, str] | None] = [None] * len(header)
        done = 0
        for block in _blocks(lines):
            for n, line in enumerate(block, done + 2):
                if len(line) != len(header):
                    raise ValueError(f"{path}, line {n} has {len(line)} cells, its header {len(header)}")
            for k, cells in enumerate(zip(*block, strict=True)):
                values, bad, words = _numbers(cells)
                if bad is not None and wrong[k] is None:
                    wrong[k] = done + bad + 2, cells[bad]
                parts[k].append(None if words else values)
            done += len(block)
    if not done:
        raise ValueError(f"{path} needs a header and at least one row, got {int(bool(header))} lines")
    columns = {}
    for name, found, bad_cell in zip(header, parts, wrong, strict=True):
        if all(part is None for part in found):
            continue  # of words alone
        if bad_cell is not None:
            raise ValueError(f"{path}, {name}, line {bad_cell[0]} must be a number, got {bad_cell[1]!r}")
        columns[name] = np.concatenate([part for part in found if part is not None])
    return columns


def header_of(cells: Sequence[str], where: str) -> list[str]:
    """The names of columns. Raises ValueError where there are none, or one stands twice."""
    names = [name.strip() for name in cells]
    if not names:
        raise ValueError(f"{where} needs a header and at least one row, got 0 lines")
    doubled = sorted({name for name in names if names.count(name) > 1})
    if doubled:
        raise ValueError(f"{where} has columns of the same name: {', '.join(map(repr, doubled))}")
    return names


def _blocks(lines: Iterator[list[str]]) -> Iterator[list[list[str]]]:
    while block := list(islice(lines, AT_ONCE)):
        yield block


def _numbers(cells: Sequence[str]) -> tuple[NDArray[np.float64], int | None, bool]:
    """Text as numbers, NaN where there is none; the first that is none; and whether all of it are words."""
    try:
        return np.array([float(cell or "nan") for cell in cells]), None, False
    except ValueError:
        pass
    values, wrong = np.full(len(cells), np.nan), []
    for n, cell in enumerate(cells):
        try:
            values[n] = float(cell or "nan")
        except ValueError:
            wrong.append(n)
    return values, wrong[0], len(wrong) == sum(bool(cell) for cell in cells)


def read_parquet(path: Path) -> dict[str, NDArray[Any]]:
    """The columns of a Parquet file, those of lists as arrays of two dimensions.

    Raises:
        ValueError: it is damaged, empty, or declares far more than it holds.
        ImportError: pyarrow is not installed.
    """
    parquet = require("pyarrow.parquet", what="a Parquet file")
    size = regular_file(path)
    try:
        with parquet.ParquetFile(path) as file:
            about = file.metadata
            declared = sum(about.row_group(k).total_byte_size for k in range(about.num_row_groups))
            check_declared(path, max(declared, 8 * about.num_rows * about.num_columns), size)
            table = file.read()
    except OSError as error:
        raise ValueError(f"{path} is damaged: {error}") from error
    return {name: as_array(table[name]) for name in table.column_names}


def check_declared(path: Path, declared: int, size: int) -> None:
    """Raises ValueError where a file of ``size`` says that it holds ``declared`` [bytes], and that cannot be."""
    if declared > max(SMALL, MOST_EXPANDED * size):
        raise ValueError(f"{path} declares {declared} bytes, and has {size}")


def as_array(column: Any) -> NDArray[Any]:
    """(T,) or, of lists of one length, (T, k)."""
    array = np.asarray(column)
    if array.dtype == object and len(array) and isinstance(array[0], list | tuple | np.ndarray):
        lengths = {len(row) for row in array if row is not None}
        if len(lengths) == 1 and all(row is not None for row in array):
            return np.array(array.tolist())
    return array


def read_array(path: Path) -> dict[str, NDArray[Any]]:
    """The array of a ``.npy`` file, (T,) or (T, k), as the column ``value``. Raises ValueError where it is damaged."""
    if not regular_file(path):
        raise ValueError(f"{path} is empty")
    array = np.load(path, mmap_mode="r", allow_pickle=False)  # which refuses a file shorter than it declares
    if array.ndim not in (1, 2):
        raise ValueError(f"{path} must hold rows of numbers, got an array of shape {array.shape}")
    return {"value": np.array(array)}
