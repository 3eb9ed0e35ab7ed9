"""Checkpoints: one file of arrays and JSON, never pickle.

The file is a zip of ``.npy`` arrays, as an ``.npz`` is, with a JSON header beside them. A zip carries a checksum of
every member, so damage is noticed when it is read.
"""

from __future__ import annotations

import json
import os
import tempfile
import zipfile
import zlib
from collections.abc import Mapping
from pathlib import Path
from typing import IO, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

FORMAT = "asm-gym"
VERSION = 1
HEADER = "header.json"


class Checkpoint(NamedTuple):
    """What a file held: JSON values, and arrays by name."""

    header: dict[str, Any]
    arrays: dict[str, NDArray[Any]]

    def array(self, name: str, *shape: int) -> NDArray[Any]:
        """The array of that name. Raises ValueError unless there is one, of numbers and of that shape."""
        array = self.arrays.get(name)
        if array is None or array.shape != shape or array.dtype.kind != "f":
            found = "none" if array is None else f"{array.dtype} {array.shape}"
            raise ValueError(f"the checkpoint is damaged: {name} should be an array of shape {shape}, found {found}")
        return array


def write_checkpoint(
    path: str | Path, kind: str, header: Mapping[str, Any], arrays: Mapping[str, NDArray[Any]]
) -> None:
    """Writes a checkpoint; a reader sees the old file or the new one, never half of it.

    Args:
        path: where to, exactly: no suffix is added. Missing folders are made.
        kind: what it is a checkpoint of, for example ``neural_asm``.
        header: JSON-serialisable.
        arrays: of numbers.
    """
    path = Path(path)
    text = json.dumps({"format": FORMAT, "version": VERSION, "kind": kind, **header}, allow_nan=False)
    path.parent.mkdir(parents=True, exist_ok=True)
    handle, temporary = tempfile.mkstemp(dir=path.parent, prefix=f".{path.name}.")
    try:
        with os.fdopen(handle, "wb") as file:
            _write(file, text, arrays)
        os.chmod(temporary, 0o644)  # mkstemp makes it readable by its owner alone
        os.replace(temporary, path)
    except BaseException:
        Path(temporary).unlink(missing_ok=True)
        raise


def read_checkpoint(path: str | Path, kind: str) -> Checkpoint:
    """Reads a checkpoint of that kind.

    Raises:
        FileNotFoundError: there is none.
        ValueError: the file is damaged, foreign, of another kind, or of a newer format.
    """
    try:
        with zipfile.ZipFile(path) as file:
            header = json.loads(file.read(HEADER))
            arrays = {n.removesuffix(".npy"): _read(file, n) for n in file.namelist() if n != HEADER}
    except FileNotFoundError:
        raise
    except (zipfile.BadZipFile, zlib.error, ValueError, KeyError, EOFError, OSError, RuntimeError) as error:
        raise ValueError(f"{path} is damaged or not a checkpoint of asm-gym: {error}") from error
    if not isinstance(header, dict) or header.get("format") != FORMAT:
        raise ValueError(f"{path} is not a checkpoint of asm-gym")
    if header.get("version") != VERSION:
        raise ValueError(
            f"{path} has checkpoint format {header.get('version')!r}, this asm-gym reads {VERSION}; "
            "a newer asm-gym may have written it"
        )
    if header.get("kind") != kind:
        raise ValueError(f"{path} is a checkpoint of {header.get('kind')!r}, not of {kind!r}")
    return Checkpoint(header, arrays)


def kind_of(path: str | Path) -> str:
    """What a file is a checkpoint of. Raises FileNotFoundError, or ValueError where it is none."""
    try:
        with zipfile.ZipFile(path) as file:
            return str(json.loads(file.read(HEADER))["kind"])
    except FileNotFoundError:
        raise
    except (zipfile.BadZipFile, zlib.error, ValueError, KeyError, TypeError, EOFError, OSError) as error:
        raise ValueError(f"{path} is damaged or not a checkpoint of asm-gym: {error}") from error


def read_arrays(path: str | Path) -> dict[str, NDArray[Any]]:
    """Every array of an ``.npz``, by name. Raises FileNotFoundError, or ValueError where it is damaged."""
    try:
        with zipfile.ZipFile(path) as file:
            return {n.removesuffix(".npy"): _read(file, n) for n in file.namelist()}
    except FileNotFoundError:
        raise
    except (zipfile.BadZipFile, zlib.error, ValueError, KeyError, EOFError, OSError, RuntimeError) as error:
        raise ValueError(f"{path} is damaged: {error}") from error


def _write(file: IO[bytes], header: str, arrays: Mapping[str, NDArray[Any]]) -> None:
    with zipfile.ZipFile(file, "w") as archive:
        archive.writestr(HEADER, header)
        for name, array in arrays.items():
            with archive.open(f"{name}.npy", "w", force_zip64=True) as member:
                np.lib.format.write_array(member, np.asarray(array), allow_pickle=False)  # type: ignore[no-untyped-call]


def _read(file: zipfile.ZipFile, name: str) -> NDArray[Any]:
    with file.open(name) as member:
        array: NDArray[Any] = np.lib.format.read_array(member, allow_pickle=False)  # type: ignore[no-untyped-call]
        member.read()  # the checksum is compared at the end of the member
    return array
