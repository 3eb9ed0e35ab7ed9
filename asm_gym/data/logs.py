"""Read recordings of any kind as episodes, one after another: run folders, datasets, and logs from elsewhere.

    files ► sources (a table each) ► schema, inferred from the first ► episodes

A new format is one row of ``FILES``: a function from a file to its columns, by the suffix.
"""

from __future__ import annotations

import zipfile
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from itertools import chain, islice
from pathlib import Path
from typing import NamedTuple

from asm_gym.checkpoint import HEADER, read_arrays
from asm_gym.data.array_files import read_array, read_hdf5, read_mat, read_parquet
from asm_gym.data.bags import read_bag
from asm_gym.data.column_names import is_label, split_unit
from asm_gym.data.episode import Episode, load_episode
from asm_gym.data.lerobot_datasets import INFO_FILE, read_lerobot
from asm_gym.data.minari_datasets import METADATA_FILE, read_dataset
from asm_gym.data.reader_notes import UNREAD, note
from asm_gym.data.schema import LogSchema
from asm_gym.data.schema_inference import SchemaHints, infer_schema, note_columns, recordings_in
from asm_gym.data.table_layout import Columns, laid_out
from asm_gym.data.text_files import read_json_lines, read_text
from asm_gym.files import regular_file
from asm_gym.validation import typed

Names = Sequence[str]
FILES: dict[str, Callable[[Path, Names], Columns]] = {
    ".npz": lambda path, columns: read_arrays(path),
    ".npy": read_array,
    ".parquet": lambda path, columns: read_parquet(path),
    ".mat": lambda path, columns: read_mat(path),
    **dict.fromkeys((".csv", ".tsv", ".txt", ".dat", ".data", ".log"), read_text),
    **dict.fromkeys((".jsonl", ".ndjson"), read_json_lines),
    **dict.fromkeys((".mcap", ".db3", ".bag"), lambda path, columns: read_bag(path)),
}
"""Reader of a file's columns by its suffix; it takes the names of columns without a header."""

HDF5 = (".hdf5", ".h5")  # files of several demonstrations, as robomimic writes them
NOT_IN_FOLDERS = (".txt", ".dat", ".data", ".log")  # most are no logs: read if they are named
LFS_POINTER = b"version https://git-lfs.github.com"
# The schema of a folder is inferred from its first tables: no more of them than either limit.
FIRST_TABLES = 20
FIRST_NUMBERS = 20_000_000


class Log(NamedTuple):
    """An episode, and where it was found."""

    name: str
    episode: Episode


@dataclass(frozen=True, kw_only=True)
class Source:
    """A recording as it was found: a table, or an episode of our own.

    Args:
        name: in its folder.
        columns: a column a sense, a row a moment.
        episode: of our own.
        stated_rate: rows a second that its file states [Hz].
        success: the task was solved; True where the log does not say.
        file: path of the file; empty where errors need not name it.
    """

    name: str
    columns: Columns = field(default_factory=dict)
    episode: Episode | None = None
    stated_rate: float | None = None
    success: bool = True
    file: str = ""


@typed
def read_logs(
    path: str | Path,
    hints: SchemaHints | None = None,
    schema: LogSchema | None = None,
) -> Iterator[Log]:
    """Yield the episodes at ``path``, in the order of their names, each read when it is asked for.

    Args:
        path: a file, a folder of files at any depth, a run's folder, or one with a LeRobot or a
            Minari dataset.
        hints: what the user says of the logs.
        schema: how they are read; by default it is inferred from the first of them.

    Raises:
        FileNotFoundError: there is nothing of the kind.
        ValueError: a log cannot be read; the message names it.
    """
    hints = hints or SchemaHints()
    sources = read_sources(path, hints)
    if schema is None:
        sources, schema = inferred_schema(sources, hints)
    else:
        schema = hints.apply(schema)
    for source in sources:
        if source.episode is not None:
            yield Log(source.name, source.episode)
            continue
        assert schema is not None
        yield from _episodes_of(source, schema)


def _episodes_of(source: Source, schema: LogSchema) -> Iterator[Log]:
    """Yield the episodes of a table, which is cut where its clock begins anew."""
    try:
        parts = recordings_in(source.columns, schema.clock_in(source.columns))
        _note_unknown(source.columns, schema)
        for number, part in enumerate(parts, 1):
            name = source.name
            if len(parts) > 1:
                name += f" part {number}"
            yield Log(name, Episode.read(part, schema, success=source.success))
    except ValueError as error:
        raise ValueError(f"{source.file or source.name}: {error}") from error


def _note_unknown(table: Columns, schema: LogSchema) -> None:
    """Tell the user of columns that the schema of the first logs does not have."""
    if schema.memory_spec is not None:
        return
    unknown = []
    for name in table:
        is_known = split_unit(name)[0] in schema.names
        if not is_known and not is_label(name):
            unknown.append(name)
    if unknown:
        note(f"not read, as the schema of the first logs lacks it: {', '.join(unknown)[:120]}")


