"""Read the columns of Parquet files and NumPy arrays, which are looked at before they are read."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from asm_gym.data.integrity import check_declared
from asm_gym.extras import require
from asm_gym.files import regular_file

Columns = dict[str, NDArray[Any]]


def read_parquet(path: Path) -> Columns:
    """Return the columns of a Parquet file, those of lists as arrays of two dimensions.

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


def as_array(column: Any) -> NDArray[Any]:
    """Return (T,) or, of lists of one length, (T, k)."""
    array = np.asarray(column)
    if array.dtype == object and len(array) and isinstance(array[0], list | tuple | np.ndarray):
        lengths = {len(row) for row in array if row is not None}
        if len(lengths) == 1 and all(row is not None for row in array):
            return np.array(array.tolist())
    return array


def read_array(path: Path, columns: Sequence[str] = ()) -> Columns:
    """Return the array of a ``.npy`` file, (T,) or (T, k), as columns of these names, or as the one column ``value``.

    Raises:
        ValueError: it is damaged, or has not as many columns as are named.
    """
    if not regular_file(path):
        raise ValueError(f"{path} is empty")
    try:
        array = np.load(path, mmap_mode="r", allow_pickle=False)  # which refuses a file shorter than it declares
    except Exception as error:  # its header is Python, and whatever reading that may raise, damage raises
        reason = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise ValueError(f"{path} is damaged: {reason}") from error
    if isinstance(array, np.ndarray) and array.dtype.names:
        return {name: np.array(array[name]) for name in array.dtype.names}
    if not isinstance(array, np.ndarray) or array.dtype.kind not in "biuf" or array.ndim not in (1, 2):
        what = f"{array.dtype} of shape {array.shape}" if isinstance(array, np.ndarray) else type(array).__name__
        raise ValueError(f"{path} must hold rows of numbers, got {what}")
    if not columns:
        return {"value": np.array(array)}
    rows = array.reshape(len(array), -1)
    if rows.shape[1] != len(columns):
        raise ValueError(f"{len(columns)} columns are named, and {path} has {rows.shape[1]}")
    return {name: np.array(rows[:, k]) for k, name in enumerate(columns)}
