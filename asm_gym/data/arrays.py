"""Read Parquet files, NumPy's arrays, MATLAB's, and HDF5, which is checked before it is read."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from asm_gym.data.tables import Columns
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
    try:
        # a file shorter than it declares is refused
        array = np.array(np.load(path, mmap_mode="r", allow_pickle=False))
    except ValueError as error:  # whose remedy is unsafe
        raise ValueError("it is damaged, or no array of numbers") from error
    if array.dtype.names and array.ndim == 1:
        return {name: array[name] for name in array.dtype.names if array[name].ndim <= 2}
    if array.dtype.kind not in "biuf" or array.ndim not in (1, 2):
        raise ValueError(f"it must hold rows of numbers, got {array.dtype} of shape {array.shape}")
    rows = array.reshape(len(array), -1)
    if columns and rows.shape[1] != len(columns):
        raise ValueError(f"{len(columns)} columns are named, and it has {rows.shape[1]}")
    return {name: rows[:, k] for k, name in enumerate(columns)} or {"value": array}


def read_mat(path: Path) -> Columns:
    """Return the variables of a MATLAB file, (T,) or (T, k), fields of structures as ``data.q``."""
    from scipy.io import loadmat

    try:
        return _along_time(_numbers_in(loadmat(path, simplify_cells=True)))
    except NotImplementedError:
        return read_hdf5(path)[""][0]  # version 7.3 is HDF5


def _numbers_in(tree: Mapping[str, Any]) -> Columns:
    """The arrays of numbers, of one or two dimensions, in a structure or a group, and in those within it."""
    made: Columns = {}
    for name, node in tree.items():
        if hasattr(node, "items"):
            made |= {f"{name}.{inner}": values for inner, values in _numbers_in(node).items()}
        elif getattr(node, "ndim", 0) in (1, 2) and node.dtype.kind in "biuf":
            values = np.asarray(node)
            made[name] = values[:, 0] if values.ndim == 2 and values.shape[1] == 1 else values
    return made


def _along_time(arrays: Columns) -> Columns:
    """Arrays with their rows along time: those of the length that most have, turned where that stands second."""
    lengths = [size for array in arrays.values() for size in array.shape if size > 1]
    rows = max(set(lengths), key=lambda size: (lengths.count(size), size), default=0)
    turned = {
        n: a.T if a.ndim == 2 and a.shape[0] != rows == a.shape[1] else a for n, a in arrays.items()
    }
    return {name: array for name, array in turned.items() if len(array) == rows}


def read_hdf5(path: Path) -> dict[str, tuple[Columns, float | None]]:
    """Return columns and rate [Hz] of each demonstration of robomimic; of other HDF5, all under an empty name.

    Observations are columns of their names, and actions are called so. Source: robomimic, "Dataset Contents".
    """
    h5py = require("h5py", what="an HDF5 file")
    check_hdf5(path)
    with h5py.File(path, "r") as file:
        if not hasattr(file.get("data"), "items"):
            return {"": (_along_time(_numbers_in(file)), None)}
        rate = (
            json.loads(file["data"].attrs.get("env_args", "{}"))
            .get("env_kwargs", {})
            .get("control_freq")
        )
        made = {}
        for name in sorted(file["data"], key=lambda name: (len(name), name)):
            group = file["data"][name]
            actions = {"actions": np.asarray(group["actions"])} if "actions" in group else {}
            made[name] = (_numbers_in(group.get("obs", group)) | actions, rate)
        return made


def check_hdf5(path: Path) -> None:
    """Raise ValueError where an HDF5 file declares what was never written, or reads from other files; or OSError."""
    h5py = require("h5py", what="an HDF5 file")
    regular_file(path)

    def check(group: Any) -> None:
        for name in group:
            if not isinstance(group.get(name, getlink=True), h5py.HardLink):
                raise ValueError(f"{group.name}/{name} is a link, and links are not followed")
            node = group[name]
            if isinstance(node, h5py.Group):
                check(node)
            elif isinstance(node, h5py.Dataset):
                if node.external or node.is_virtual:
                    raise ValueError(f"{node.name} is kept in another file, which is not read")
                if node.nbytes and not node.id.get_storage_size():
                    raise ValueError(
                        f"{node.name} declares {node.nbytes} bytes that were never written"
                    )

    with h5py.File(path, "r") as file:
        check(file)
