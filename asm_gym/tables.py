"""Tables as streams: the columns of a log, by name, become the channels of a stream.

A column is a channel of its own. Columns that differ in a number only, ``joint[0], joint[1]`` or ``joint_0, joint_1``,
are the elements of one channel, and so are the columns of a two-dimensional array. Each channel is a group: what it
does is expected from what the others do. What is called ``action`` was commanded, whether somebody says so or not.
"""

from __future__ import annotations

import csv
import re
from collections.abc import Mapping, Sequence
from fnmatch import fnmatchcase
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from asm_gym.checks import check_number
from asm_gym.stream import MOTOR, Channel, StreamSpec

Column = NDArray[Any]

TIME = ("time", "timestamp", "time_s", "t")
"""Columns that say when a row was sensed [s]: they are no channel, and tell the rate."""

RATE_TOLERANCE = 0.01
"""How far a log's rate may be off that of the memory which reads it, as a share."""

_ELEMENT = re.compile(r"(?P<stem>.*[^\W\d_])(?:\[(?P<named>\w+)\]|[_.]?(?P<number>\d+))")


class Signal(NamedTuple):
    """One number of every row.

    Attributes:
        column: what the table calls it.
        channel: which channel it belongs to.
        element: which element of that; empty where it is the only one.
        values: (T,).
    """

    column: str
    channel: str
    element: str
    values: Column

    def goes_by(self, pattern: str) -> bool:
        """Its column or its channel is called so."""
        return any(name == pattern or fnmatchcase(name, pattern) for name in (self.column, self.channel))


def stream_of(
    frame: Any,
    channels: StreamSpec | Mapping[str, str | Sequence[str]] | Sequence[str] | None = None,
    rate: float | None = None,
    action: Sequence[str] = (),
) -> tuple[NDArray[np.float32], StreamSpec]:
    """The rows (T, D) of a table, and what they are called.

    Args:
        frame: a dictionary of arrays, a pandas or Polars frame, or an Arrow table.
        channels: the columns to read, as patterns such as ``joint*``; or patterns by channel; or the spec of a memory
            that is to read them. By default all columns of numbers.
        rate: rows a second [Hz]; by default that of the column ``time``.
        action: patterns of the columns that were commanded and not sensed.

    Raises:
        ValueError: columns are missing, doubled, of several lengths or no numbers; the rate is unknown, or another one
            than the spec's; time runs backwards.
    """
    columns = _columns(frame)
    dt = _period(columns, rate)
    signals = _signals({name: column for name, column in columns.items() if name not in TIME})
    if isinstance(channels, StreamSpec):
        return _read_by(channels, signals, dt), channels
    if dt is None:
        raise ValueError("how many rows come a second? Say the rate [Hz], or add a column time [s]")
    if isinstance(channels, Mapping):
        signals = [s for name, patterns in channels.items() for s in _renamed(name, _chosen(signals, patterns))]
    elif channels is not None:
        signals = _chosen(signals, channels)
    commanded = {s.column for s in _chosen(signals, action)}
    parts: dict[str, list[Signal]] = {}
    for signal in sorted(signals, key=lambda s: s.column in commanded):  # the action stands last
        parts.setdefault(signal.channel, []).append(signal)
    for name, part in parts.items():
        if 0 < len(commanded & {s.column for s in part}) < len(part):
            raise ValueError(f"channel {name!r} is commanded in part: {', '.join(sorted(s.column for s in part))}")
    made = tuple(_channel(name, part, commanded) for name, part in parts.items())
    rows = np.column_stack([s.values for part in parts.values() for s in part])
    return rows.astype(np.float32), StreamSpec(made, dt, "table")


def read_table(path: Path) -> dict[str, Column]:
    """The columns of numbers of a ``.csv`` file with a header: text is left out, an empty cell is NaN.

    Raises:
        ValueError: no header or no row, a name that stands twice, rows of several lengths, a column of numbers that
            holds something else.
    """
    with path.open(newline="", encoding="utf-8-sig") as file:
        lines = [line for line in csv.reader(file) if line]
    if len(lines) < 2:
        raise ValueError(f"{path} needs a header and at least one row, got {len(lines)} lines")
    header = [name.strip() for name in lines[0]]
    doubled = sorted({name for name in header if header.count(name) > 1})
    if doubled:
        raise ValueError(f"{path} has columns of the same name: {', '.join(map(repr, doubled))}")
    for n, line in enumerate(lines[1:], 2):
        if len(line) != len(header):
            raise ValueError(f"{path}, line {n} has {len(line)} cells, its header {len(header)}")
    columns = {name: _numbers(f"{path}, {name}", cells) for name, *cells in zip(header, *lines[1:], strict=True)}
    return {name: column for name, column in columns.items() if column is not None}


@cache
def label_of(column: str) -> str:
    """What a stream calls a number that a table calls so: ``joint[0]`` for ``joint_0``."""
    found = _ELEMENT.fullmatch(column)
    return f"{found['stem']}[{found['named'] or found['number']}]" if found else column


