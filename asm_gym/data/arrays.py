"""Read Parquet files, NumPy arrays and HDF5; files that declare more than they hold are refused unread."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from asm_gym.data.text import Columns
from asm_gym.extras import require
from asm_gym.files import regular_file

MOST_EXPANDED = 100
"""How many times larger than its file the content may be: pictures of one colour shrink by that."""

SMALL = 16 * 2**20
"""[bytes] that no file is too small for."""


def check_declared(path: Path, declared: int, size: int) -> None:
    """Raise ValueError where a file of ``size`` says that it holds ``declared`` [bytes], and that cannot be."""
    if declared > max(SMALL, MOST_EXPANDED * size):
        raise ValueError(f"{path} declares {declared} bytes, and has {size}")


def read_parquet(path: Path) -> Columns:
    """Return the columns of a Parquet file.

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
    return {name: np.asarray(table[name]) for name in table.column_names}


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


@contextmanager
def opened_hdf5(path: Path) -> Iterator[Any]:
    """Open an HDF5 file for reading.

    Raises:
        FileNotFoundError: there is none.
        ValueError: it is no regular file, declares what was never written, or reads from other files.
        OSError: it is no HDF5.
    """
    h5py = require("h5py", what="an HDF5 file")
    size = regular_file(path)
    with h5py.File(path, "r") as file:
        check_declared(path, sum(_declared(h5py, file)), size)
        yield file


def _declared(h5py: Any, group: Any) -> Iterator[int]:
    """[bytes] of each array at or below a group."""
    for name in group:
        if not isinstance(group.get(name, getlink=True), h5py.HardLink):
            raise ValueError(f"{group.name}/{name} points elsewhere, which is not followed")
        node = group[name]
        if isinstance(node, h5py.Group):
            yield from _declared(h5py, node)
        elif isinstance(node, h5py.Dataset):
            if node.external or node.is_virtual:
                raise ValueError(f"{node.name} is kept in another file, which is not read")
            if node.nbytes and not node.id.get_storage_size():
                raise ValueError(f"{node.name} declares {node.nbytes} bytes that were never written")
            yield int(node.nbytes)
