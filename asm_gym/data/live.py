"""Follow rows as they come, from standard input, a file that grows or UDP, and read them as rows of a stream.

A JSON line is a list of numbers, or an object by channel or by number. CSV begins with a header. Where there is a time,
rows that are missing by it are counted. A source that falls silent has died.
"""

from __future__ import annotations

import json
import os
import select
import socket
import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from io import UnsupportedOperation
from pathlib import Path
from typing import Any, NamedTuple, TextIO

import numpy as np
from numpy.typing import NDArray

from asm_gym.data.clock import Clock, clock_among
from asm_gym.data.names import label_of
from asm_gym.data.pace import ClockWentBack, Pace
from asm_gym.data.text import Dialect, flat_row, header_of
from asm_gym.data.units import bare_name, factor
from asm_gym.files import regular_file
from asm_gym.spec import StreamSpec
from asm_gym.validation import check_number

POLL_S = 0.002
"""How often a file is looked at for more [s]."""

LARGEST = 65_535
"""Bytes of a datagram, and more than a row of any robot."""


class SourceDied(Exception):  # noqa: N818 (it is no error of ours)
    """Nothing came for longer than a source may be silent."""


def follow_pipe(stdin: TextIO, silence: float) -> Iterator[str]:
    """Yield the lines of standard input. Raises SourceDied after ``silence`` seconds without one."""
    try:
        number = stdin.fileno()
    except (UnsupportedOperation, AttributeError):  # no pipe, but text in memory
        yield from stdin
        return

    def more() -> bytes | None:
        ready, _, _ = select.select([number], [], [], POLL_S)
        return os.read(number, LARGEST) if ready else None

    yield from _lines(more, silence)


def follow_file(path: Path, silence: float) -> Iterator[str]:
    """Yield the lines of a file that grows. Raises ValueError where it became shorter, and SourceDied."""
    regular_file(path)
    with path.open("rb") as file:

        def more() -> bytes | None:
            found = file.read(LARGEST)
            if not found:
                if path.stat().st_size < file.tell():
                    raise ValueError(f"{path} became shorter while it was followed")
                time.sleep(POLL_S)
            return found or None

        yield from _lines(more, silence)


def follow_datagrams(place: str, silence: float) -> Iterator[str]:
    """Yield the lines of datagrams that this machine sends to a port of itself. Raises SourceDied, ValueError."""
    if not place.isdigit():
        raise ValueError(f"udp takes a port of this machine, as in udp:9870, got {place!r}")
    port = int(check_number("port", int(place), low=1, high=65_535, whole=True))
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as there:
        there.bind(("127.0.0.1", port))  # nobody else's rows are believed
        there.settimeout(POLL_S)

        def more() -> bytes | None:
            try:
                found = there.recv(LARGEST)
            except TimeoutError:
                return None
            return found.rstrip(b"\n") + b"\n" if found else b""

        yield from _lines(more, silence)


def _lines(more: Callable[[], bytes | None], silence: float) -> Iterator[str]:
    """Lines of what ``more`` returns: bytes, none at the end, or None where there are none yet."""
    rest, last = b"", None
    while True:
        found = more()
        if found == b"":
            if rest.strip():
                yield rest.decode()
            return
        if found is None:
            if last is not None and time.monotonic() - last > silence:
                raise SourceDied(f"nothing came for {silence:g} s")
            continue
        last = time.monotonic()
        *whole, rest = (rest + found).split(b"\n")
        if len(rest) > 100 * LARGEST:
            raise ValueError(f"a line of {len(rest)} bytes is no row")
        yield from (line.decode() for line in whole)


def record(lines: Iterable[str], to: Path, minutes: float) -> tuple[float, str]:
    """Write rows to a file until the time is over or the source ends; return how long that took [s], and why it ended.

    Raises:
        ValueError: no row came.
    """
    to.parent.mkdir(parents=True, exist_ok=True)
    start = time.monotonic()
    why, seconds, rows = "the source ended", 0.0, 0
    with to.open("w", encoding="utf-8") as file:
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


class Row(NamedTuple):
    """A row.

    Attributes:
        numbers: (D,) NaN where one was lost.
        lost: rows that should have come before it.
        read: whether it stands where the memory reads one.
        change: a message about the rate, where that changed.
    """

    numbers: NDArray[np.float64]
    lost: int = 0
    read: bool = True
    change: str = ""


