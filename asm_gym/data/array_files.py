"""Read Parquet files, NumPy's arrays, MATLAB's, and HDF5, which is checked before it is read."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from asm_gym.data.reader_notes import note
from asm_gym.data.table_layout import MOST_BYTES, Columns, is_numeric
from asm_gym.exceptions import DamagedFile
from asm_gym.extras import require
from asm_gym.files import regular_file


def read_parquet(path: Path) -> Columns:
    """Return the columns of a Parquet file. Raises ValueError where it is damaged."""
    parquet = require("pyarrow.parquet", what="a Parquet file")
    regular_file(path)
    try:
        file = parquet.ParquetFile(path)
        table = file.read()
    except OSError as error:
        raise DamagedFile(path, error) from error
    return {name: np.asarray(table[name]) for name in table.column_names}


def read_array(path: Path, columns: Sequence[str] = ()) -> Columns:
    """Return the array of a ``.npy`` file, (T,) or (T, k), as columns of these names, or as the column ``value``."""
    try:
        # a file shorter than it declares is refused
        mapped = np.load(path, mmap_mode="r", allow_pickle=False)
        array = np.array(mapped)
    except ValueError as error:  # whose remedy is unsafe
        raise ValueError("it is damaged, or no array of numbers") from error
    if array.dtype.names and array.ndim == 1:
        return {name: array[name] for name in array.dtype.names}
    if not is_numeric(array) or array.ndim not in (1, 2):
        raise ValueError(
            f"it must hold rows of numbers, got {array.dtype} of shape {array.shape}",
        )
    if not columns:
        return {"value": array}
    series = array.reshape(len(array), -1).T
    if len(series) != len(columns):
        raise ValueError(
            f"{len(columns)} columns are named, and it has {len(series)}",
        )
    return dict(zip(columns, series, strict=True))


def read_mat(path: Path) -> Columns:
    """Return the variables of a MATLAB file, (T,) or (T, k), fields of structures as ``data.q``."""
    from scipy.io import loadmat

    try:
        tree = loadmat(path, simplify_cells=True)
    except NotImplementedError:
        return read_hdf5(path)[""][0]  # version 7.3 is HDF5
    return _along_time(_numbers_in(tree))


def read_hdf5(path: Path) -> dict[str, tuple[Columns, float | None]]:
    """Return columns and rate [Hz] of each demonstration of robomimic; of other HDF5, all under an empty name.

    Observations are columns of their names, and actions are called so. Pictures are left out, with a note.
    Source: robomimic, "Dataset Contents".
    """
    h5py = require("h5py", what="an HDF5 file")
    check_hdf5(path)
    with h5py.File(path, "r") as file:
        data = file.get("data")
        if not hasattr(data, "items"):
            columns = _along_time(_numbers_in(file))
            return {"": (columns, None)}
        settings = json.loads(data.attrs.get("env_args", "{}"))
        rate = settings.get("env_kwargs", {}).get("control_freq")
        demonstrations = {}
        for name in sorted(data, key=lambda name: (len(name), name)):
            group = data[name]
            observations = group.get("obs", group)
            columns = _senses(_numbers_in(observations))
            if "actions" in group:
                columns["actions"] = np.asarray(group["actions"])
            demonstrations[name] = (columns, rate)
        return demonstrations


def _numbers_in(tree: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    """The arrays of numbers, of one or two dimensions, in a structure or a group, and in those within it.

    Those of an HDF5 file are not read yet.
    """
    arrays: dict[str, Any] = {}
    for name, node in tree.items():
        path = f"{prefix}{name}"
        if hasattr(node, "items"):
            arrays |= _numbers_in(node, f"{path}.")
        elif not getattr(node, "ndim", 0) or not is_numeric(node):
            continue
        elif node.ndim > 2:
            note(f"left out: {path}: {node.ndim} dimensions, as of pictures")
        elif name == "compress_len":  # as ALOHA calls it
            note(f"left out: {path}: lengths of compressed pictures")
        else:
            arrays[path] = node
    return arrays


def _along_time(arrays: dict[str, Any]) -> Columns:
    """Read the arrays whose rows are along time: T is the length that most have, and may stand second."""
    lengths: Counter[int] = Counter()
    for array in arrays.values():
        lengths.update(size for size in array.shape if size > 1)
    rows = max(lengths, key=lambda length: (lengths[length], length), default=0)
    series = {name: array for name, array in arrays.items() if rows in array.shape}
    return _senses(series, rows)


def _senses(arrays: dict[str, Any], rows: int = 0) -> Columns:
    """Read arrays (T,) or (T, k) of senses; pictures are left out.

    Args:
        arrays: by name, of NumPy or of HDF5.
        rows: T, by which arrays (k, T) are turned; by default T stands first.
    """
    columns: Columns = {}
    for name, array in arrays.items():
        length = rows or len(array)
        is_bytes = array.dtype in (np.int8, np.uint8)
        if is_bytes and array.size > MOST_BYTES * length:
            note(
                f"left out: {name}: {array.dtype} of shape {array.shape}, as of pictures",
            )
            continue
        values = np.asarray(array)
        if len(values) != length:
            values = values.T
        if values.shape[1:] == (1,):
            values = values[:, 0]
        columns[name] = values
    return columns


def check_hdf5(path: Path) -> None:
    """Raise ValueError where an HDF5 file declares what was never written, or reads from other files; or OSError."""
    h5py = require("h5py", what="an HDF5 file")
    regular_file(path)
    with h5py.File(path, "r") as file:
        _check_group(file)


def _check_group(group: Any) -> None:
    import h5py

    for name in group:
        link = group.get(name, getlink=True)
        if not isinstance(link, h5py.HardLink):
            raise ValueError(f"{group.name}/{name} is a link, and links are not followed")
        node = group[name]
        if isinstance(node, h5py.Group):
            _check_group(node)
        elif isinstance(node, h5py.Dataset):
            _check_dataset(node)


def _check_dataset(node: Any) -> None:
    if node.external or node.is_virtual:
        raise ValueError(f"{node.name} is kept in another file, which is not read")
    if node.nbytes and not node.id.get_storage_size():
        raise ValueError(
            f"{node.name} declares {node.nbytes} bytes that were never written",
        )
