"""Recordings of any kind as episodes, one after another: run folders, datasets, and logs from elsewhere.

A new kind of table is one row of ``TABLES``.
"""

from __future__ import annotations

import zipfile
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from glob import escape
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from asm_gym.checkpoint import read_arrays
from asm_gym.data.bags import read_bag
from asm_gym.data.channels import is_label
from asm_gym.data.clock_column import is_clock
from asm_gym.data.commands import is_command
from asm_gym.data.datasets import METADATA, read_dataset
from asm_gym.data.joining import joined
from asm_gym.data.lerobot import INFO, read_lerobot
from asm_gym.data.tabular import read_array, read_parquet
from asm_gym.data.text import read_json_lines, read_table
from asm_gym.episode import Episode, load_episode
from asm_gym.spec import MOTOR, StreamSpec
from asm_gym.validation import typed


class Log(NamedTuple):
    """An episode, and where it was found."""

    name: str
    episode: Episode


@dataclass(frozen=True)
class LogLayout:
    """How to read logs that do not name their channels as this package does; arguments of ``stream_of``.

    Args:
        spec: of the memory that is to read them.
        rate: rows a second [Hz].
        action: patterns of the columns that were commanded.
        channels: patterns of the columns that are read; all where empty.
        labels: patterns of the columns that say what is wrong, beside those that are called so.
        columns: names of the columns of files without a header.
        join: the files of a folder are parts of one recording.
        by_name: where no ``action`` is said, columns were commanded that are called so.
    """

    spec: StreamSpec | None = None
    rate: float | None = None
    action: Sequence[str] = ()
    channels: Sequence[str] = ()
    labels: Sequence[str] = ()
    columns: Sequence[str] = ()
    join: bool = False
    by_name: bool = False

    def episode(self, columns: Any) -> Episode:
        """A log is a success unless somebody says otherwise: it was handed over."""
        chosen = self.spec or (list(self.channels) if self.channels else None)
        action = () if self.spec else self.action
        read = partial(Episode.from_table, columns, chosen, self.rate, labels=self.labels, success=True)
        found = read(action=action)
        if self.spec or self.action or not self.by_name:
            return found
        channels = found.spec.channels
        named = [escape(c.name) for c in channels if c.group != MOTOR and is_command(c.name)]
        return read(action=named) if 0 < len(named) < len(channels) else found

    def keeps(self, name: str) -> bool:
        """Whether the words of a column of that name say something."""
        return is_clock(name) or is_label(name, self.labels)


Columns = dict[str, NDArray[Any]]


def _text(path: Path, layout: LogLayout) -> Columns:
    return read_table(path, layout.columns, layout.keeps)


def _json(path: Path, layout: LogLayout) -> Columns:
    return read_json_lines(path, layout.columns, layout.keeps)


TABLES: dict[str, Callable[[Path, LogLayout], Columns]] = {
    ".npz": lambda path, layout: read_arrays(path),
    ".npy": lambda path, layout: read_array(path, layout.columns),
    ".csv": _text,
    ".parquet": lambda path, layout: read_parquet(path),
    **dict.fromkeys((".mcap", ".db3", ".bag"), lambda path, layout: read_bag(path)),
    **dict.fromkeys((".tsv", ".txt"), _text),
    **dict.fromkeys((".jsonl", ".ndjson"), _json),
}
"""The columns of a file, by its suffix."""

ASKED_FOR = (".txt",)
"""Files that are read where they are named, and not where they lie in a folder: most are no logs."""


def _arrays(path: Path, layout: LogLayout) -> Episode:
    """An episode that this package wrote, or arrays by name, (T,) or (T, k) each."""
    try:
        with zipfile.ZipFile(path) as file:
            ours = "header.json" in file.namelist()
    except zipfile.BadZipFile as error:
        raise ValueError(f"it is damaged: {error}") from error
    return load_episode(path) if ours else layout.episode(read_arrays(path))


def _table(path: Path, layout: LogLayout) -> Episode:
    return layout.episode(TABLES[path.suffix](path, layout))


READERS: dict[str, Callable[[Path, LogLayout], Episode]] = {**dict.fromkeys(TABLES, _table), ".npz": _arrays}
"""The episode of a file, by its suffix."""


@typed
def read_logs(path: str | Path, layout: LogLayout | None = None) -> Iterator[Log]:
    """The episodes at ``path``, in the order of their names, each read when it is asked for.

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
    if path.is_file() and path.suffix not in READERS:
        raise ValueError(f"{path}: files that can be read end in {', '.join(READERS)}")
    if (path / INFO).is_file():
        yield from _lerobot(path, layout)
        return
    if layout.join:
        yield Log(path.name, layout.episode(joined(_parts(path, layout))))
        return
    root = path / "episodes" if (path / "episodes").is_dir() else path
    files = [path] if path.is_file() else sorted(f for f in root.rglob("*") if _readable(f.relative_to(root)))
    for file in files:
        try:
            episode = READERS[file.suffix](file, layout)
        except ValueError as error:
            # The first log says what the others are to hold.
            hint = "; --join reads files as parts of one recording" if layout.spec and "not there" in str(error) else ""
            raise ValueError(f"{file}: {error}{hint}") from error
        layout = replace(layout, spec=layout.spec or episode.spec)  # the others are read as the first one was
        yield Log(str(file.relative_to(root)) if file != path else file.name, episode)
    if files:
        return
    if next(path.rglob(METADATA), None) is None:
        raise FileNotFoundError(f"{path} holds no episodes: no {', '.join(READERS)}, no LeRobot or Minari dataset")
    for n, episode in enumerate(read_dataset(path)):
        yield Log(f"episode {n}", episode)


def read_tables(path: str | Path, layout: LogLayout) -> Iterator[tuple[str, Columns]]:
    """The columns of the logs at ``path`` as they are in their files, by name; of data sets, those of their streams.

    Raises:
        FileNotFoundError: there is nothing of the kind.
        ValueError: a file cannot be read; the message names it.
    """
    path = Path(path)
    if layout.join:
        yield path.name, joined(_parts(path, layout))
        return
    tables = [path] if path.is_file() else [f for f in sorted(path.rglob("*")) if _readable(f.relative_to(path))]
    if not tables or (path / INFO).is_file() or any(f.suffix == ".npz" or f.suffix not in TABLES for f in tables):
        for name, episode in read_logs(path, layout):
            rows = {label: episode.stream[:, k] for k, label in enumerate(episode.spec.labels)}
            yield name, {"time": np.arange(len(episode)) * episode.spec.dt} | rows
        return
    for file in tables:
        try:
            yield file.name, TABLES[file.suffix](file, layout)
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
    found = {}
    files = sorted(f for f in folder.iterdir() if f.suffix in TABLES) if folder.is_dir() else []
    if len(files) < 2:
        raise ValueError(f"--join takes a folder of the files of one recording, got {len(files)} in {folder}")
    for file in files:
        try:
            found[file.stem] = TABLES[file.suffix](file, layout)
        except ValueError as error:
            raise ValueError(f"{file}: {error}") from error
    return found


def _readable(file: Path) -> bool:
    """Of a kind that is read, and not half-written."""
    return file.suffix in READERS.keys() - set(ASKED_FOR) and not any(part.startswith(".") for part in file.parts)
