"""Checkpoints: one file of arrays and JSON, never pickle.

The file is a zip of ``.npy`` arrays, as an ``.npz`` is, with a JSON header that declares each. Checksums of the zip
reveal damage. Members are not compressed, so that all of them together are no larger than the file.
"""

from __future__ import annotations

import io
import json
import math
import os
import zipfile
import zlib
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from asm_gym.exceptions import DamagedFile
from asm_gym.files import regular_file, written_whole
from asm_gym.validation import typed

FORMAT = "asm-gym"
FORMAT_VERSION = 1
HEADER = "header.json"
# The end record of a zip: how it begins, and its length in a zip without a comment [bytes].
END_RECORD = b"PK\x05\x06"
END_RECORD_BYTES = 22

# Most bytes of content for each byte of a compressed ``.npz``; recorded streams have about 1.1.
MOST_EXPANDED = 30

# Errors that reading a damaged zip may raise.
DAMAGE = (
    zipfile.BadZipFile,
    zlib.error,
    ValueError,
    KeyError,
    EOFError,
    OSError,
    RuntimeError,
    NotImplementedError,
    MemoryError,
    OverflowError,
    SyntaxError,
)

_npy: Any = np.lib.format


class Checkpoint(NamedTuple):
    """Content of a file: JSON values, and arrays by name."""

    header: dict[str, Any]
    arrays: dict[str, NDArray[Any]]

    def array(self, name: str, *shape: int) -> NDArray[Any]:
        """Return an array of floats. Raises DamagedFile unless it is there, finite and of that shape."""
        array = self.arrays.get(name)
        if array is None:
            raise DamagedFile("the checkpoint", f"it has no array {name} of shape {shape}")
        if array.shape != shape or array.dtype.kind != "f":
            got = f"{array.dtype} {array.shape}"
            raise DamagedFile("the checkpoint", f"{name} should have shape {shape}, got {got}")
        if not np.isfinite(array).all():
            raise DamagedFile("the checkpoint", f"{name} should be finite")
        return array


@typed
def write_checkpoint(
    path: str | Path, kind: str, header: Mapping[str, Any], arrays: Mapping[str, NDArray[Any]]
) -> None:
    """Write a checkpoint; a reader sees the old file or the new one, never half of it.

    Args:
        path: of the file.
        kind: what it holds, such as ``neural_asm``.
        header: JSON-serialisable.
        arrays: by name.
    """
    contents = {name: np.asarray(array) for name, array in arrays.items()}
    about = {"format": FORMAT, "version": FORMAT_VERSION, "kind": kind, **header}
    text = json.dumps(about | {"arrays": _declared(contents)}, allow_nan=False)
    with written_whole(path) as file, zipfile.ZipFile(file, "w") as archive:
        # dated 1980: the same content has the same bytes at any time
        archive.writestr(zipfile.ZipInfo(HEADER), text)
        for name, array in contents.items():
            with archive.open(f"{name}.npy", "w", force_zip64=True) as member:
                _npy.write_array(member, array, allow_pickle=False)


@typed
def read_checkpoint(path: str | Path, kind: str) -> Checkpoint:
    """Read a checkpoint of that kind.

    Raises:
        FileNotFoundError: there is none.
        DamagedFile: the file is damaged or foreign.
        ValueError: it is of another kind, or of a newer format.
    """
    header = read_header(path)
    if header.get("version") != FORMAT_VERSION:
        raise ValueError(
            f"{path} has checkpoint format {header.get('version')!r}, this asm-gym reads "
            f"{FORMAT_VERSION}; a newer asm-gym may have written it"
        )
    if header.get("kind") != kind:
        raise ValueError(f"{path} is a checkpoint of {header.get('kind')!r}, not of {kind!r}")
    with _opened(path) as file:
        members = sorted(set(file.namelist()) - {HEADER})
        arrays = {name.removesuffix(".npy"): _read_array(file, name) for name in members}
        declared = header.pop("arrays", None)  # None in files of the shipped agents
        if declared is not None:
            _check_declared(arrays, declared)
    return Checkpoint(header, arrays)


