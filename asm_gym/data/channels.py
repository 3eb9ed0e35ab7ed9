"""Tables as streams: the columns of a log, by name, become the channels of a stream.

A column is a channel of its own. Columns that differ in a number only, ``joint[0], joint[1]`` or ``joint_0, joint_1``,
are the elements of one channel, and so are the columns of a two-dimensional array. Each channel is a group: what it
does is expected from what the others do. What is called ``action`` was commanded, whether somebody says so or not. A
unit may stand behind a name, ``joint_0 [rad]``. Rows that are late or lost by their clock are put right
(``asm_gym.data.clock_column``, ``row_times``). Clocks, counters of rows and labels are no channels.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Mapping, Sequence
from fnmatch import fnmatchcase
from functools import cache
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from asm_gym.data.clock_column import clock_among, is_clock
from asm_gym.data.reader_notes import note
from asm_gym.data.row_times import increasing, period, regular
from asm_gym.data.tabular import as_array
from asm_gym.data.text import read_table
from asm_gym.data.units import ratio
from asm_gym.readings import noise_of
from asm_gym.spec import MOTOR, Channel, StreamSpec
from asm_gym.validation import check_number, shown

__all__ = ["bare_name", "counts_rows", "is_label", "label_of", "read_recorded", "read_table", "stream_of", "unit_of"]

Column = NDArray[Any]

COUNTERS = ("", "index", "idx", "num", "no", "no.", "row", "seq", "frame", "frame_index", "unnamed: 0")
"""What columns are called that count rows, where each is one more than the one before, but for rows that were lost."""

NORMAL = ("", "0", "false", "no", "none", "normal", "nominal", "ok", "good", "healthy", "nan")
"""Words of a label that say that nothing is wrong."""

RESAMPLED = 1.5
"""A log with a clock is read at another rate, up to so many times its own or as much slower."""

SLOWEST = 1e-6
"""The least rate of a log [Hz]: a row in eleven days."""

RATE_TOLERANCE = 0.01
"""How far a log's rate may be off that of the memory which reads it, as a share."""

_ELEMENT = re.compile(r"(?P<stem>.*[^\W\d_])(?:\[(?P<named>\w+)\]|[_.]?(?P<number>\d+))")


_UNIT = re.compile(r"(?P<name>.*\S)\s+[\[(](?P<unit>[^\[\]()]+)[\])]")

_LABEL = re.compile(
    r"(.*[^a-z])?(labels?|anomal(y|ies|ous)|faults?|faulty|failures?|protective_?stop|grip_?lost)([^a-z].*)?", re.I
)


SPEED = re.compile(r"(.*[^a-z])?(vel|velocity|velocities|speeds?|qd|dq|qvel|joint_vel)([^a-z].*)?")
POSITION = re.compile(r"(.*[^a-z])?(pos|position|positions|angles?|q|qpos|joint_pos)([^a-z].*)?")
"""What speeds and positions of joints are called."""


class Signal(NamedTuple):
    """One number of every row.

    Attributes:
        column: what the table calls it.
        channel: which channel it belongs to.
        element: which element of that; empty where it is the only one.
        values: (T,).
        unit: as the table says; empty where it does not.
    """

    column: str
    channel: str
    element: str
    values: Column
    unit: str = ""

    def goes_by(self, pattern: str) -> bool:
        """Its column or its channel is called so."""
        return any(name == pattern or fnmatchcase(name, pattern) for name in (self.column, self.channel))


class Recorded(NamedTuple):
    """What a table says of an episode."""

    stream: NDArray[np.float32]  # (T, D)
    spec: StreamSpec
    faults: NDArray[np.bool_]  # (T,) where a label says that something is wrong; (0,) where the table has no label


def stream_of(
    frame: Any,
    channels: StreamSpec | Mapping[str, str | Sequence[str]] | Sequence[str] | None = None,
    rate: float | None = None,
    action: Sequence[str] = (),
) -> tuple[NDArray[np.float32], StreamSpec]:
    """The rows (T, D) of a table, and what they are called; the arguments are those of ``read_recorded``."""
    found = read_recorded(frame, channels, rate, action)
    return found.stream, found.spec


