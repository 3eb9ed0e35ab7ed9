"""Read Parquet files and NumPy arrays, and check HDF5 before it is read."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from asm_gym.data.text import Columns
from asm_gym.extras import require
from asm_gym.files import regular_file


def read_parquet(path: Path) -> Columns:
    """Return the columns of a Parquet file. Raises ValueError where it is damaged."""
    parquet = require("pyarrow.parquet", what="a Parquet file")
    regular_file(path)
    try:
        table = parquet.ParquetFile(path).read()
    except OSError as error:
        raise ValueError(f"{path} is damaged: {error}") from error
    return {name: np.asarray(table[name]) for name in table.column_names}


def read_array(path: Path, columns: Sequence[str] = ()) -> Columns:
    """Return the array of a ``.npy`` file, (T,) or (T, k), as columns of these names, or as the column ``value``."""
    if not regular_file(path):
        raise ValueError(f"{path} is empty")
    try:
        array = np.array(np.load(path, mmap_mode="r", allow_pickle=False))  # a file shorter than it declares is refused
    except Exception as error:  # its header is Python, and whatever reading that may raise, damage raises
        raise ValueError(f"{path} is damaged: {' '.join(str(error).split()) or type(error).__name__}") from error
    if array.dtype.kind not in "biuf" or array.ndim not in (1, 2):
        raise ValueError(f"{path} must hold rows of numbers, got {array.dtype} of shape {array.shape}")
    rows = array.reshape(len(array), -1)
    if columns and rows.shape[1] != len(columns):
        raise ValueError(f"{len(columns)} columns are named, and {path} has {rows.shape[1]}")
    return {name: rows[:, k] for k, name in enumerate(columns)} or {"value": array}


def check_hdf5(path: Path) -> None:
    """Raise ValueError where an HDF5 file declares what was never written, or reads from other files; or OSError."""
    h5py = require("h5py", what="an HDF5 file")
    regular_file(path)
    with h5py.File(path, "r") as file:
        _check_group(h5py, file)


def _check_group(h5py: Any, group: Any) -> None:
    for name in group:
        if not isinstance(group.get(name, getlink=True), h5py.HardLink):
            raise ValueError(f"{group.name}/{name} points elsewhere, which is not followed")
        node = group[name]
        if isinstance(node, h5py.Group):
            _check_group(h5py, node)
        elif isinstance(node, h5py.Dataset):
            if node.external or node.is_virtual:
                raise ValueError(f"{node.name} is kept in another file, which is not read")
            if node.nbytes and not node.id.get_storage_size():
                raise ValueError(f"{node.name} declares {node.nbytes} bytes that were never written")
