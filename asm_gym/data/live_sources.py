"""Follow lines as they come: from standard input, a file that grows, datagrams, or topics of ROS 2 over DDS.

A source that falls silent has died. A new source is one row of ``LIVE``.
"""

from __future__ import annotations

import math
import os
import re
import select
import socket
import time
from collections.abc import Callable, Iterable, Iterator
from io import UnsupportedOperation
from ipaddress import IPv4Address
from pathlib import Path
from typing import NamedTuple, TextIO

from asm_gym.data.dds_topics import follow_topics
from asm_gym.data.live_rows import SourceDied
from asm_gym.data.text_files import decoded
from asm_gym.files import naming, no_links, regular_file
from asm_gym.validation import check_number

SOURCE_POLL_S = 0.002  # how often a source is looked at for more [s]
LARGEST_DATAGRAM = 65_535  # bytes of a datagram
LONGEST_LINE_BYTES = 1_000_000  # bytes of a line: more than a row of any robot
TICK_S = 0.02  # how often an empty line says that no line came [s]
UDP = re.compile(r"(\d+)(?:@([^:]+)(?::(\d+))?)?")  # PORT, PORT@ADDRESS or PORT@ADDRESS:PORT


class LiveSource(NamedTuple):
    """A source that is followed."""

    example: str  # of its name
    open: Callable[[str, TextIO, float, float], Iterator[str]]
    """Takes what follows the prefix, standard input, silence [s], and how long the first line may take [s]."""
    returns: bool = False  # whether it may come back after it died


def live_source(source: str) -> LiveSource | None:
    """Return the live source of this name; None where it names a recording."""
    prefix, colon, _ = source.partition(":")
    return LIVE.get(prefix + colon)


def lines_from(
    source: str, stdin: TextIO, silence: float, first: float = math.inf
) -> Iterator[str]:
    """Return the lines of a live source, as they come.

    Args:
        source: ``-`` for standard input, ``tail:FILE`` for a file that grows, ``udp:PORT`` for datagrams of this
            machine, ``udp:PORT@ADDRESS`` or ``udp:PORT@ADDRESS:PORT`` for those of one sender, or
            ``dds:/joint_states`` for topics of ROS 2.
        stdin: standard input.
        silence: how long the source may send no line before SourceDied is raised [s].
        first: how long it may take to send the first line [s].

    Raises:
        ValueError: there is no such source.
    """
    live = live_source(source)
    if live is None:
        known = ", ".join(row.example for row in LIVE.values())
        raise ValueError(f"unknown source {source!r}; known: {known}")
    _, _, place = source.partition(":")
    return live.open(place, stdin, silence, first)


def _follow_pipe(place: str, stdin: TextIO, silence: float, first: float) -> Iterator[str]:
    try:
        number = stdin.fileno()
    except (UnsupportedOperation, AttributeError):  # no pipe, but text in memory
        yield from stdin
        return

    def more() -> bytes | None:
        ready, _, _ = select.select([number], [], [], SOURCE_POLL_S)
        if not ready:
            return None
        return os.read(number, LARGEST_DATAGRAM)

    yield from _lines(more, silence, first)


def _follow_file(place: str, stdin: TextIO, silence: float, first: float) -> Iterator[str]:
    path = Path(place)
    regular_file(path)

    def more() -> bytes | None:
        chunk = file.read(LARGEST_DATAGRAM)
        if chunk:
            return chunk
        if path.stat().st_size < file.tell():
            raise ValueError(f"{path} became shorter while it was followed")
        time.sleep(SOURCE_POLL_S)
        return None

    with path.open("rb") as file:
        yield from _lines(more, silence, first)


def _follow_datagrams(place: str, stdin: TextIO, silence: float, first: float) -> Iterator[str]:
    """Yield the lines of datagrams, whatever they hold, to a port of this machine from itself or from one sender."""
    match = UDP.fullmatch(place)
    if match is None:
        raise ValueError(
            "udp takes a port of this machine, as in udp:9870, or udp:9870@127.0.0.1:5005, "
            f"got {place!r}"
        )
    port, sender, sender_port = match.groups()
    check_number("port", int(port), low=1, high=65_535, whole=True)

    def more() -> bytes | None:
        try:
            datagram, (address, source_port) = receiver.recvfrom(LARGEST_DATAGRAM)
        except TimeoutError:
            return None
        if sender not in (None, address) or sender_port not in (None, str(source_port)):
            return None
        line = datagram.rstrip(b"\n") or b"an empty datagram"
        return line + b"\n"

    interface = "0.0.0.0"
    if sender is None or IPv4Address(sender).is_loopback:
        interface = "127.0.0.1"
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as receiver:
        receiver.bind((interface, int(port)))
        receiver.settimeout(SOURCE_POLL_S)
        yield from _lines(more, silence, first)


LIVE = {
    "-": LiveSource("-", _follow_pipe),
    "tail:": LiveSource("tail:FILE", _follow_file),
    "udp:": LiveSource("udp:PORT", _follow_datagrams, returns=True),
    "dds:": LiveSource(
        "dds:/TOPIC",
        lambda place, stdin, silence, first: follow_topics(place, silence),
        returns=True,
    ),
}
"""Live sources by prefix."""


def _lines(more: Callable[[], bytes | None], silence: float, first: float) -> Iterator[str]:
    """Yield the lines of what ``more`` returns, and an empty one every ``TICK_S`` in which none came.

    Who reads them can tell by these that time goes on, whatever comes in place of rows.

    Args:
        more: returns bytes, none at the end, or None while there are none.
        silence: time without bytes after which the source has died [s].
        first: the same before the first bytes [s].

    Raises:
        SourceDied: nothing came for too long.
    """
    rest = b""
    limit = first
    newest = ticked = time.monotonic()
    while (chunk := more()) != b"":
        now = time.monotonic()
        lines: list[bytes] = []
        if chunk is not None:
            newest = now
            limit = silence
            *lines, rest = (rest + chunk).split(b"\n")
            rest = rest[: LONGEST_LINE_BYTES + 1]  # what is longer is no row, and costs no memory
        elif now - newest > limit:
            raise SourceDied(f"nothing came for {limit:g} s")
        for line in lines:
            yield _text_of(line)
        if not lines and now - ticked > TICK_S:
            ticked = now
            yield ""
    if rest.strip():
        yield _text_of(rest)


def _text_of(line: bytes) -> str:
    """Return a line as text; one that is too long says so."""
    if len(line) > LONGEST_LINE_BYTES:
        return f"a line of more than {LONGEST_LINE_BYTES} bytes"
    return decoded(line)[0]


def record(lines: Iterable[str], to: Path, minutes: float) -> tuple[float, str]:
    """Write rows to a file until the time is over or the source ends; return the seconds, and why it ended."""
    to.parent.mkdir(parents=True, exist_ok=True)
    reason = "the source ended"
    rows = 0
    seconds = 0.0
    with naming(to), open(to, "w", encoding="utf-8", opener=no_links) as file:
        try:
            for line in filter(str.strip, lines):
                if not rows:
                    start = time.monotonic()
                rows += 1
                seconds = time.monotonic() - start
                file.write(line.rstrip("\n") + "\n")
                if seconds >= 60 * minutes:
                    reason = "the time is over"
                    break
        except SourceDied as error:
            reason = f"the source has died, {error}"
    if not rows:
        raise ValueError("no row came")
    return seconds, f"{reason}: {rows} rows in {seconds:.0f} s"