def read_header(path: str | Path) -> dict[str, Any]:
    """Return the JSON values of a checkpoint. Raises FileNotFoundError or DamagedFile."""
    with _opened(path) as file:
        header = json.loads(
            file.read(HEADER), parse_constant=_finite_number, parse_float=_finite_number
        )
        if not isinstance(header, dict) or header.get("format") != FORMAT:
            raise ValueError("it has no header of asm-gym")
    return header


@typed
def read_arrays(path: str | Path) -> dict[str, NDArray[Any]]:
    """Return the arrays of an ``.npz``, by name. Raises FileNotFoundError or DamagedFile."""
    with _opened(path, "is damaged", MOST_EXPANDED) as file:
        return {
            name.removesuffix(".npy"): _read_array(file, name, kinds="biufU")
            for name in file.namelist()
        }


def _declared(arrays: Mapping[str, NDArray[Any]]) -> dict[str, list[Any]]:
    """Return the type and shape of each array, as a header declares them."""
    return {name: [array.dtype.str, *array.shape] for name, array in arrays.items()}


def _check_declared(arrays: Mapping[str, NDArray[Any]], declared: Mapping[str, Any]) -> None:
    """Raise ValueError unless the header declares these arrays."""
    actual = _declared(arrays)
    names = actual.keys() | declared.keys()
    wrong = [name for name in sorted(names) if actual.get(name) != declared.get(name)]
    if wrong:
        raise ValueError(f"its header declares otherwise: {', '.join(wrong)}")


@contextmanager
def _opened(
    path: str | Path,
    verdict: str = "is damaged or not a checkpoint of asm-gym",
    most_expanded: int = 1,
) -> Iterator[zipfile.ZipFile]:
    """Open a zip whose members are checked before anything is read; its errors become a DamagedFile.

    Args:
        path: of the file.
        verdict: what the message says of a file that cannot be read.
        most_expanded: most bytes of content for each byte of the file; at 1 no member may be compressed.
    """
    try:
        size = regular_file(path)
        with zipfile.ZipFile(path) as file:
            _check_members(file.infolist(), size, most_expanded)
            _check_end(Path(path))
            yield file
    except FileNotFoundError:
        raise
    except DAMAGE as error:
        raise DamagedFile(path, error, verdict) from error


def _check_end(path: Path) -> None:
    """Raise ValueError if bytes follow the end of a zip without a comment, as ours are."""
    with path.open("rb") as file:
        file.seek(-END_RECORD_BYTES, os.SEEK_END)
        if file.read(len(END_RECORD)) != END_RECORD:
            raise ValueError("other bytes follow its end")


def _check_members(members: list[zipfile.ZipInfo], size: int, most_expanded: int) -> None:
    """Raise ValueError for members of a zip that must not be read; see ``_opened``."""
    if len({member.filename for member in members}) < len(members):
        raise ValueError("two of its members have the same name")
    is_compressed = any(member.compress_type != zipfile.ZIP_STORED for member in members)
    if is_compressed and most_expanded == 1:
        raise ValueError("its members are compressed, and those of asm-gym never are")
    claimed = sum(member.file_size for member in members)
    if claimed > most_expanded * size:
        raise ValueError(f"its members claim {claimed} bytes, in a file of {size}")


def _finite_number(text: str) -> float:
    """Return a number of JSON; raise ValueError for NaN and infinity, also written as 1e999."""
    number = float(text)
    if not math.isfinite(number):
        raise ValueError(f"its header holds {text}, which is no number")
    return number


def _read_array(file: zipfile.ZipFile, name: str, kinds: str = "biuf") -> NDArray[Any]:
    """Read an array of numbers, in its own memory order, on which the rounding of products depends."""
    array: NDArray[Any] = _npy.read_array(io.BytesIO(file.read(name)), allow_pickle=False)
    if array.dtype.kind not in kinds or not array.dtype.isnative:
        raise ValueError(f"{name} cannot be of {array.dtype!r}")
    return array
