"""Columns of numbers from binary files, Parquet and NumPy, looked at before they are read; text is read by ``text``."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from asm_gym.data.hdf5 import MOST_EXPANDED, SMALL
from asm_gym.extras import require
from asm_gym.files import regular_file


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


def read_array(path: Path, columns: Sequence[str] = ()) -> dict[str, NDArray[Any]]:
    """The array of a ``.npy`` file, (T,) or (T, k), as columns of these names, or as the one column ``value``.

    Raises:
        ValueError: it is damaged, or has not as many columns as are named.
    """
    if not regular_file(path):
        raise ValueError(f"{path} is empty")
    try:
        array = np.load(path, mmap_mode="r", allow_pickle=False)  # which refuses a file shorter than it declares
    except Exception as error:  # its header is Python, and whatever reading that may raise, damage raises
        raise ValueError(
            f"{path} is damaged: {str(error).splitlines()[0] if str(error) else type(error).__name__}"
        ) from error
    if not isinstance(array, np.ndarray) or array.dtype.kind not in "biuf":
        raise ValueError(f"{path} must hold rows of numbers, got {getattr(array, 'dtype', type(array).__name__)}")
    if array.ndim not in (1, 2):
        raise ValueError(f"{path} must hold rows of numbers, got an array of shape {array.shape}")
    if columns:
        rows = array.reshape(len(array), -1)
        if rows.shape[1] != len(columns):
            raise ValueError(f"{len(columns)} columns are named, and {path} has {rows.shape[1]}")
        return {name: np.array(rows[:, k]) for k, name in enumerate(columns)}
    return {"value": np.array(array)}