def _numbers(where: str, cells: Sequence[str]) -> Column | None:
    """A column of text as numbers; None where none of it is one."""
    values, wrong = np.full(len(cells), np.nan), []
    for n, cell in enumerate(cells):
        try:
            values[n] = float(cell or "nan")
        except ValueError:
            wrong.append(n)
    if not wrong:
        return values
    if len(wrong) == sum(bool(cell) for cell in cells):
        return None
    raise ValueError(f"{where}, line {wrong[0] + 2} must be a number, got {cells[wrong[0]]!r}")


def _columns(frame: Any) -> dict[str, Column]:
    """The columns of numbers by name, (T,) or (T, k) each."""
    # A dictionary has keys, an Arrow table column_names, pandas and Polars have columns.
    names = frame if isinstance(frame, Mapping) else getattr(frame, "column_names", None) or frame.columns
    columns = {str(name): np.asarray(frame[name]) for name in names}
    if len(columns) < len(list(names)):
        raise ValueError(f"columns must have different names, got {', '.join(map(str, names))}")
    columns = {n: c for n, c in columns.items() if c.dtype.kind in "biuf" and c.ndim in (1, 2)}
    lengths = {n: len(c) for n, c in columns.items()}
    if not lengths or not max(lengths.values()):
        raise ValueError("the table holds no numbers")
    if len(set(lengths.values())) > 1:
        raise ValueError(f"columns must have one length, got {', '.join(f'{n}: {k}' for n, k in lengths.items())}")
    return columns


def _period(columns: dict[str, Column], rate: float | None) -> float | None:
    """Seconds from row to row, as said or as a column of time has it; None where nothing says."""
    if rate is not None:
        return 1.0 / check_number("rate", rate, above=0)
    found = next((columns[name] for name in TIME if name in columns), None)
    if found is None or len(found) < 2 or found.ndim != 1:
        return None
    steps = np.diff(found.astype(np.float64))
    if not np.all(steps > 0):
        row = int(np.argmin(steps > 0)) + 1
        raise ValueError(f"time must increase from row to row, got {found[row - 1]:g} s before {found[row]:g} s")
    return float(f"{np.median(steps):.6g}")  # stamps jitter, and rates that differ by rounding would be two rates


def _signals(columns: Mapping[str, Column]) -> list[Signal]:
    """Every number of a row; columns that differ in a number only are elements of one channel."""
    split = {name: _ELEMENT.fullmatch(name) for name, column in columns.items() if column.ndim == 1}
    stems = [found["stem"] for found in split.values() if found]
    made = []
    for name, column in columns.items():
        found = split.get(name)
        if column.ndim == 2:
            made += [Signal(f"{name}[{k}]", name, str(k), column[:, k]) for k in range(column.shape[1])]
        elif found and (found["named"] or stems.count(found["stem"]) > 1) and found["stem"] not in columns:
            made.append(Signal(name, found["stem"], found["named"] or found["number"], column))
        else:
            made.append(Signal(name, name, "", column))
    return made


def _chosen(signals: Sequence[Signal], patterns: str | Sequence[str]) -> list[Signal]:
    """Those that go by one of the patterns, in the order of the table. Raises ValueError where one finds nothing."""
    asked = [patterns] if isinstance(patterns, str) else list(patterns)
    for pattern in asked:
        if not any(s.goes_by(pattern) for s in signals):
            raise ValueError(f"no column is called {pattern!r}; there are: {', '.join(s.column for s in signals)}")
    return [s for s in signals if any(s.goes_by(pattern) for pattern in asked)]


def _renamed(channel: str, signals: Sequence[Signal]) -> list[Signal]:
    """As elements of this channel."""
    return [s._replace(channel=channel, element=s.column if len(signals) > 1 else "") for s in signals]


def _channel(name: str, signals: Sequence[Signal], commanded: set[str]) -> Channel:
    elements = tuple(s.element for s in signals)
    group = MOTOR if signals[0].column in commanded else name
    return Channel(name, len(signals), group=group, elements=elements if any(elements) else ())


def _read_by(spec: StreamSpec, signals: Sequence[Signal], dt: float | None) -> NDArray[np.float32]:
    """The rows (T, D) as a memory of this spec reads them; what else the table holds is left out."""
    if dt is not None and abs(dt / spec.dt - 1) > RATE_TOLERANCE:
        raise ValueError(f"the memory reads {1 / spec.dt:g} rows a second, these come at {1 / dt:g}")
    # joint_0 is joint[0] too, though it may be the only one here.
    known = {label_of(s.column): s.values for s in signals} | {s.column: s.values for s in signals}
    missing = [label for label in spec.labels if label not in known]
    if missing:
        raise ValueError(f"the memory reads channels that are not there: {', '.join(missing)}")
    return np.column_stack([known[label] for label in spec.labels]).astype(np.float32)
