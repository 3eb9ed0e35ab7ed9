"""Turn the columns of a log into the channels of a stream.

A column is a channel of its own. Columns that differ in a number only, ``joint[0], joint[1]`` or ``joint_0, joint_1``,
are the elements of one channel, and so are the columns of a two-dimensional array. Each channel is a group: it is
predicted from the others. A column called ``action`` is a command. A unit may stand behind a name, ``joint_0 [rad]``.
Clocks, counters of rows and labels are no channels (``asm_gym.data.names``); the clock puts rows where they belong in
time (``asm_gym.data.clock``).
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from fnmatch import fnmatchcase
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from asm_gym.data.arrays import as_array
from asm_gym.data.clock import clock_among, distinct, evenly, period
from asm_gym.data.names import ELEMENT, label_of, role_of
from asm_gym.data.reader_notes import note
from asm_gym.data.units import bare_name, factor, unit_of
from asm_gym.readings import noise_of
from asm_gym.spec import MOTOR, Channel, StreamSpec
from asm_gym.validation import check_number, short_repr

Column = NDArray[Any]

Patterns = str | Sequence[str]
Choice = StreamSpec | Mapping[str, Patterns] | Sequence[str]
"""Which columns are read, and what they are called."""

NORMAL = ("", "0", "false", "no", "none", "normal", "nominal", "ok", "good", "healthy", "nan")
"""Words of a label that say that nothing is wrong."""

RESAMPLED = 1.5
"""A log with a clock is read at another rate, up to so many times its own or as much slower."""

SLOWEST = 1e-6
"""The least rate of a log [Hz]: a row in eleven days."""

RATE_TOLERANCE = 0.01
"""How far a log's rate may be off that of the memory which reads it, as a share."""

_FAULTS = "\0faults"
"""Name of the labels among columns that are put in time; no table calls a column so."""


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

    def matches(self, pattern: str) -> bool:
        """Tell whether its column or its channel is called so."""
        return any(name == pattern or fnmatchcase(name, pattern) for name in (self.column, self.channel))


class Recorded(NamedTuple):
    """The episode in a table."""

    stream: NDArray[np.float32]  # (T, D)
    spec: StreamSpec
    faults: NDArray[np.bool_]  # (T,) where a label says that something is wrong; (0,) where the table has no label


def read_recorded(
    frame: Any,
    channels: Choice | None = None,
    rate: float | None = None,
    action: Sequence[str] = (),
    labels: Sequence[str] = (),
) -> Recorded:
    """Return the rows of a table, their channels, and which are labelled as faulty.

    The arguments, and what is refused, are those of ``Episode.from_table``.
    """
    table = _columns(frame)
    spec = channels if isinstance(channels, StreamSpec) else None
    read = set(spec.labels) | {c.name for c in spec.channels} if spec else set()
    roles = {n: "sense" if n in read else role_of(n, c, labels) for n, c in table.items()}
    marks = [_marked(c) for n, c in table.items() if roles[n] == "label"]
    faults = np.logical_or.reduce(marks) if marks else np.zeros(0, np.bool_)
    columns = {n: c for n, c in table.items() if roles[n] in ("sense", "command") and c.ndim in (1, 2)}
    _check_lengths(columns, table)
    dt = None if rate is None else 1.0 / check_number("rate", rate, low=SLOWEST)
    clock = clock_among(table)
    if clock is not None:
        times = clock.seconds(table[clock.column])
        _check_lengths({clock.column: times} | columns, table)
        kept = distinct(times)
        own = period(times[kept])
        if own is not None:
            dt = dt or _period_to_read(spec, own)
            if marks:
                columns[_FAULTS] = faults.astype(np.float64)
            columns = evenly({n: c[kept] for n, c in columns.items()}, times[kept], dt)
            if marks:
                faults = np.nan_to_num(columns.pop(_FAULTS).astype(np.float64)) > 0
    signals = _signals(columns)
    if spec is not None:
        return Recorded(_rows_of(spec, signals, dt), spec, faults)
    if dt is None:
        raise ValueError("how many rows come a second? Say the rate [Hz] of this layout, or add a column time [s]")
    return Recorded(*_described(signals, channels, dt, action), faults)


def _columns(frame: Any) -> dict[str, Column]:
    """All columns of a table by name."""
    # A dictionary has keys, an Arrow table column_names, pandas and Polars have columns.
    names = frame if isinstance(frame, Mapping) else getattr(frame, "column_names", getattr(frame, "columns", None))
    if names is None or callable(names):
        raise TypeError(f"a table must be a dictionary of columns, or a frame of them, got {short_repr(frame)}")
    if len({str(name) for name in names}) < len(list(names)):
        raise ValueError(f"columns must have different names, got {', '.join(map(str, names))}")
    return {str(name): as_array(frame[name]) for name in names}


def _marked(column: Column) -> NDArray[np.bool_]:
    """(T,) where a label says that something is wrong."""
    if column.dtype.kind in "biuf":
        return np.asarray(np.nan_to_num(column.astype(np.float64)) != 0)
    return np.array([str(cell).strip().lower() not in NORMAL for cell in column])


