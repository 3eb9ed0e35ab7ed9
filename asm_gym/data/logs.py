"""Read recordings of any kind as episodes, one after another: run folders, datasets, and logs from elsewhere.

A new format is one row of ``FILES``: a function from a file to its columns, by the suffix. What the columns of a folder
are is decided once, by its first tables, and all others are read so.
"""

from __future__ import annotations

import zipfile
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import replace
from itertools import chain, islice
from pathlib import Path
from typing import NamedTuple

from asm_gym.checkpoint import read_arrays
from asm_gym.data.arrays import read_array, read_hdf5, read_mat, read_parquet
from asm_gym.data.bags import read_bag
from asm_gym.data.channels import RESAMPLED, clock_of, read_recorded
from asm_gym.data.columns import LogLayout
from asm_gym.data.episode import Episode, load_episode
from asm_gym.data.lerobot_datasets import INFO, read_lerobot
from asm_gym.data.minari_datasets import METADATA, read_dataset
from asm_gym.data.names import is_label
from asm_gym.data.reader_notes import UNREAD, note
from asm_gym.data.tables import Columns, laid_out
from asm_gym.data.text import read_json_lines, read_text
from asm_gym.data.timing import recordings, timing_of
from asm_gym.files import regular_file
from asm_gym.validation import typed

FILES: dict[str, Callable[[Path, LogLayout], Columns]] = {
    ".npz": lambda path, layout: read_arrays(path),
    ".npy": lambda path, layout: read_array(path, layout.columns),
    ".parquet": lambda path, layout: read_parquet(path),
    ".mat": lambda path, layout: read_mat(path),
    **dict.fromkeys(
        (".csv", ".tsv", ".txt", ".dat", ".data", ".log"),
        lambda path, layout: read_text(path, layout.columns),
    ),
    **dict.fromkeys(
        (".jsonl", ".ndjson"), lambda path, layout: read_json_lines(path, layout.columns)
    ),
    **dict.fromkeys((".mcap", ".db3", ".bag"), lambda path, layout: read_bag(path)),
}
"""Reader of a file's columns, by its suffix."""

HDF5 = (".hdf5", ".h5")  # files of several demonstrations, as robomimic writes them
# read where they are named, and not in a folder: most are no logs
ASKED_FOR = (
    ".txt",
    ".dat",
    ".data",
    ".log",
)
POINTER = b"version https://git-lfs.github.com"
FIRST_TABLES = 20  # by how many of a folder's tables it is decided what columns are,
FIRST_NUMBERS = 20_000_000  # or by how many numbers of these
LIKE = "--like FILE reads only logs with the columns and the rate of FILE"


class Log(NamedTuple):
    """An episode, and where it was found."""

    name: str
    episode: Episode


class Source(NamedTuple):
    """A recording as it was found: a table, or an episode of our own."""

    name: str
    columns: Columns
    episode: Episode | None = None
    rate: float | None = None  # that somebody meant it to have [Hz]
    success: bool = True  # for somebody handed it over as one
    file: str = ""  # it was read from


@typed
def read_logs(path: str | Path, layout: LogLayout | None = None) -> Iterator[Log]:
    """Yield the episodes at ``path``, in the order of their names, each read when it is asked for.

    ``path`` is a file, a folder of files at any depth, that of a run, or one with a LeRobot or a Minari dataset. Raises
    FileNotFoundError where there is nothing of the kind, ValueError where a log makes no sense; the message names it.
    """
    layout = layout or LogLayout()
    if (Path(path) / INFO).is_file():
        layout = replace(layout, action=layout.action or ("action*",))
    sources, first = first_tables(read_tables(path, layout))
    robot, known, one = layout.spec, list(first[0]) if first else [], ""
    for source in sources:
        episode = source.episode
        if episode is None:
            try:
                others = (
                    [] if layout.spec else [other for other in first if other is not source.columns]
                )
                found = read_recorded(source.columns, replace(layout, nominal=source.rate), others)
            except ValueError as error:
                hint = (
                    f"; {LIKE}, such as {one} or {source.file}" if layout.spec is not robot else ""
                )
                raise ValueError(f"{source.file or source.name}: {error}{hint}") from error
            if robot is None and (
                more := [name for name in source.columns if not (name in known or is_label(name))]
            ):
                note(f"not read, as the first log lacks it: {', '.join(more)[:120]}; {LIKE}")
            episode = Episode(found.stream, found.spec, success=source.success, faults=found.faults)
        # others are read as it
        layout, one = (
            replace(layout, spec=layout.spec or episode.spec),
            one or source.file,
        )
        yield Log(source.name, episode)