class RowReader:
    """Read lines as rows of a stream.

    Args:
        spec: of the memory that is to read them.

    Example:
        >>> from asm_gym import Channel, StreamSpec
        >>> reader = RowReader(StreamSpec((Channel("q", 2, "rad"),), dt=0.01))
        >>> [row.numbers.tolist() for row, _ in reader.rows(["[1, 2]", "[3, 4]"])]
        [[1.0, 2.0], [3.0, 4.0]]
    """

    def __init__(self, spec: StreamSpec) -> None:
        self.spec, self.line = spec, 0
        self._dialect = Dialect(",", comma=False)
        self._header: list[str] | None = None  # of CSV
        self._columns: dict[str, tuple[str, float]] | None = None  # of each label, and its factor
        self._clock: Clock | None = None
        self._pace = Pace(spec.dt)

    def rows(self, lines: Iterable[str]) -> Iterator[tuple[Row, float]]:
        """Yield each row, and when its line came, by ``time.perf_counter``.

        Raises:
            ValueError: a line is no row; the message says which.
        """
        for line in lines:
            if not line.strip():
                continue
            arrived = time.perf_counter()
            self.line += 1
            if self.line == 1 and line.lstrip()[0] not in "[{":
                self._read_header(line)
                continue
            try:
                numbers, stamp = self._numbers(line)
                lost = 0 if stamp is None else self._pace.lost(stamp)
            except (ValueError, TypeError) as error:
                kind = ClockWentBack if isinstance(error, ClockWentBack) else ValueError
                raise kind(f"line {self.line} is no row of numbers: {error}") from error
            if numbers.shape != (self.spec.size,):
                raise ValueError(f"line {self.line} must hold {self.spec.size} numbers, got the shape {numbers.shape}")
            yield Row(numbers, lost or 0, lost is not None, "" if stamp is None else self._pace.change), arrived

    def _read_header(self, line: str) -> None:
        self._dialect = Dialect.of(line)
        try:
            self._header = header_of(self._dialect.cells(line), "the header")
            self._match(self._header)
        except ValueError as error:
            raise ValueError(f"line 1 is no row of numbers, and no header: {error}") from error

    def _match(self, names: Iterable[str]) -> None:
        """Find the column of each label, and the clock. Raises ValueError where a column is missing."""
        names = list(names)
        bare = {name: bare_name(name) for name in names}
        places = {label_of(b): name for name, b in bare.items()} | {b: name for name, b in bare.items()}
        labels = {label: label for label in self.spec.labels}
        for channel in self.spec.channels:  # a list by its channel's name
            labels |= {label: f"{channel.name}[{k}]" for k, label in enumerate(channel.labels) if label not in places}
        missing = [label for label, name in labels.items() if name not in places]
        if missing:
            raise ValueError(f"it lacks {', '.join(missing)}")
        units = dict(zip(self.spec.labels, self.spec.units, strict=True))
        self._columns = {label: (places[name], factor(places[name], units[label])) for label, name in labels.items()}
        self._clock = clock_among(names)

    def _numbers(self, line: str) -> tuple[NDArray[np.float64], float | None]:
        """The numbers of a row (D,), and its time [s] where it has one."""
        if self._header is not None:
            cells = self._dialect.cells(line)
            size = len(self._header)
            if len(cells) < size or any(cell.strip() for cell in cells[size:]):
                raise ValueError(f"it has {len(cells)} cells, the header {size}")
            return self._by_name(dict(zip(self._header, cells, strict=False)), self._dialect.number)
        row: Any = json.loads(line)
        if isinstance(row, list):
            return np.asarray(row, np.float64), None
        flat = flat_row(row)
        for channel in self.spec.channels:
            if isinstance(part := row.get(channel.name), list) and len(part) != channel.size:
                raise ValueError(f"{channel.name} must hold {channel.size} numbers, got {len(part)}")
        if self._columns is None:
            self._match(flat)
        return self._by_name(flat, lambda value: float("nan" if value is None else value))

    def _by_name(
        self, row: Mapping[str, Any], number: Callable[[Any], float]
    ) -> tuple[NDArray[np.float64], float | None]:
        """A number that a row lacks is NaN."""
        assert self._columns is not None
        numbers = [number(row.get(name)) * scale if name in row else np.nan for name, scale in self._columns.values()]
        stamp = row.get(self._clock.column) if self._clock else None
        return np.array(numbers), None if stamp is None or self._clock is None else self._clock.moment(str(stamp))