def _check_lengths(columns: Mapping[str, Column], table: Mapping[str, Column]) -> None:
    lengths = {n: len(c) for n, c in columns.items()}
    if not lengths or not max(lengths.values()):
        raise ValueError(f"a frame must hold columns of numbers, got {', '.join(table)[:200] or 'nothing'}")
    if len(set(lengths.values())) > 1:
        raise ValueError(f"columns must have one length, got {', '.join(f'{n}: {k}' for n, k in lengths.items())}")


def _period_to_read(spec: StreamSpec | None, own: float) -> float:
    """How far apart rows are to be [s]: as the memory reads them, where the clock can be followed that far."""
    if spec is None:
        return own
    if _alike(spec.dt, own):
        return spec.dt
    if 1 / RESAMPLED <= own / spec.dt <= RESAMPLED:
        note(f"rows that come at {1 / own:.4g} a second are read at {1 / spec.dt:.4g}, by their clock")
        return spec.dt
    return own


def _alike(dt: float, other: float) -> bool:
    return abs(dt / other - 1) <= RATE_TOLERANCE


def _signals(columns: Mapping[str, Column]) -> list[Signal]:
    """Every number of a row, under its name without a unit."""
    bare = {name: bare_name(name) for name in columns}
    for name, count in Counter(bare.values()).items():
        if count > 1:
            raise ValueError(f"columns must have different names, got {name!r} twice")
    elements = {name: ELEMENT.fullmatch(bare[name]) for name, column in columns.items() if column.ndim == 1}
    stems = Counter(found["stem"] for found in elements.values() if found)
    made = []
    for column, values in columns.items():
        name, unit, found = bare[column], unit_of(column), elements.get(column)
        if values.ndim == 2:
            made += [Signal(f"{name}[{k}]", name, str(k), values[:, k], unit) for k in range(values.shape[1])]
        elif found and (found["named"] or stems[found["stem"]] > 1) and found["stem"] not in bare.values():
            made.append(Signal(name, found["stem"], found["named"] or found["number"], values, unit))
        else:
            made.append(Signal(name, name, "", values, unit))
    return made


def _described(
    signals: list[Signal], channels: Any, dt: float, action: Sequence[str]
) -> tuple[NDArray[np.float32], StreamSpec]:
    """The rows (T, D) of the columns that are chosen, and their spec."""
    if isinstance(channels, Mapping):
        signals = [s for name, patterns in channels.items() for s in _renamed(name, _chosen(signals, patterns))]
    elif channels is not None:
        signals = _chosen(signals, channels)
    commanded = {s.column for s in _chosen(signals, action)}
    parts: dict[str, list[Signal]] = {}
    for signal in sorted(signals, key=lambda s: s.column in commanded):  # the action stands last
        parts.setdefault(signal.channel, []).append(signal)
    spec = StreamSpec(tuple(_channel(name, part, commanded) for name, part in parts.items()), dt, "table")
    return np.column_stack([s.values for part in parts.values() for s in part]).astype(np.float32), spec


def _chosen(signals: Sequence[Signal], patterns: Patterns) -> list[Signal]:
    """Those that match one of the patterns, in the order of the table. Raises ValueError where one finds nothing."""
    asked = [patterns] if isinstance(patterns, str) else list(patterns)
    for pattern in asked:
        if not any(s.matches(pattern) for s in signals):
            columns = ", ".join(s.column for s in signals) or "none"
            raise ValueError(f"no column of these channels is called {pattern!r}; there are: {columns}")
    return [s for s in signals if any(s.matches(pattern) for pattern in asked)]


def _renamed(channel: str, signals: Sequence[Signal]) -> list[Signal]:
    """As elements of this channel."""
    return [s._replace(channel=channel, element=s.column if len(signals) > 1 else "") for s in signals]


def _channel(name: str, signals: Sequence[Signal], commanded: set[str]) -> Channel:
    own = {s.column for s in signals}
    if commanded & own and own - commanded:
        raise ValueError(f"channel {name!r} is commanded in part: {', '.join(sorted(own))}")
    units = {s.unit for s in signals if s.unit}
    if len(units) > 1:
        raise ValueError(f"channel {name!r} is of several units: {', '.join(sorted(units))}")
    group = MOTOR if own & commanded else name
    noise = 0.0 if group == MOTOR else float(np.median([noise_of(s.values) for s in signals]))
    elements = tuple(s.element for s in signals)
    return Channel(name, len(signals), next(iter(units), "1"), noise, group, elements if any(elements) else ())


def _rows_of(spec: StreamSpec, signals: Sequence[Signal], dt: float | None) -> NDArray[np.float32]:
    """The rows (T, D) as a memory of this spec reads them; other columns of the table are left out."""
    if dt is not None and not _alike(dt, spec.dt):
        raise ValueError(f"the memory reads {1 / spec.dt:.4g} rows a second, these come at {1 / dt:.4g}")
    # joint_0 is joint[0] too, though it may be the only one here.
    found = {label_of(s.column): s for s in signals} | {s.column: s for s in signals}
    missing = [label for label in spec.labels if label not in found]
    if missing:
        raise ValueError(f"the memory reads channels that are not there: {', '.join(missing)}")
    read = [
        found[label].values * factor(f"{found[label].column} [{found[label].unit}]", unit)
        for label, unit in zip(spec.labels, spec.units, strict=True)
    ]
    return np.column_stack(read).astype(np.float32)