def first_tables(sources: Iterator[Source]) -> tuple[Iterator[Source], list[Columns]]:
    """Return the sources, and the tables of the first of them, by which it is decided what columns are."""
    first, numbers = list[Source](), 0
    for source in islice(sources, FIRST_TABLES):
        first.append(source)
        numbers += sum(values.size for values in source.columns.values())
        if numbers > FIRST_NUMBERS or source.episode is not None:
            break
    return chain(first, sources), [source.columns for source in first if source.episode is None]


def read_tables(path: str | Path, layout: LogLayout) -> Iterator[Source]:
    """Yield the recordings at ``path`` as they are in their files: a column a sense, a row a moment.

    A file that cannot be read is left out, and said; a ValueError is raised where none of them can.
    """
    path = Path(path)
    files = _files_at(path)
    if layout.like is not None:
        like, layout = layout.like, replace(layout, like=None)
        robot = next(read_tables(like, layout))
        yield from (source for source in read_tables(path, layout) if _alike(source, robot, layout))
        return
    if (path / INFO).is_file():
        for n, (columns, rate, success) in enumerate(read_lerobot(path)):
            yield from _parts(Source(f"episode {n}", columns, None, rate, success), layout)
        return
    if not files:
        if next(path.rglob(METADATA), None) is None:
            known = ", ".join((*FILES, *HDF5))
            raise FileNotFoundError(
                f"{path} holds no episodes: no {known}, no LeRobot or Minari dataset"
            )
        yield from (
            Source(f"episode {n}", {}, episode) for n, episode in enumerate(read_dataset(path))
        )
    troubles = []
    for name, file in files.items():
        try:
            parts = [
                part for source in _read(name, file, layout) for part in _parts(source, layout)
            ]
        except (ImportError, MemoryError):
            raise
        except Exception as error:  # each format's reader raises whatever the damage leads to
            damaged = "" if isinstance(error, ValueError) else "it is damaged: "
            troubles.append(
                f"{file}: {damaged}{' '.join(str(error).split()) or type(error).__name__}"
            )
            if len(troubles) == len(files):
                raise ValueError(troubles[0]) from error
            note(UNREAD + troubles[-1])
        else:
            yield from parts


def _alike(source: Source, other: Source, layout: LogLayout) -> bool:
    """Whether two recordings may be of one robot: they have the same columns, and come at about the same rate."""
    own, its = _period(source, layout), _period(other, layout)
    at_one_rate = own is None or its is None or 1 / RESAMPLED <= own / its <= RESAMPLED
    return at_one_rate and set(source.columns) == set(other.columns)


def _period(source: Source, layout: LogLayout) -> float | None:
    """How far apart rows are [s]; None where no clock tells."""
    with suppress(ValueError):
        clock = clock_of(source.columns, layout)
        return None if clock is None else timing_of(source.columns, clock).dt
    return None


def _read(name: str, file: Path, layout: LogLayout) -> Iterator[Source]:
    """The recordings in a file."""
    regular_file(file)
    with file.open("rb") as opened:
        if opened.read(len(POINTER)) == POINTER:
            raise ValueError("it is a pointer of Git LFS and not the file itself: run git lfs pull")
    if file.suffix == ".npz" and "header.json" in zipfile.ZipFile(file).namelist():
        yield Source(name, {}, load_episode(file))
    elif file.suffix in HDF5:
        for part, (columns, often) in read_hdf5(file).items():
            yield Source(f"{name} {part}".strip(), columns, rate=often, file=str(file))
    else:
        yield Source(name, FILES[file.suffix](file, layout), file=str(file))


def _parts(source: Source, layout: LogLayout) -> Iterator[Source]:
    """The recordings in a table: it is cut where its clock begins anew, or leaps."""
    if source.episode is not None:
        yield source
        return
    table = laid_out(source.columns)
    try:
        clock = clock_of(table, layout)
        parts = recordings(clock.seconds(table)) if clock is not None else []
    except ValueError:
        parts = []
    if len(parts) < 2:
        yield source._replace(columns=table)
        return
    note(
        f"{source.name}: time begins anew or leaps {len(parts) - 1} times, and the log is cut there"
    )
    for n, (start, stop) in enumerate(parts, 1):
        part = {name: values[start:stop] for name, values in table.items()}
        yield source._replace(name=f"{source.name} part {n}", columns=part)


def _files_at(path: Path) -> dict[str, Path]:
    """The file, or those in a folder that can be read and are not half-written, by their names."""
    if not path.exists():
        raise FileNotFoundError(f"there is no {path}")
    known = (*FILES, *HDF5)
    if path.is_file():
        if path.suffix not in known:
            raise ValueError(f"{path}: files that can be read end in {', '.join(known)}")
        return {path.name: path}
    root = path / "episodes" if (path / "episodes").is_dir() else path
    found = {
        f.relative_to(root): f
        for f in sorted(root.rglob("*"))
        if f.suffix in known and f.suffix not in ASKED_FOR
    }
    return {
        str(name): f
        for name, f in found.items()
        if not any(part.startswith(".") for part in name.parts)
    }