def read_recorded(
    frame: Any,
    channels: StreamSpec | Mapping[str, str | Sequence[str]] | Sequence[str] | None = None,
    rate: float | None = None,
    action: Sequence[str] = (),
    labels: Sequence[str] = (),
) -> Recorded:
    """The rows of a table, what they are called, and where they are labelled as faulty.

    Args:
        frame: a dictionary of arrays, a pandas or Polars frame, or an Arrow table.
        channels: the columns to read, as patterns such as ``joint*``; or patterns by channel; or the spec of a memory
            that is to read them. By default all columns of numbers.
        rate: rows a second [Hz]; by default that of its clock.
        action: patterns of the columns that were commanded and not sensed.
        labels: patterns of the columns that say what is wrong, beside those that are called so.

    Raises:
        ValueError: columns are missing, doubled, of several lengths or no numbers; the rate is unknown, or another one
            than the spec's; time runs backwards.
    """
    everything = _arrays(frame)
    clock = clock_among(everything)
    wrong = {n: _wrong(c) for n, c in everything.items() if c.ndim == 1 and is_label(n, labels)}
    known = set(channels.labels) | {c.name for c in channels.channels} if isinstance(channels, StreamSpec) else set()
    wrong = {n: c for n, c in wrong.items() if n not in known}
    columns, units = _without_units(_numbers(everything, wrong))
    faults = np.logical_or.reduce(list(wrong.values())) if wrong else np.zeros(0, np.bool_)
    dt = None if rate is None else 1.0 / check_number("rate", rate, low=SLOWEST)
    if clock is not None:
        times = clock.seconds(everything[clock.column])
        if len(times) != len(next(iter(columns.values()))):
            raise ValueError(f"columns must have one length, got {clock.column}: {len(times)}")
        kept = increasing(times)
        times, columns = times[kept], {n: c[kept] for n, c in columns.items()}
        faults = faults[kept] if wrong else faults
        own = period(times)
        dt = own if dt is None else dt
        if own is not None and dt is not None:
            theirs = _rate_to_read(channels, dt, own, rate)
            marks = {_FAULTS: faults.astype(np.float64)} if wrong else {}
            columns = regular(columns | marks, times, theirs)
            faults = np.nan_to_num(columns.pop(_FAULTS).astype(np.float64)) > 0 if wrong else faults
            dt = dt if rate is not None else theirs
    signals = [s._replace(unit=units.get(s.column, units.get(s.channel, ""))) for s in _signals(columns)]
    if isinstance(channels, StreamSpec):
        return Recorded(_read_by(channels, signals, dt), channels, faults)
    if dt is None:
        raise ValueError("how many rows come a second? Say the rate [Hz] of this layout, or add a column time [s]")
    return Recorded(*_named(signals, channels, dt, action), faults)


_FAULTS = "\0faults"
"""Where labels travel among columns; no table calls a column so."""


def _rate_to_read(channels: Any, dt: float, own: float, rate: float | None) -> float:
    """How far apart rows are to be [s]: as the memory reads them, where the clock can be followed that far."""
    if not isinstance(channels, StreamSpec) or rate is not None:
        return dt
    if _alike(channels.dt, own):
        return channels.dt
    if 1 / RESAMPLED <= own / channels.dt <= RESAMPLED:
        note(f"rows that come at {1 / own:.4g} a second are read at {1 / channels.dt:.4g}, by their clock")
        return channels.dt
    return own


def _named(
    signals: list[Signal], channels: Any, dt: float, action: Sequence[str]
) -> tuple[NDArray[np.float32], StreamSpec]:
    """The rows (T, D) of what is chosen, and their spec."""
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


def is_label(name: str, patterns: Sequence[str] = ()) -> bool:
    """Whether a column of that name says what is wrong, and senses nothing."""
    return _LABEL.fullmatch(name) is not None or any(fnmatchcase(name, pattern) for pattern in patterns)


def _wrong(column: Column) -> NDArray[np.bool_]:
    """(T,) where a label says that something is."""
    if column.dtype.kind in "biuf":
        said: NDArray[np.bool_] = np.nan_to_num(column.astype(np.float64)) != 0
        return said
    return np.array([str(cell).strip().lower() not in NORMAL for cell in column])


@cache
def label_of(column: str) -> str:
    """What a stream calls a number that a table calls so: ``joint[0]`` for ``joint_0``."""
    found = _ELEMENT.fullmatch(column)
    return f"{found['stem']}[{found['named'] or found['number']}]" if found else column


def _arrays(frame: Any) -> dict[str, Column]:
    """All columns of a table by name."""
    # A dictionary has keys, an Arrow table column_names, pandas and Polars have columns.
    names = frame if isinstance(frame, Mapping) else getattr(frame, "column_names", getattr(frame, "columns", None))
    if names is None or callable(names):
        raise TypeError(f"a table must be a dictionary of columns, or a frame of them, got {shown(frame)}")
    columns = {str(name): as_array(frame[name]) for name in names}
    if len(columns) < len(list(names)):
        raise ValueError(f"columns must have different names, got {', '.join(map(str, names))}")
    return columns


def _numbers(everything: Mapping[str, Column], labels: Mapping[str, Any]) -> dict[str, Column]:
    """The columns of numbers by name, (T,) or (T, k) each, that are none of clocks, labels and counters of rows."""
    columns = {n: c for n, c in everything.items() if c.dtype.kind in "biuf" and c.ndim in (1, 2)}
    columns = {n: c for n, c in columns.items() if not (is_clock(n) or n in labels or counts_rows(n, c))}
    lengths = {n: len(c) for n, c in columns.items()}
    if not lengths or not max(lengths.values()):
        raise ValueError(f"a frame must hold columns of numbers, got {', '.join(everything)[:200] or 'nothing'}")
    if len(set(lengths.values())) > 1:
        raise ValueError(f"columns must have one length, got {', '.join(f'{n}: {k}' for n, k in lengths.items())}")
    return columns


