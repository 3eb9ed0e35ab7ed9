"""Rows as they come: from standard input, a file that grows, UDP, a controller or DDS; as JSON lines or as CSV.

A JSON line is a list of numbers, or an object by channel or by number. CSV begins with a header. Where there is a time,
rows that are missing by it are said. A source that falls silent has died, which is for the reader to say.
"""

from __future__ import annotations

import json
import os
import select
import socket
import time
from collections.abc import Callable, Iterable, Iterator
from io import UnsupportedOperation
from pathlib import Path
from typing import Any, NamedTuple, TextIO

import numpy as np
from numpy.typing import NDArray

from asm_gym.data.channels import bare_name, label_of, unit_of
from asm_gym.data.clock_column import Clock, clock_among
from asm_gym.data.resampling import ClockWentBack, Pace
from asm_gym.data.ros2_dds import dds_lines
from asm_gym.data.text import Dialect, header_of
from asm_gym.data.units import ratio
from asm_gym.files import regular_file
from asm_gym.spec import StreamSpec
from asm_gym.validation import check_number

POLL_S = 0.002
"""How often a file is looked at for more [s]."""

LARGEST = 65_535
"""Bytes of a datagram, and more than a row of any robot."""

SOURCES = ("-", "tail:FILE", "udp:PORT", "dds:/TOPIC")

RETURNING = ("udp:", "dds:")
"""Sources that may come back after they have died."""


class SourceDied(Exception):  # noqa: N818 (it is no error of ours)
    """Nothing came for longer than a source may be silent."""


def is_live(source: str) -> bool:
    """Whether it is followed, and no recording."""
    return source == "-" or source.startswith(("tail:", *RETURNING))


def lines_from(source: str, stdin: TextIO, silence: float) -> Iterator[str]:
    """The lines of a live source, as they come.

    Args:
        source: ``-`` for standard input, ``tail:FILE`` for a file that grows, ``udp:PORT`` for datagrams sent to this
            machine from itself, of which an empty one is the end, ``dds:/joint_states`` for topics of ROS 2.
        silence: seconds without a line, after the first one, from which on the source has died.

    Raises:
        SourceDied: it has.
        ValueError: it is none of these, the port is no number, or the file became shorter.
        OSError: there is no such file, or the port is taken.
    """
    if source == "-":
        return _piped(stdin, silence)
    kind, _, place = source.partition(":")
    if kind == "tail":
        return _growing(Path(place), silence)
    if kind == "udp":
        return _datagrams(place, silence)
    if kind == "dds":
        return _dying(dds_lines(place, silence), place)
    raise ValueError(f"unknown source {source!r}; known: {', '.join(SOURCES)}")


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


def _piped(stdin: TextIO, silence: float) -> Iterator[str]:
    try:
        number = stdin.fileno()
    except (UnsupportedOperation, AttributeError):  # no pipe, but text in memory
        yield from stdin
        return

    def more() -> bytes | None:
        ready, _, _ = select.select([number], [], [], POLL_S)
        return os.read(number, LARGEST) if ready else None

    yield from _cut(more, silence)


def _growing(path: Path, silence: float) -> Iterator[str]:
    regular_file(path)
    with path.open("rb") as file:

        def more() -> bytes | None:
            found = file.read(LARGEST)
            if not found:
                if path.stat().st_size < file.tell():
                    raise ValueError(f"{path} became shorter while it was followed")
                time.sleep(POLL_S)
            return found or None

        yield from _cut(more, silence)


def _datagrams(place: str, silence: float) -> Iterator[str]:
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

        yield from _cut(more, silence)


def _dying(lines: Iterator[str], what: str) -> Iterator[str]:
    """These lines, of a source that has died where they fall silent after the first."""
    heard = False
    try:
        for line in lines:
            heard = True
            yield line
    except TimeoutError as error:
        if not heard:
            raise OSError(f"no row came from {what}: {error}") from error
        raise SourceDied(str(error)) from error


def _cut(more: Callable[[], bytes | None], silence: float) -> Iterator[str]:
    """Lines of what ``more`` hands out: bytes, none at the end, or None where there are none yet."""
    rest, heard = b"", None
    while True:
        found = more()
        if found == b"":
            if rest.strip():
                yield rest.decode()
            return
        if found is None:
            if heard is not None and time.monotonic() - heard > silence:
                raise SourceDied(f"nothing came for {silence:g} s")
            continue
        heard = time.monotonic()
        *whole, rest = (rest + found).split(b"\n")
        if len(rest) > 100 * LARGEST:
            raise ValueError(f"a line of {len(rest)} bytes is no row")
        yield from (line.decode() for line in whole)


class Row(NamedTuple):
    """A row.

    Attributes:
        numbers: (D,) NaN where one was lost.
        lost: rows that should have come before it.
        read: whether it stands where the memory reads one.
        change: what is to be said of the rate, where that changed.
    """

    numbers: NDArray[np.float64]
    lost: int = 0
    read: bool = True
    change: str = ""


