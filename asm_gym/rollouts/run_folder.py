"""The folder of a run: whose it is, who works in it, and what is there already.

A second call with the same settings goes on in a folder, one with others is refused, and so is one at the same time.
"""

from __future__ import annotations

import json
import os
import platform
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from functools import lru_cache
from importlib import metadata
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

import numpy as np
from filelock import FileLock, Timeout

import asm_gym
from asm_gym.crashes import CRASH
from asm_gym.episode import Episode, EpisodeLabel, load_episode
from asm_gym.evaluation.comparison import LeftOut
from asm_gym.files import named, written_whole
from asm_gym.rollouts.parallel import ParallelConfig, Progress, parallel_map

Item = TypeVar("Item")

LOCK, HOLDER = ".lock", ".lock_holder"
NOMINAL_ROLES = ("fit", "calibration", "nominal")
"""Roles of the episodes that nothing is done to."""


def versions(*more: str) -> dict[str, str]:
    """Of what decides over an episode, and of ``more`` packages."""
    others = {}
    for package in ("robosuite", "mujoco", "gymnasium", "numpy", *more):
        with suppress(metadata.PackageNotFoundError):  # a light install may be without robosuite
            others[package] = metadata.version(package)
    return {"asm_gym": asm_gym.__version__, **others}


@contextmanager
def claimed(folder: Path, name: str, settings: dict[str, Any]) -> Iterator[None]:
    """Makes ``folder`` a run's own, or goes on with it, and keeps others out while the block runs.

    Args:
        name: of the file in it that says whose it is.
        settings: what all that is kept there depends on; versions are added.

    Raises:
        ValueError: it holds a run of other settings; the message names them.
        BlockingIOError: another command works in it; the message names it.
    """
    ours = json.loads(json.dumps(settings, default=str)) | versions()
    with locked(folder):
        path = folder / name
        if path.is_file():
            theirs = json.loads(path.read_text(encoding="utf-8"))
            other = [f"{n}: {theirs.get(n)!r} there, {ours[n]!r} here" for n in ours if theirs.get(n) != ours[n]]
            if other:
                raise ValueError(
                    f"{folder} holds recordings of other settings ({'; '.join(other)}): name another --out"
                )
        with written_whole(path) as file:
            file.write((json.dumps(ours, indent=2) + "\n").encode())
        yield


@contextmanager
def locked(folder: Path) -> Iterator[None]:
    """Keeps other commands out of ``folder``, which is made, while the block runs.

    The system lets go of the lock of a process that has died, however it died.

    Raises:
        BlockingIOError: another command works in it; the message says which process, where and since when.
    """
    folder.mkdir(parents=True, exist_ok=True)
    path, holder = folder / LOCK, folder / HOLDER  # two files: Windows lets nobody read one that is locked
    lock = FileLock(path, blocking=False, is_singleton=False)
    try:
        lock.acquire()
    except Timeout:
        by = holder.read_text(encoding="utf-8") if holder.is_file() else "another process"
        raise BlockingIOError(f"{folder} is in use by {by}: wait for it, or name another --out") from None
    try:
        since = time.strftime("%Y-%m-%d %H:%M:%S %Z")
        with named(folder):
            holder.write_text(f"process {os.getpid()} on {platform.node()}, since {since}", encoding="utf-8")
        yield
    finally:
        holder.unlink(missing_ok=True)
        with suppress(OSError):  # Windows removes no file that is open; whoever waits for this one looks at it anew
            path.unlink()
        lock.release()


def make_missing(
    make: Callable[[Item], Path],
    items: Sequence[Item],
    place: Callable[[Item], Path],
    parallel: ParallelConfig | int = 2,
    progress: Progress | None = None,
) -> list[Path]:
    """Makes the files that are not there yet; where all of them are, in the order of ``items``.

    Args:
        make: writes the file of an item, complete or not at all.
        place: where it lies.
        parallel, progress: as ``parallel_map`` takes them; what is there already counts as done.
    """
    places = [place(item) for item in items]
    missing = [item for item, path in zip(items, places, strict=True) if not path.is_file()]
    done, tell = len(items) - len(missing), progress or (lambda done, total: None)
    tell(done, len(items))
    parallel_map(make, missing, parallel, lambda k, _: tell(done + k, len(items)))
    return places


