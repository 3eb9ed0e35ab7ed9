"""Checkpoints: one file of arrays and JSON, never pickle.

The file is a zip of ``.npy`` arrays, as an ``.npz`` is, with a JSON header that declares each. Checksums of the zip
reveal damage. Members are not compressed, so that all of them together are no larger than the file.
"""

from __future__ import annotations

import io
import json
import math
import zipfile
import zlib
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from asm_gym.files import regular_file, written_whole
from asm_gym.validation import typed

FORMAT = "asm-gym"
VERSION = 1
HEADER = "header.json"

MOST_EXPANDED = 30
"""Largest size of the content of a compressed ``.npz``, in sizes of the file; real streams shrink by 1.1."""

DAMAGE = (
    *(
        zipfile.BadZipFile,
        zlib.error,
        ValueError,
        KeyError,
        EOFError,
        OSError,
        RuntimeError,
        NotImplementedError,
    ),
    *(MemoryError, OverflowError, SyntaxError),
)
"""Errors that reading a damaged zip may raise."""

_npy: Any = np.lib.format


class Checkpoint(NamedTuple):
    """Content of a file: JSON values, and arrays by name."""

    header: dict[str, Any]
    arrays: dict[str, NDArray[Any]]

    def array(self, name: str, *shape: int) -> NDArray[Any]:
        """Return an array. Raises ValueError unless it is there, of finite numbers and of that shape."""
        array = self.arrays.get(name)
        if array is None or array.shape != shape or array.dtype.kind != "f":
            found = "none" if array is None else f"{array.dtype} {array.shape}"
            raise ValueError(
                f"the checkpoint is damaged: {name} should be an array of shape {shape}, found {found}"
            )
        if not np.isfinite(array).all():
            raise ValueError(f"the checkpoint is damaged: {name} should be finite")
        return array


@typed
def write_checkpoint(
    path: str | Path, kind: str, header: Mapping[str, Any], arrays: Mapping[str, NDArray[Any]]
) -> None:
    """Write a checkpoint of a ``kind``, such as ``neural_asm``; ``header`` is JSON-serialisable.

    A reader sees the old file or the new one, never half of it.
    """
    held = {name: np.asarray(array) for name, array in arrays.items()}
    declared = {name: [array.dtype.str, *array.shape] for name, array in held.items()}
    about = {"format": FORMAT, "version": VERSION, "kind": kind, **header, "arrays": declared}
    text = json.dumps(about, allow_nan=False)
    with written_whole(path) as file, zipfile.ZipFile(file, "w") as archive:
        # dated 1980: the same content has the same bytes at any time
        archive.writestr(zipfile.ZipInfo(HEADER), text)
        for name, array in held.items():
            with archive.open(f"{name}.npy", "w", force_zip64=True) as member:
                _npy.write_array(member, array, allow_pickle=False)


@typed
def read_checkpoint(path: str | Path, kind: str) -> Checkpoint:
    """Read a checkpoint of that kind.

    Raises:
        FileNotFoundError: there is none.
        ValueError: the file is damaged, foreign, of another kind, or of a newer format.
    """
    header = read_header(path)
    if header.get("version") != VERSION:
        raise ValueError(
            f"{path} has checkpoint format {header.get('version')!r}, this asm-gym reads {VERSION}; "
            "a newer asm-gym may have written it"
        )
    if header.get("kind") != kind:
        raise ValueError(f"{path} is a checkpoint of {header.get('kind')!r}, not of {kind!r}")
    with _opened(path) as file:
        arrays = {
            n.removesuffix(".npy"): _read(file, n) for n in sorted(file.namelist()) if n != HEADER
        }
        declared = header.pop("arrays", None)  # the shipped agents declare none
        found = {name: [array.dtype.str, *array.shape] for name, array in arrays.items()}
        if declared is not None and found != declared:
            wrong = sorted(
                n for n in found.keys() | declared.keys() if found.get(n) != declared.get(n)
            )
            raise ValueError(f"its header declares otherwise: {', '.join(wrong)}")
    return Checkpoint(header, arrays)


def read_header(path: str | Path) -> dict[str, Any]:
    """Return the JSON values of a checkpoint. Raises FileNotFoundError, or ValueError where the file is damaged."""
    with _opened(path) as file:
        header = json.loads(file.read(HEADER), parse_constant=_finite, parse_float=_finite)
        if not isinstance(header, dict) or header.get("format") != FORMAT:
            raise ValueError("it has no header of asm-gym")
    return header


@typed
def read_arrays(path: str | Path) -> dict[str, NDArray[Any]]:
    """Return the arrays of an ``.npz``, by name. Raises FileNotFoundError, or ValueError where it is damaged."""
    with _opened(path, "is damaged", MOST_EXPANDED) as file:
        return {n.removesuffix(".npy"): _read(file, n, kinds="biufU") for n in file.namelist()}


@contextmanager
def _opened(
    path: str | Path, what: str = "is damaged or not a checkpoint of asm-gym", expanded: int = 1
) -> Iterator[zipfile.ZipFile]:
    """Open a zip whose members are checked before anything is read; its errors become one line that names it.

    Its content is at most ``expanded`` sizes of the file; at 1 nothing may be compressed.
    """
    try:
        size = regular_file(path)
        with zipfile.ZipFile(path) as file:
            members = file.infolist()
            if len({m.filename for m in members}) < len(members):
                raise ValueError("two of its members have the same name")
            if expanded == 1 and any(m.compress_type != zipfile.ZIP_STORED for m in members):
                raise ValueError("its members are compressed, and those of asm-gym never are")
            if sum(m.file_size for m in members) > expanded * size:
                raise ValueError(
                    f"its members claim {sum(m.file_size for m in members)} bytes, in a file of {size}"
                )
            yield file
    except FileNotFoundError:
        raise
    except DAMAGE as error:
        raise ValueError(f"{path} {what}: {error}") from error


def _finite(text: str) -> float:
    """Read a number of JSON; 1e999 would pass for infinity."""
    number = float(text)
    if not math.isfinite(number):
        raise ValueError(f"its header holds {text}, which is no number")
    return number


def _read(file: zipfile.ZipFile, name: str, kinds: str = "biuf") -> NDArray[Any]:
    """Read an array of numbers, in its own memory order, on which the rounding of products depends."""
    array: NDArray[Any] = _npy.read_array(io.BytesIO(file.read(name)), allow_pickle=False)
    if array.dtype.kind not in kinds or not array.dtype.isnative:
        raise ValueError(f"{name} cannot be of {array.dtype!r}")
    return array