def _factor(name: str, unit: str) -> float:
    """How many of ``unit`` are in one of what a name says behind it. Raises ValueError where there is no way."""
    theirs = unit_of(name)
    factor = 1.0 if not theirs or unit == "1" else ratio(theirs, unit)
    if factor is None:
        raise ValueError(f"{name} is in {theirs}, and the memory reads {unit}")
    return factor


class RowReader:
    """Reads lines as rows of a spec.

    Args:
        spec: of the memory that is to read them.
    """

    def __init__(self, spec: StreamSpec) -> None:
        self.spec, self.line = spec, 0
        self._units = spec.units
        self._order: list[int] | None = None  # of CSV: where each number of a row stands
        self._how = Dialect(",", comma=False)
        self._clock: Clock | None = None
        self._clock_at = 0
        self._width = 0
        self._pace = Pace(spec.dt)

    def rows(self, lines: Iterable[str]) -> Iterator[tuple[Row, float]]:
        """Each row, and when its line had come, by ``time.perf_counter``.

        Raises:
            ValueError: a line is no row; the message says which.
        """
        for line in lines:
            if not line.strip():
                continue
            came = time.perf_counter()
            self.line += 1
            if self.line == 1 and line.lstrip()[0] not in "[{":
                self._how = Dialect.of(line)
                self._begin(next(self._how.cells(iter([line]))))
                continue
            try:
                numbers, stamp = self._cells(line) if self._order is not None else self._json(line)
                lost = 0 if stamp is None else self._pace.lost(stamp)
            except (ValueError, TypeError) as error:
                kind = ClockWentBack if isinstance(error, ClockWentBack) else ValueError
                raise kind(f"line {self.line} is no row of numbers: {error}") from error
            if numbers.shape != (self.spec.size,):
                raise ValueError(f"line {self.line} must hold {self.spec.size} numbers, got the shape {numbers.shape}")
            yield Row(numbers, lost or 0, lost is not None, "" if stamp is None else self._pace.change), came

    def _begin(self, header: list[str]) -> None:
        """Where the numbers stand that are read, by the header of CSV."""
        try:
            names = [bare_name(name) for name in header_of(header, "the header")]
            places = {label_of(name): k for k, name in enumerate(names)} | {name: k for k, name in enumerate(names)}
            missing = [label for label in self.spec.labels if label not in places]
            if missing:
                raise ValueError(f"it lacks {', '.join(missing)}")
        except ValueError as error:
            raise ValueError(f"line 1 is no row of numbers, and no header: {error}") from error
        self._order, self._width = [places[label] for label in self.spec.labels], len(names)
        self._factors = np.array([_factor(header[k], unit) for k, unit in zip(self._order, self._units, strict=True)])
        headed = [name.strip() for name in header]
        self._clock = clock_among(headed)
        self._clock_at = headed.index(self._clock.column) if self._clock else 0

    def _cells(self, line: str) -> tuple[NDArray[np.float64], float | None]:
        cells = next(self._how.cells(iter([line])))
        if len(cells) < self._width or any(cell.strip() for cell in cells[self._width :]):
            raise ValueError(f"it has {len(cells)} cells, the header {self._width}")
        assert self._order is not None
        numbers = self._factors * np.array([self._how.number(cells[k]) for k in self._order])
        return numbers, None if self._clock is None else self._clock.moment(cells[self._clock_at])

    def _json(self, line: str) -> tuple[NDArray[np.float64], float | None]:
        said: Any = json.loads(line)
        if not isinstance(said, dict):
            return np.asarray(said, np.float64), None
        if self.line == 1:
            self._clock = clock_among(said)
        stamp = said.get(self._clock.column) if self._clock else None
        return self._by_name(said), None if stamp is None or self._clock is None else self._clock.moment(str(stamp))

    def _by_name(self, said: dict[str, Any]) -> NDArray[np.float64]:
        """The numbers (D,) by the names of channels or of single numbers; the first row has to hold them all."""
        parts, missing = [], []
        if any(unit_of(name) for name in said):
            said = {bare_name(n): v if not unit_of(n) else self._converted(n, v) for n, v in said.items()}
        said = {label_of(name): value for name, value in said.items()} | said
        for channel in self.spec.channels:
            values = said[channel.name] if channel.name in said else [said.get(label) for label in channel.labels]
            if channel.name not in said and not set(channel.labels) <= set(said):
                missing.append(channel.name)
            parts.append(np.ravel(np.asarray(values, np.float64)))  # null is NaN
        if missing and self.line == 1:
            raise ValueError(f"it lacks {', '.join(missing)}")
        return np.concatenate(parts)

    def _converted(self, name: str, value: Any) -> Any:
        """In the unit that the memory reads."""
        bare = bare_name(name)
        units = {c.name: c.unit for c in self.spec.channels} | dict(zip(self.spec.labels, self._units, strict=True))
        unit = units.get(bare, units.get(label_of(bare)))
        return value if unit is None or value is None else _factor(name, unit) * np.asarray(value, np.float64)
