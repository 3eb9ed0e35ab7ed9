"""Files that are there complete or not at all, and that are looked at before they are read."""

from __future__ import annotations

import errno
import os
import stat
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from secrets import token_hex
from typing import IO

from asm_gym.validation import short_repr

UNFINISHED = ".unfinished"


@contextmanager
def written_whole(path: str | Path) -> Iterator[IO[bytes]]:
    """A file to write that takes its place when the block ends well; a reader sees the old one or the new one.

    A symbolic link that stands there is replaced, and what it points to stays as it is. A process that is killed leaves
    a hidden file that ends in ``.unfinished``. Missing folders are made.

    Raises:
        ValueError: something stands there that is no file, such as a device; the path names no file.
    """
    path = _checked(path)
    if path.exists() and not path.is_file():
        raise ValueError(f"{path} is no regular file, and is not replaced by one")
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(f".{path.name}.{token_hex(4)}{UNFINISHED}")
    try:
        # "x" follows no link; who may read it, the umask says.
        with naming(path), temporary.open("xb") as file:
            yield file
        os.replace(temporary, path)
    except BaseException:
        temporary.unlink(missing_ok=True)
        raise


def write_text(path: Path, text: str) -> None:
    """Write a text as ``written_whole`` does."""
    with written_whole(path) as file:
        file.write(text.encode(errors="surrogateescape"))  # names of files under the locale C


def no_links(path: str, flags: int) -> int:
    """Open a file that is not reached by a symbolic link; an ``opener`` for ``open``, which raises OSError for one."""
    return os.open(path, flags | getattr(os, "O_NOFOLLOW", 0), 0o666)


@contextmanager
def naming(path: Path) -> Iterator[None]:
    """Name the file where a disk is full: Python does not, of a file that is open."""
    try:
        yield
    except OSError as error:
        if error.errno == errno.ENOSPC and error.filename is None:
            error.filename = str(path)
        raise


def writable(path: str | Path) -> None:
    """Raise an error where a file could not be written there, before the work is done that it is to hold."""
    folder = _checked(path).parent
    folder.mkdir(parents=True, exist_ok=True)
    with tempfile.NamedTemporaryFile(dir=folder, prefix=f".{Path(path).name}.", suffix=UNFINISHED):
        pass


def regular_file(path: str | Path) -> int:
    """Its size [bytes].

    Raises:
        FileNotFoundError: there is none.
        ValueError: it is a folder, or a device or pipe, whose reading might never end; the path names no file.
    """
    try:
        status = os.stat(_checked(path))
    except FileNotFoundError:
        raise FileNotFoundError(errno.ENOENT, "no such file", str(path)) from None
    if not stat.S_ISREG(status.st_mode):
        raise ValueError(f"{path} is no regular file")
    return status.st_size


def _checked(path: str | Path) -> Path:
    """Return the path of a file. Raises ValueError where it names none."""
    if not Path(path).name or "\x00" in str(path):
        raise ValueError(f"a path must name a file, got {short_repr(str(path))}")
    return Path(path)
