"""Follow lines as they come: from standard input, a file that grows, datagrams, or ROS 2 topics.

A source that falls silent has died. A new source is one row of ``LIVE``.
"""

from __future__ import annotations

import math
import os
import select
import socket
import time
from collections.abc import Callable, Iterable, Iterator
from io import UnsupportedOperation
from ipaddress import IPv4Address
from pathlib import Path
from typing import NamedTuple, TextIO

from asm_gym.data.rows import SourceDied
from asm_gym.files import no_links, regular_file
from asm_gym.validation import check_number

POLL_S = 0.002  # how often a source is looked at for more [s]
LARGEST = 65_535  # bytes of a datagram
LONGEST = 100 * LARGEST  # bytes of a line: more than a row of any robot
EMPTY = b"an empty datagram"  # the line that stands for one


class LiveSource(NamedTuple):
    """A source that is followed."""

    example: str  # of its name
    open: Callable[[str, TextIO, float, float], Iterator[str]]
    """Takes what follows the prefix, standard input, silence [s], and how long the first line may take [s]."""
    returns: bool = False  # whether it may come back after it died


def live_source(source: str) -> LiveSource | None:
    """Return the live source of this name; None where it names a recording."""
    return LIVE.get(source if source == "-" else f"{source.partition(':')[0]}:")


def lines_from(source: str, stdin: TextIO, silence: float, first: float = math.inf) -> Iterator[str]:
    """Return the lines of a live source, as they come.

    Sources are ``-`` for standard input, ``tail:FILE`` for a file that grows, ``udp:PORT`` for datagrams of this
    machine, ``udp:PORT@ADDRESS`` or ``udp:PORT@ADDRESS:PORT`` for those of one sender, and ``dds:/joint_states`` for
    topics of ROS 2.

    Args:
        silence: without a line for so long the source has died, which raises SourceDied [s].
        first: as ``silence``, before the first line.
    """
    found = live_source(source)
    if found is None:
        raise ValueError(f"unknown source {source!r}; known: {', '.join(s.example for s in LIVE.values())}")
    return found.open(source.partition(":")[2], stdin, silence, first)


def _follow_pipe(place: str, stdin: TextIO, silence: float, first: float) -> Iterator[str]:
    try:
        number = stdin.fileno()
    except (UnsupportedOperation, AttributeError):  # no pipe, but text in memory
        yield from stdin
        return

    def more() -> bytes | None:
        ready, _, _ = select.select([number], [], [], POLL_S)
        return os.read(number, LARGEST) if ready else None

    yield from _lines(more, silence, first)


def _follow_file(place: str, stdin: TextIO, silence: float, first: float) -> Iterator[str]:
    path = Path(place)
    regular_file(path)
    with path.open("rb") as file:

        def more() -> bytes | None:
            found = file.read(LARGEST)
            if not found:
                if path.stat().st_size < file.tell():
                    raise ValueError(f"{path} became shorter while it was followed")
                time.sleep(POLL_S)
            return found or None

        yield from _lines(more, silence, first)


def _follow_datagrams(place: str, stdin: TextIO, silence: float, first: float) -> Iterator[str]:
    """Yield the lines of datagrams to a port of this machine, from itself or from one sender elsewhere.

    Nothing that a datagram holds ends them: an empty one is a line that is no row.
    """
    number, at, sender = place.partition("@")
    host, colon, own = sender.partition(":")
    if not number.isdigit() or (at and not host) or (colon and not own.isdigit()):
        raise ValueError(f"udp takes a port of this machine, as in udp:9870, or udp:9870@127.0.0.1:5005, got {place!r}")
    port = int(check_number("port", int(number), low=1, high=65_535, whole=True))
    believed = IPv4Address(host or "127.0.0.1")
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as receiver:
        receiver.bind(("127.0.0.1" if believed.is_loopback else "0.0.0.0", port))
        receiver.settimeout(POLL_S)

        def more() -> bytes | None:
            try:
                found, (address, source) = receiver.recvfrom(LARGEST)
            except TimeoutError:
                return None
            if (host and IPv4Address(address) != believed) or (own and source != int(own)):
                return None
            return (found.rstrip(b"\n") or EMPTY) + b"\n"

        yield from _lines(more, silence, first)


def _follow_topics(place: str, stdin: TextIO, silence: float, first: float) -> Iterator[str]:
    from asm_gym.data.ros2_dds import follow_topics

    return follow_topics(place, silence)


LIVE = {
    "-": LiveSource("-", _follow_pipe),
    "tail:": LiveSource("tail:FILE", _follow_file),
    "udp:": LiveSource("udp:PORT", _follow_datagrams, returns=True),
    "dds:": LiveSource("dds:/TOPIC", _follow_topics, returns=True),
}
"""Live sources by prefix."""


def _lines(more: Callable[[], bytes | None], silence: float, first: float) -> Iterator[str]:
    """Lines of what ``more`` returns: bytes, none at the end, or None where there are none yet."""
    rest, last, most = b"", time.monotonic(), first
    while (found := more()) != b"":
        if found is None:
            if time.monotonic() - last > most:
                raise SourceDied(f"nothing came for {most:g} s")
            continue
        last, most = time.monotonic(), silence
        *whole, rest = (rest + found).split(b"\n")
        rest = rest[: LONGEST + 1]  # what is longer is no row, and costs no memory
        yield from map(_text, whole)
    if rest.strip():
        yield _text(rest)


def _text(line: bytes) -> str:
    """Return a line as text; what is none, or too long, as something that cannot be read as a row."""
    return f"a line of more than {LONGEST} bytes" if len(line) > LONGEST else line.decode(errors="replace")


def record(lines: Iterable[str], to: Path, minutes: float) -> tuple[float, str]:
    """Write rows to a file until the time is over or the source ends; return the seconds, and why it ended."""
    to.parent.mkdir(parents=True, exist_ok=True)
    start = time.monotonic()
    why, seconds, rows = "the source ended", 0.0, 0
    with open(to, "w", encoding="utf-8", opener=no_links) as file:
        try:
            for line in filter(str.strip, lines):
                start = time.monotonic() if not rows else start
                rows, seconds = rows + 1, time.monotonic() - start
                file.write(line.rstrip("\n") + "\n")
                if seconds >= 60 * minutes:
                    why = "the time is over"
                    break
        except SourceDied as error:
            why = f"the source has died, {error}"
    if not rows:
        raise ValueError("no row came")
    return seconds, f"{why}: {rows} rows in {seconds:.0f} s"