def tasks_in(run: Path) -> list[str]:
    """Names of the tasks that a run has recorded."""
    return sorted(p.name for p in (run / "episodes").glob("*") if p.is_dir())


def files_in(run: Path, tasks: Sequence[str], *roles: str) -> list[Path]:
    """The recordings of a run, by task, then by role, then by name."""
    return [p for t in tasks for role in roles for p in sorted((run / "episodes" / t / role).glob("*.npz"))]


class Recordings(NamedTuple):
    """What a run has recorded.

    Attributes:
        roles: recordings by role; nominal ones that are no example of what is normal not among them, nor what was done
            to scenes in which the robot crashes by itself.
        left_out: how many nominal ones that are.
        twins: every episode of the role nominal: a faulty one goes as its twin does until the onset.
    """

    roles: dict[str, list[Episode]]
    left_out: LeftOut
    twins: list[Episode]

    @classmethod
    def of(cls, recordings: Sequence[Episode]) -> Recordings:
        """By role. Raises ValueError where there is nothing normal to learn or to test on."""
        roles: dict[str, list[Episode]] = {}
        hit, failed = crashes(recordings), 0
        for recording in recordings:
            label = recording.labelled
            # A nominal episode that fails is no example of what should feel normal, nor an alarm in it a false one.
            if label.role in NOMINAL_ROLES and not recording.success:
                failed += 1
            elif (label.task, label.seed) not in hit:
                roles.setdefault(label.role, []).append(recording)
        for role in NOMINAL_ROLES:
            if not roles.get(role):
                raise ValueError(
                    f"none of the {role} episodes succeeded without a crash: "
                    "there is nothing normal to learn or to test on"
                )
        return cls(roles, LeftOut(failed, len(hit)), [r for r in recordings if r.labelled.role == "nominal"])


def crashes(recordings: Sequence[Episode]) -> set[tuple[str, int]]:
    """Tasks and seeds of nominal episodes that succeed, and press ``CRASH`` times as hard as others of their task.

    What is usual is told by those that are learned from and calibrated on, not by what is tested on, where there are.
    """
    hardest: dict[str, dict[int, float]] = {}
    told: dict[str, list[float]] = {}
    for recording in recordings:
        label, force = recording.labelled, recording.contact_force
        if label.role in NOMINAL_ROLES and recording.success and np.isfinite(force).any():
            hardest.setdefault(label.task, {})[label.seed] = most = float(np.nanmax(force))
            if label.role != "nominal":
                told.setdefault(label.task, []).append(most)
    usual = {task: float(np.median(told.get(task, list(forces.values())))) for task, forces in hardest.items()}
    return {(task, seed) for task, forces in hardest.items() for seed, f in forces.items() if f > CRASH * usual[task]}


_UNREAD: list[tuple[Path, str]] = []


@contextmanager
def unread(folder: Path, who: str) -> Iterator[None]:
    """Nothing in ``folder`` is opened while the block runs, by no Python code of this process.

    Raises:
        PermissionError: something was; whoever learns is handed what may be learned from.
    """
    if not _WATCHING:
        sys.addaudithook(_refuse)  # none can be taken away again
        _WATCHING.append(True)
    _UNREAD.append((folder.resolve() / "episodes", who))
    try:
        yield
    finally:
        _UNREAD.pop()


_WATCHING: list[bool] = []


def _refuse(event: str, arguments: tuple[Any, ...]) -> None:
    if event == "open" and _UNREAD and isinstance(arguments[0], str | bytes | os.PathLike):
        path = Path(os.path.realpath(os.fsdecode(arguments[0])))
        for folder, who in _UNREAD:
            if folder in path.parents:
                raise PermissionError(f"{who} opened {path}: it may learn from what fit and calibrate are given alone")


def labelled(run: Path, labels: Sequence[EpisodeLabel]) -> list[Episode]:
    """The recordings of these labels."""
    return [load_episode(run / label.path) for label in labels]


@lru_cache(maxsize=1)
def recorded(run: Path, tasks: tuple[str, ...]) -> Recordings:
    """Every recording of these tasks but the harmless variations; kept for the next call."""
    return Recordings.of([load_episode(p) for p in files_in(run, tasks, *NOMINAL_ROLES, "faulty")])
