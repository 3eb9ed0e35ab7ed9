"""Read recordings of any kind as episodes, one after another: run folders, datasets, and logs from elsewhere."""

from __future__ import annotations

import zipfile
from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np

from asm_gym.data.arrays import Columns
from asm_gym.data.clock import FAR, clock_among, interpolated
from asm_gym.data.datasets import METADATA, read_dataset
from asm_gym.data.layout import LogLayout
from asm_gym.data.lerobot import INFO, read_lerobot
from asm_gym.data.names import is_clock
from asm_gym.data.sources import ASKED_FOR, FILES
from asm_gym.episode import Episode, load_episode
from asm_gym.validation import typed

__all__ = ["Log", "LogLayout", "read_logs", "read_tables"]


class Log(NamedTuple):
    """An episode, and where it was found."""

    name: str
    episode: Episode


@typed
def read_logs(path: str | Path, layout: LogLayout | None = None) -> Iterator[Log]:
    """Yield the episodes at ``path``, in the order of their names, each read when it is asked for.

    Args:
        path: a file; the folder of a run, whose ``episodes`` are read; one of such files, at any depth; or one with a
            LeRobot or a Minari dataset.
        layout: how to read tables.

    Raises:
        FileNotFoundError: there is nothing of the kind.
        ValueError: a file cannot be read; the message names it.
    """
    path, layout = Path(path), layout or LogLayout()
    if not path.exists():
        raise FileNotFoundError(f"there is no {path}")
    if path.is_file() and path.suffix not in FILES:
        raise ValueError(f"{path}: files that can be read end in {', '.join(FILES)}")
    if (path / INFO).is_file():
        yield from _lerobot(path, layout)
        return
    if layout.join:
        yield Log(path.name, layout.episode(joined(_parts(path, layout))))
        return
    root = path / "episodes" if (path / "episodes").is_dir() else path
    files = _files(root)
    for file in files:
        try:
            episode = _episode(file, layout)
        except ValueError as error:
            # The first log says what the others are to hold.
            hint = "; --join reads files as parts of one recording" if layout.spec and "not there" in str(error) else ""
            raise ValueError(f"{file}: {error}{hint}") from error
        layout = replace(layout, spec=layout.spec or episode.spec)  # the others are read as the first one was
        yield Log(str(file.relative_to(root)) if file != path else file.name, episode)
    if files:
        return
    if next(path.rglob(METADATA), None) is None:
        raise FileNotFoundError(f"{path} holds no episodes: no {', '.join(FILES)}, no LeRobot or Minari dataset")
    for n, episode in enumerate(read_dataset(path)):
        yield Log(f"episode {n}", episode)


def _files(root: Path) -> list[Path]:
    """The file, or those below a folder that can be read and are not half-written."""
    if root.is_file():
        return [root]
    suffixes = FILES.keys() - set(ASKED_FOR)
    found = (f for f in root.rglob("*") if f.suffix in suffixes)
    return sorted(f for f in found if not any(part.startswith(".") for part in f.relative_to(root).parts))


def _episode(path: Path, layout: LogLayout) -> Episode:
    """An episode that this package wrote, or that of a table."""
    if path.suffix == ".npz":
        try:
            with zipfile.ZipFile(path) as file:
                ours = "header.json" in file.namelist()
        except zipfile.BadZipFile as error:
            raise ValueError(f"it is damaged: {error}") from error
        if ours:
            return load_episode(path)
    return layout.episode(FILES[path.suffix](path, layout))


def read_tables(path: str | Path, layout: LogLayout) -> Iterator[tuple[str, Columns]]:
    """Yield the columns of the logs at ``path`` as they are in their files, by name; of datasets, their streams.

    Raises:
        FileNotFoundError: there is nothing of the kind.
        ValueError: a file cannot be read; the message names it.
    """
    path = Path(path)
    if layout.join:
        yield path.name, joined(_parts(path, layout))
        return
    tables = _files(path)
    if not tables or (path / INFO).is_file() or any(f.suffix == ".npz" or f.suffix not in FILES for f in tables):
        for name, episode in read_logs(path, layout):
            rows = {label: episode.stream[:, k] for k, label in enumerate(episode.spec.labels)}
            yield name, {"time": np.arange(len(episode)) * episode.spec.dt} | rows
        return
    for file in tables:
        yield file.name, _table(file, layout)


def _table(file: Path, layout: LogLayout) -> Columns:
    try:
        return FILES[file.suffix](file, layout)
    except ValueError as error:
        raise ValueError(f"{file}: {error}") from error


def _lerobot(folder: Path, layout: LogLayout) -> Iterator[Log]:
    for n, (columns, rate, success) in enumerate(read_lerobot(folder)):
        known = replace(layout, rate=layout.rate or rate, action=layout.action or ("action*",))
        episode = replace(known.episode(columns), success=success)
        layout = replace(layout, spec=layout.spec or episode.spec)
        yield Log(f"episode {n}", episode)


def _parts(folder: Path, layout: LogLayout) -> dict[str, Columns]:
    """The columns of each table in a folder, by its name."""
    files = sorted(f for f in folder.iterdir() if f.suffix in FILES) if folder.is_dir() else []
    if len(files) < 2:
        raise ValueError(f"--join takes a folder of the files of one recording, got {len(files)} in {folder}")
    return {file.stem: _table(file, layout) for file in files}


def joined(files: Mapping[str, Columns]) -> Columns:
    """Return the columns of several files of one recording; those that several have are called ``file.column``.

    Rows are those of the first file, and others are interpolated by their clocks. Files without a clock are joined
    row by row.

    Raises:
        ValueError: some have a clock and others none; lengths differ, and there is none; times do not overlap.
    """
    clocks = {name: clock for name, columns in files.items() if (clock := clock_among(columns))}
    without = [name for name in files if name not in clocks]
    counted = Counter(name for columns in files.values() for name in columns if not is_clock(name))
    named = {
        (file, column): column if counted[column] == 1 else f"{file}.{column}"
        for file, columns in files.items()
        for column in columns
        if not is_clock(column)
    }
    if not clocks:
        lengths = {name: len(next(iter(columns.values()))) for name, columns in files.items()}
        if len(set(lengths.values())) > 1:
            said = ", ".join(f"{n}: {k}" for n, k in lengths.items())
            raise ValueError(f"files without a clock must be of one length, got {said}")
        return {name: files[file][column] for (file, column), name in named.items()}
    if without:
        raise ValueError(f"files are joined by their clocks, and {', '.join(without)} has none")
    first, *others = files
    times = {name: clock.seconds(files[name][clock.column]) for name, clock in clocks.items()}
    start, end = max(t[0] for t in times.values()), min(t[-1] for t in times.values())
    due = times[first][(times[first] >= start) & (times[first] <= end)]
    if len(due) < 2:
        raise ValueError(f"{first} and {', '.join(others)} were not recorded at the same time")
    far = {file: FAR * float(np.quantile(np.diff(t), 0.9)) for file, t in times.items()}
    made: Columns = {"time": due}
    for (file, column), name in named.items():
        made[name] = interpolated(files[file][column], times[file], due, far[file])
    return made
