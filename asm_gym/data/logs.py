"""Read recordings of any kind as episodes, one after another: run folders, datasets, and logs from elsewhere.

A new format is one row of ``FILES``: a function from a file to its columns, by the suffix.
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

from asm_gym.checkpoint import read_arrays
from asm_gym.data.arrays import read_array, read_parquet
from asm_gym.data.bags import read_bag
from asm_gym.data.datasets import METADATA, read_dataset
from asm_gym.data.episode import Episode, load_episode
from asm_gym.data.lerobot import INFO, read_lerobot
from asm_gym.data.names import is_clock, is_command, is_label
from asm_gym.data.text import Columns, read_json_lines, read_text
from asm_gym.spec import MOTOR, StreamSpec
from asm_gym.validation import typed


@dataclass(frozen=True)
class LogLayout:
    """How to read logs; most are arguments of ``Episode.from_table``."""

    spec: StreamSpec | None = None  # of the memory that is to read them
    rate: float | None = None  # rows a second [Hz]
    action: Sequence[str] = ()  # patterns of the columns that were commanded
    channels: Sequence[str] = ()  # patterns of the columns that are read; all where empty
    labels: Sequence[str] = ()  # patterns of the columns that say what is wrong, beside those that are called so
    columns: Sequence[str] = ()  # names of the columns of files without a header
    by_name: bool = False  # without an ``action``, columns that are called so were commanded

    def episode(self, columns: Any) -> Episode:
        """Return the episode of a table; it is a success, for somebody handed it over as one."""
        chosen = self.spec or (list(self.channels) if self.channels else None)
        read = partial(Episode.from_table, columns, chosen, self.rate, labels=self.labels, success=True)
        found = read(action=() if self.spec else self.action)
        if self.spec or self.action or not self.by_name:
            return found
        channels = found.spec.channels
        named = [escape(c.name) for c in channels if c.group != MOTOR and is_command(c.name)]
        return read(action=named) if 0 < len(named) < len(channels) else found

    def keeps(self, name: str) -> bool:
        """Tell whether the words of a column say a time or a label."""
        return is_clock(name) or is_label(name, self.labels)


FILES: dict[str, Callable[[Path, LogLayout], Columns]] = {
    ".npz": lambda path, layout: read_arrays(path),
    ".npy": lambda path, layout: read_array(path, layout.columns),
    ".parquet": lambda path, layout: read_parquet(path),
    **dict.fromkeys((".csv", ".tsv", ".txt"), lambda path, layout: read_text(path, layout.columns, layout.keeps)),
    **dict.fromkeys((".jsonl", ".ndjson"), lambda path, layout: read_json_lines(path, layout.columns, layout.keeps)),
    **dict.fromkeys((".mcap", ".db3", ".bag"), lambda path, layout: read_bag(path)),
}
"""Reader of a file's columns, by its suffix."""

ASKED_FOR = (".txt",)  # files that are read where they are named, and not where they lie in a folder: most are no logs


class Log(NamedTuple):
    """An episode, and where it was found."""

    name: str
    episode: Episode


@typed
def read_logs(path: str | Path, layout: LogLayout | None = None) -> Iterator[Log]:
    """Yield the episodes at ``path``, in the order of their names, each read when it is asked for.

    Args:
        path: a file, a folder of files at any depth, that of a run, or one with a LeRobot or a Minari dataset.
        layout: how to read tables.

    Raises:
        FileNotFoundError: there is nothing of the kind.
        ValueError: a file cannot be read; the message names it.
    """
    path, layout = Path(path), layout or LogLayout()
    files = _files_at(path)
    if (path / INFO).is_file():
        yield from _lerobot(path, layout)
    elif files:
        root = path / "episodes" if (path / "episodes").is_dir() else path
        for file in files:
            try:
                ours = file.suffix == ".npz" and _is_episode(file)
                episode = load_episode(file) if ours else layout.episode(FILES[file.suffix](file, layout))
            except (ValueError, zipfile.BadZipFile) as error:
                raise ValueError(f"{file}: {error}") from error
            layout = replace(layout, spec=layout.spec or episode.spec)  # the others are read as the first one was
            yield Log(str(file.relative_to(root)) if file != path else file.name, episode)
    else:
        if next(path.rglob(METADATA), None) is None:
            raise FileNotFoundError(f"{path} holds no episodes: no {', '.join(FILES)}, no LeRobot or Minari dataset")
        yield from (Log(f"episode {n}", episode) for n, episode in enumerate(read_dataset(path)))


def _files_at(path: Path) -> list[Path]:
    """The file, or those in a folder that can be read and are not half-written."""
    if not path.exists():
        raise FileNotFoundError(f"there is no {path}")
    if path.is_file():
        if path.suffix not in FILES:
            raise ValueError(f"{path}: files that can be read end in {', '.join(FILES)}")
        return [path]
    root = path / "episodes" if (path / "episodes").is_dir() else path
    found = (f for f in root.rglob("*") if f.suffix in FILES and f.suffix not in ASKED_FOR)
    return sorted(f for f in found if not any(part.startswith(".") for part in f.relative_to(root).parts))


def _is_episode(path: Path) -> bool:
    with zipfile.ZipFile(path) as file:
        return "header.json" in file.namelist()


def read_tables(path: str | Path, layout: LogLayout) -> Iterator[tuple[str, Columns]]:
    """Yield the columns of the logs at ``path`` as they are in their files, by name; of datasets, their streams."""
    path = Path(path)
    files = _files_at(path)
    if not files or (path / INFO).is_file() or any(f.suffix == ".npz" for f in files):
        for name, episode in read_logs(path, layout):
            rows = {label: episode.stream[:, k] for k, label in enumerate(episode.spec.labels)}
            yield name, {"time": np.arange(len(episode)) * episode.spec.dt} | rows
        return
    for file in files:
        try:
            yield file.name, FILES[file.suffix](file, layout)
        except ValueError as error:
            raise ValueError(f"{file}: {error}") from error


def _lerobot(folder: Path, layout: LogLayout) -> Iterator[Log]:
    for n, (columns, rate, success) in enumerate(read_lerobot(folder)):
        known = replace(layout, rate=layout.rate or rate, action=layout.action or ("action*",))
        episode = replace(known.episode(columns), success=success)
        layout = replace(layout, spec=layout.spec or episode.spec)
        yield Log(f"episode {n}", episode)