def counts_rows(name: str, column: Column) -> bool:
    """Whether it does."""
    if name.lower() not in COUNTERS or column.ndim != 1 or len(column) < 2:
        return False
    steps = np.diff(column.astype(np.float64))
    return bool((steps >= 1).all() and (steps == np.rint(steps)).all() and np.median(steps) == 1)


def _alike(dt: float, other: float) -> bool:
    return abs(dt / other - 1) <= RATE_TOLERANCE


def bare_name(column: str) -> str:
    """What a column is called without its unit."""
    found = _UNIT.fullmatch(column)
    return found["name"] if found else column


def unit_of(column: str) -> str:
    """The unit behind a name; empty where there is none."""
    found = _UNIT.fullmatch(column)
    return found["unit"] if found else ""


def _without_units(columns: Mapping[str, Column]) -> tuple[dict[str, Column], dict[str, str]]:
    """Columns by their bare names, and the unit of each that says one."""
    bare, units = {}, {}
    for name, column in columns.items():
        found, short = _UNIT.fullmatch(name), bare_name(name)
        if short in bare:
            raise ValueError(f"columns must have different names, got {short!r} twice")
        bare[short] = column
        if found:
            units[short] = found["unit"]
    return bare, units


def _signals(columns: Mapping[str, Column]) -> list[Signal]:
    """Every number of a row; columns that differ in a number only are elements of one channel."""
    split = {name: _ELEMENT.fullmatch(name) for name, column in columns.items() if column.ndim == 1}
    stems = Counter(found["stem"] for found in split.values() if found)
    made = []
    for name, column in columns.items():
        found = split.get(name)
        if column.ndim == 2:
            made += [Signal(f"{name}[{k}]", name, str(k), column[:, k]) for k in range(column.shape[1])]
        elif found and (found["named"] or stems[found["stem"]] > 1) and found["stem"] not in columns:
            made.append(Signal(name, found["stem"], found["named"] or found["number"], column))
        else:
            made.append(Signal(name, name, "", column))
    return made


def _chosen(signals: Sequence[Signal], patterns: str | Sequence[str]) -> list[Signal]:
    """Those that go by one of the patterns, in the order of the table. Raises ValueError where one finds nothing."""
    asked = [patterns] if isinstance(patterns, str) else list(patterns)
    for pattern in asked:
        if not any(s.goes_by(pattern) for s in signals):
            columns = ", ".join(s.column for s in signals) or "none"
            raise ValueError(f"no column of these channels is called {pattern!r}; there are: {columns}")
    return [s for s in signals if any(s.goes_by(pattern) for pattern in asked)]


def _renamed(channel: str, signals: Sequence[Signal]) -> list[Signal]:
    """As elements of this channel."""
    return [s._replace(channel=channel, element=s.column if len(signals) > 1 else "") for s in signals]


def _channel(name: str, signals: Sequence[Signal], commanded: set[str]) -> Channel:
    elements = tuple(s.element for s in signals)
    group = MOTOR if signals[0].column in commanded else name
    units = {s.unit for s in signals if s.unit}
    if len(units) > 1:
        raise ValueError(f"channel {name!r} is of several units: {', '.join(sorted(units))}")
    noise = 0.0 if group == MOTOR else float(np.median([noise_of(s.values) for s in signals]))
    named = elements if any(elements) else ()
    return Channel(name, len(signals), next(iter(units), "1"), noise, group, named)


def _read_by(spec: StreamSpec, signals: Sequence[Signal], dt: float | None) -> NDArray[np.float32]:
    """The rows (T, D) as a memory of this spec reads them; what else the table holds is left out."""
    if dt is not None and not _alike(dt, spec.dt):
        raise ValueError(f"the memory reads {1 / spec.dt:.4g} rows a second, these come at {1 / dt:.4g}")
    # joint_0 is joint[0] too, though it may be the only one here.
    units = {label: c.unit for c in spec.channels for label in c.labels}
    signals = [_in_unit(s, units.get(s.column, units.get(label_of(s.column), "1"))) for s in signals]
    known = {label_of(s.column): s.values for s in signals} | {s.column: s.values for s in signals}
    missing = [label for label in spec.labels if label not in known]
    if missing:
        raise ValueError(f"the memory reads channels that are not there: {', '.join(missing)}")
    return np.column_stack([known[label] for label in spec.labels]).astype(np.float32)


def _in_unit(signal: Signal, unit: str) -> Signal:
    """In the unit that is read. Raises ValueError where there is no way from the one to the other."""
    if not signal.unit or unit in ("1", signal.unit):
        return signal
    factor = ratio(signal.unit, unit)
    if factor is None:
        raise ValueError(f"{signal.column} is in {signal.unit}, and the memory reads {unit}")
    return signal._replace(values=signal.values * factor, unit=unit)
