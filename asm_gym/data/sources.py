"""The registry of sources: which reader belongs to a suffix, to a folder, and to the prefix of a live source.

A new format of logs is one row of ``FILES`` or ``FOLDERS``; a new live source is one row of ``LIVE``.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import NamedTuple, TextIO

from asm_gym.checkpoint import read_arrays
from asm_gym.data.arrays import Columns, read_array, read_parquet
from asm_gym.data.bags import read_bag
from asm_gym.data.layout import LogLayout
from asm_gym.data.live import follow_datagrams, follow_file, follow_pipe
from asm_gym.data.ros2_dds import follow_topics
from asm_gym.data.text import read_json_lines, read_text


def _text(path: Path, layout: LogLayout) -> Columns:
    return read_text(path, layout.columns, layout.keeps)


def _json(path: Path, layout: LogLayout) -> Columns:
    return read_json_lines(path, layout.columns, layout.keeps)


FILES: dict[str, Callable[[Path, LogLayout], Columns]] = {
    ".npz": lambda path, layout: read_arrays(path),
    ".npy": lambda path, layout: read_array(path, layout.columns),
    ".csv": _text,
    ".parquet": lambda path, layout: read_parquet(path),
    **dict.fromkeys((".mcap", ".db3", ".bag"), lambda path, layout: read_bag(path)),
    **dict.fromkeys((".tsv", ".txt"), _text),
    **dict.fromkeys((".jsonl", ".ndjson"), _json),
}
"""Reader of a file's columns, by its suffix."""

ASKED_FOR = (".txt",)
"""Files that are read where they are named, and not where they lie in a folder: most are no logs."""


class LiveSource(NamedTuple):
    """A source that is followed.

    Attributes:
        example: how a user names it.
        open: yields lines, of what follows the prefix, standard input, and after how much silence it has died [s].
        returns: it may come back after it has died.
    """

    example: str
    open: Callable[[str, TextIO, float], Iterator[str]]
    returns: bool = False


LIVE = {
    "-": LiveSource("-", lambda place, stdin, silence: follow_pipe(stdin, silence)),
    "tail:": LiveSource("tail:FILE", lambda place, stdin, silence: follow_file(Path(place), silence)),
    "udp:": LiveSource("udp:PORT", lambda place, stdin, silence: follow_datagrams(place, silence), returns=True),
    "dds:": LiveSource("dds:/TOPIC", lambda place, stdin, silence: follow_topics(place, silence), returns=True),
}
"""Live sources by prefix."""


def live_source(source: str) -> LiveSource | None:
    """Return what follows a source; None where it names a recording."""
    return LIVE.get(source if source == "-" else f"{source.partition(':')[0]}:")


def is_live(source: str) -> bool:
    """Tell whether a source is followed, and no recording."""
    return live_source(source) is not None


def lines_from(source: str, stdin: TextIO, silence: float) -> Iterator[str]:
    """Return the lines of a live source, as they come.

    Args:
        source: ``-`` for standard input, ``tail:FILE`` for a file that grows, ``udp:PORT`` for datagrams sent to this
            machine from itself, of which an empty one is the end, ``dds:/joint_states`` for topics of ROS 2.
        stdin: standard input.
        silence: seconds without a line, after the first one, from which on the source has died.

    Raises:
        SourceDied: it has.
        ValueError: it is none of these, the port is no number, or the file became shorter.
        OSError: there is no such file, or the port is taken.
    """
    found = live_source(source)
    if found is None:
        raise ValueError(f"unknown source {source!r}; known: {', '.join(s.example for s in LIVE.values())}")
    return found.open(source.partition(":")[2], stdin, silence)
