"""Checkpoints: one file of arrays and JSON, never pickle.

The file is an ``.npz`` (a zip of arrays) with one extra array that holds the bytes of a JSON header. A zip carries a
checksum of every member, so damage is noticed when it is read.
"""

from __future__ import annotations

import json
import os
import tempfile
import zipfile
import zlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

FORMAT = "asm-gym"
VERSION = 1
HEADER = "header.json"


class Checkpoint(NamedTuple):
    """What a file held: JSON values, and arrays by name."""

    header: dict[str, Any]
    arrays: dict[str, NDArray[Any]]


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
            np.savez(file, allow_pickle=False, **{HEADER: np.frombuffer(text.encode(), np.uint8)}, **arrays)
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
            arrays = {n.removesuffix(".npy"): _array(file, n) for n in file.namelist()}
        header = json.loads(arrays.pop(HEADER).tobytes())
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


def _array(file: zipfile.ZipFile, name: str) -> NDArray[Any]:
    with file.open(name) as member:
        array: NDArray[Any] = np.lib.format.read_array(member, allow_pickle=False)  # type: ignore[no-untyped-call]
        member.read()  # the checksum is compared at the end of the member
    return array
