"""Refuse files that are not as they were written, or that declare more than they hold."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

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


def digest(path: Path) -> str:
    """Return the SHA-256 of a file in hexadecimal digits."""
    with path.open("rb") as opened:
        return hashlib.file_digest(opened, "sha256").hexdigest()


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