def inferred_schema(
    sources: Iterator[Source], hints: SchemaHints
) -> tuple[Iterator[Source], LogSchema | None]:
    """Return the sources, and the schema of the first of them; None if these are episodes of ours."""
    sources, first_tables = first_sources(sources)
    if not first_tables:
        return sources, None
    first = first_tables[0]
    hints = replace(hints, stated_rate=first.stated_rate)
    try:
        schema = infer_schema([source.columns for source in first_tables], hints)
        schema.check()
    except ValueError as error:
        raise ValueError(f"{first.file or first.name}: {error}") from error
    note_columns(schema)
    return sources, schema


def first_sources(sources: Iterator[Source]) -> tuple[Iterator[Source], list[Source]]:
    """Return all sources again, and the first tables of them, from which a schema is inferred."""
    taken: list[Source] = []
    numbers = 0
    for source in islice(sources, FIRST_TABLES):
        taken.append(source)
        numbers += sum(values.size for values in source.columns.values())
        if numbers > FIRST_NUMBERS or source.episode is not None:
            break
    tables = [source for source in taken if source.columns]
    return chain(taken, sources), tables


def read_sources(path: str | Path, hints: SchemaHints) -> Iterator[Source]:
    """Yield the recordings at ``path`` as they are in their files.

    A file that cannot be read is left out, and the user is told.

    Raises:
        FileNotFoundError: there is nothing of the kind.
        ValueError: no file can be read.
    """
    path = Path(path)
    files = _files_at(path)
    if (path / INFO_FILE).is_file():
        for number, (columns, rate, success) in enumerate(read_lerobot(path)):
            yield Source(
                name=f"episode {number}",
                columns=laid_out(columns),
                stated_rate=rate,
                success=success,
            )
    elif files:
        yield from _sources_of_files(files, hints)
    elif next(path.rglob(METADATA_FILE), None) is not None:
        for number, episode in enumerate(read_dataset(path)):
            yield Source(name=f"episode {number}", episode=episode)
    else:
        known = ", ".join((*FILES, *HDF5))
        raise FileNotFoundError(
            f"{path} holds no episodes: no {known}, no LeRobot or Minari dataset"
        )


def _sources_of_files(files: dict[str, Path], hints: SchemaHints) -> Iterator[Source]:
    """Yield the recordings in files, by name; note the unread files, or raise ValueError if all are."""
    damaged = 0
    for name, file in files.items():
        try:
            sources = list(_sources_in(name, file, hints))
        except (ImportError, MemoryError):
            raise
        except Exception as error:  # each format's reader raises whatever the damage leads to
            damaged += 1
            message = f"{file}: {_message_of(error)}"
            if damaged == len(files):
                raise ValueError(message) from error
            note(UNREAD + message)
        else:
            yield from sources


def _message_of(error: Exception) -> str:
    """Return the message of an error in a line."""
    message = " ".join(str(error).split()) or type(error).__name__
    if isinstance(error, ValueError):
        return message
    return f"it is damaged: {message}"


def _sources_in(name: str, file: Path, hints: SchemaHints) -> Iterator[Source]:
    """Yield the recordings in a file."""
    regular_file(file)
    with file.open("rb") as opened:
        if opened.read(len(LFS_POINTER)) == LFS_POINTER:
            raise ValueError("it is a pointer of Git LFS and not the file itself: run git lfs pull")
    if file.suffix == ".npz" and _is_own_episode(file):
        yield Source(name=name, episode=load_episode(file))
    elif file.suffix in HDF5:
        for part, (columns, rate) in read_hdf5(file).items():
            yield Source(
                name=f"{name} {part}".strip(),
                columns=laid_out(columns),
                stated_rate=rate,
                file=str(file),
            )
    else:
        columns = FILES[file.suffix](file, hints.columns)
        yield Source(name=name, columns=laid_out(columns), file=str(file))


def _is_own_episode(file: Path) -> bool:
    """Return whether an ``.npz`` is a checkpoint of ours, and not only arrays."""
    with zipfile.ZipFile(file) as archive:
        return HEADER in archive.namelist()


def _files_at(path: Path) -> dict[str, Path]:
    """Return the file, or the readable files of a folder, by their names.

    Hidden files are left out: a file that is being written is hidden until it is whole.
    """
    if not path.exists():
        raise FileNotFoundError(f"{path} does not exist: name a log, or a folder of logs")
    known = (*FILES, *HDF5)
    if path.is_file():
        if path.suffix not in known:
            raise ValueError(f"{path}: files that can be read end in {', '.join(known)}")
        return {path.name: path}

    root = path / "episodes"
    if not root.is_dir():
        root = path
    files = {}
    for file in sorted(root.rglob("*")):
        name = file.relative_to(root)
        is_hidden = any(part.startswith(".") for part in name.parts)
        if file.suffix in known and file.suffix not in NOT_IN_FOLDERS and not is_hidden:
            files[str(name)] = file
    return files
