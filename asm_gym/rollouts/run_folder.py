"""The folder of a run: its settings, its lock, and what is there already.

A second call with the same settings continues in a folder; one with others, or at the same time, is refused.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from importlib import metadata
from pathlib import Path
from typing import Any, TypeVar

from filelock import FileLock, Timeout

from asm_gym.files import written_whole
from asm_gym.rollouts.parallel import Progress, parallel_map
from asm_gym.version import __version__

Item = TypeVar("Item")

LOCK = ".lock"


def versions(*more: str) -> dict[str, str]:
    """Return the versions of the packages that decide over an episode, and of ``more``."""
    others = {}
    for package in ("robosuite", "mujoco", "gymnasium", "numpy", *more):
        with suppress(metadata.PackageNotFoundError):  # a light install may be without robosuite
            others[package] = metadata.version(package)
    return {"asm_gym": __version__, **others}


@contextmanager
def claimed(folder: Path, name: str, settings: dict[str, Any]) -> Iterator[None]:
    """Make ``folder`` a run's own, or continue it, and keep others out while the block runs.

    The file ``name`` in it holds the ``settings`` that decide over the recordings, and versions.

    Raises:
        ValueError: it holds a run of other settings; the message names them.
        BlockingIOError: another command works in it.
    """
    ours = json.loads(json.dumps(settings, default=str)) | versions()
    folder.mkdir(parents=True, exist_ok=True)
    lock = FileLock(folder / LOCK, blocking=False, is_singleton=False)
    try:
        lock.acquire()
    except Timeout:
        raise BlockingIOError(
            f"{folder} is in use by another process: wait for it, or name another --out"
        ) from None
    try:
        path = folder / name
        if path.is_file():
            theirs = json.loads(path.read_text(encoding="utf-8"))
            differences = [
                f"{name}: {theirs.get(name)!r} there, {own!r} here"
                for name, own in ours.items()
                if theirs.get(name) != own
            ]
            if differences:
                raise ValueError(
                    f"{folder} holds recordings of other settings ({'; '.join(differences)}): "
                    "name another --out"
                )
        with written_whole(path) as file:
            file.write((json.dumps(ours, indent=2) + "\n").encode())
        yield
    finally:
        with suppress(OSError):  # Windows removes no open file
            (folder / LOCK).unlink()
        lock.release()  # the system frees that of a dead process


def make_missing(
    make: Callable[[Item], Path],
    items: Sequence[Item],
    place: Callable[[Item], Path],
    workers: int = 2,
    progress: Progress | None = None,
) -> list[Path]:
    """Make the files that are missing; return the paths of all, in the order of ``items``.

    ``make`` writes the file of an item, complete or not at all, at its ``place``. Files that exist count as done.
    """
    missing = [item for item in items if not place(item).is_file()]
    total = len(items)
    existing = total - len(missing)
    report = progress or (lambda done, total: None)
    report(existing, total)
    parallel_map(make, missing, workers, lambda made, _: report(existing + made, total))
    return [place(item) for item in items]
