"""Turn the columns of a log into the channels of a stream.

Columns that differ in a number only, ``joint[0], joint[1]`` or ``joint_0, joint_1``, are the elements of one channel,
and so are those of a two-dimensional array; others are channels of their own. Clocks, counters of rows, labels and
words are no channels (``asm_gym.data.names``).
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Mapping, Sequence
from fnmatch import fnmatchcase
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from asm_gym.data.clock import evenly, timing_of
from asm_gym.data.names import ELEMENT, factor, label_of, role_of, split_unit
from asm_gym.data.reader_notes import note
from asm_gym.readings import noise_of
from asm_gym.spec import MOTOR, Channel, StreamSpec
from asm_gym.validation import check_number, short_repr

# Words of a label that say that nothing is wrong.
NORMAL = ("", "0", "false", "no", "none", "normal", "nominal", "ok", "good", "healthy", "nan")
RESAMPLED = 1.5  # A log with a clock is read at another rate, up to so many times its own or as much slower
SLOWEST = 1e-6  # the least rate of a log [Hz]: a row in eleven days
RATE_TOLERANCE = 0.01  # how far a log's rate may be off that of the memory which reads it, as a share


class Column(NamedTuple):
    """A column of a log, and what is done with it."""

    name: str  # without the unit
    unit: str  # empty where the log does not say
    role: str  # sense, command, clock, counter, label or words
    channel: str  # which it belongs to
    element: str  # of the channel; empty where it is the only one
    values: NDArray[Any]  # (T,)

    @property
    def read(self) -> bool:
        """Whether it is part of the stream."""
        return self.role in ("sense", "command")

    def matches(self, pattern: str) -> bool:
        """Tell whether it or its channel is called so."""
        return any(name == pattern or fnmatchcase(name, pattern) for name in (self.name, self.channel))


class Recorded(NamedTuple):
    """The episode in a table."""

    stream: NDArray[np.float32]  # (T, D)
    spec: StreamSpec
    faults: NDArray[np.bool_]  # (T,) where a label says that something is wrong; (0,) where the table has no label


def read_recorded(
    frame: Any,
    channels: StreamSpec | Sequence[str] | None = None,
    rate: float | None = None,
    action: Sequence[str] = (),
    labels: Sequence[str] = (),
) -> Recorded:
    """Return the rows of a table, their channels, and which are labelled as faulty; as ``Episode.from_table`` does."""
    spec = channels if isinstance(channels, StreamSpec) else None
    table = table_of(frame)
    columns = columns_of(table, labels, {*spec.labels, *(c.name for c in spec.channels)} if spec else ())
    used = [c for c in columns if c.read]
    dt = None if rate is None else 1.0 / check_number("rate", rate, low=SLOWEST)
    timing = timing_of(table)
    lengths = {c.name: len(c.values) for c in columns if c.read or c.role == "label"}
    if not used or not max(lengths.values()):
        raise ValueError(f"a frame must hold columns of numbers, got {', '.join(table)[:200] or 'nothing'}")
    if timing is not None:
        lengths[timing.clock.column] = len(table[timing.clock.column])
    if len(set(lengths.values())) > 1:
        raise ValueError(f"columns must have one length, got {', '.join(f'{n}: {k}' for n, k in lengths.items())}")
    marks = [_marked(c.values) for c in columns if c.role == "label"]
    faults = np.logical_or.reduce(marks) if marks else np.zeros(0, np.bool_)
    if timing is not None and timing.dt is not None:
        dt = dt or _period_to_read(spec, timing.dt)
        rows = np.column_stack([c.values for c in used] + [faults] * bool(marks)).astype(np.float64)  # (T, D)
        rows = evenly(rows[timing.kept], timing.times, dt)
        used = [c._replace(values=values) for c, values in zip(used, rows.T, strict=False)]
        if marks:
            faults = np.nan_to_num(rows[:, -1]) > 0
    if isinstance(channels, StreamSpec):
        return Recorded(_rows_of(channels, used, dt), channels, faults)
    if dt is None:
        raise ValueError("how many rows come a second? Say the rate [Hz] of this layout, or add a column time [s]")
    return Recorded(*_described(used, channels, dt, action), faults)


def table_of(frame: Any) -> dict[str, NDArray[Any]]:
    """Return the columns, (T,) or (T, k), of a dictionary, a frame of pandas or Polars, or an Arrow table by name."""
    names = frame if isinstance(frame, Mapping) else getattr(frame, "column_names", getattr(frame, "columns", None))
    if names is None or callable(names):
        raise TypeError(f"a table must be a dictionary of columns, or a frame of them, got {short_repr(frame)}")
    if len({str(name) for name in names}) < len(list(names)):
        raise ValueError(f"columns must have different names, got {', '.join(map(str, names))}")
    return {str(name): as_array(frame[name]) for name in names}


def as_array(column: Any) -> NDArray[Any]:
    """Return an array (T,) or, of lists of one length, (T, k)."""
    array = np.asarray(column)
    if array.dtype == object and len(array) and all(isinstance(row, list | tuple | np.ndarray) for row in array):
        return np.array(array.tolist()) if len({len(row) for row in array}) == 1 else array
    return array


def columns_of(
    table: Mapping[str, NDArray[Any]], labels: Sequence[str] = (), senses: Collection[str] = ()
) -> list[Column]:
    """Decide for every column (T,) or (T, k) of a table what is done with it; k columns are made of the latter.

    ``labels`` are patterns of the columns that say what is wrong, beside those that are called so; ``senses`` are names
    of columns that are senses, whatever they are called.
    """
    parts = {name: values.T if values.ndim == 2 else [values] for name, values in table.items() if values.ndim < 3}
    roles = {n: "sense" if n in senses else role_of(n, np.asarray(p[0]), labels) for n, p in parts.items() if len(p)}
    bare = {name: split_unit(name)[0] for name, role in roles.items() if role in ("sense", "command")}
    for name, count in Counter(bare.values()).items():
        if count > 1:
            raise ValueError(f"columns must have different names, got {name!r} twice")
    elements = {name: ELEMENT.fullmatch(short) for name, short in bare.items() if table[name].ndim == 1}
    stems = Counter(found["stem"] for found in elements.values() if found)
    made = []
    for header, role in roles.items():
        (name, unit), found = split_unit(header), elements.get(header)
        if table[header].ndim == 2:
            made += [Column(f"{name}[{k}]", unit, role, name, str(k), v) for k, v in enumerate(parts[header])]
        elif found and (found["named"] or stems[found["stem"]] > 1) and found["stem"] not in bare.values():
            element = found["named"] or found["number"]
            made.append(Column(name, unit, role, found["stem"], element, table[header]))
        else:
            made.append(Column(name, unit, role, name, "", table[header]))
    return made


def _marked(values: NDArray[Any]) -> NDArray[np.bool_]:
    """(T,) where a label says that something is wrong."""
    if values.dtype.kind in "biuf":
        return np.asarray(np.nan_to_num(values.astype(np.float64)) != 0)
    return np.array([str(cell).strip().lower() not in NORMAL for cell in values])


def _period_to_read(spec: StreamSpec | None, own: float) -> float:
    """How far apart rows are to be [s]: as the memory reads them, where the clock can be followed that far."""
    if spec is None or not 1 / RESAMPLED <= own / spec.dt <= RESAMPLED:
        return own
    if abs(spec.dt / own - 1) > RATE_TOLERANCE:
        note(f"rows that come at {1 / own:.4g} a second are read at {1 / spec.dt:.4g}, by their clock")
    return spec.dt


def _described(
    columns: list[Column], channels: Sequence[str] | None, dt: float, action: Sequence[str]
) -> tuple[NDArray[np.float32], StreamSpec]:
    """The rows (T, D) of the columns that are chosen, and their spec."""
    columns = columns if channels is None else _chosen(columns, channels)
    commanded = {c.name for c in _chosen(columns, action)}
    parts: dict[str, list[Column]] = {}
    for column in sorted(columns, key=lambda c: c.name in commanded):  # the action stands last
        parts.setdefault(column.channel, []).append(column)
    spec = StreamSpec(tuple(_channel(name, part, commanded) for name, part in parts.items()), dt, "table")
    return np.column_stack([c.values for part in parts.values() for c in part]).astype(np.float32), spec


def _chosen(columns: Sequence[Column], patterns: Sequence[str]) -> list[Column]:
    """Those that match one of the patterns, in the order of the table. Raises ValueError where one finds nothing."""
    for pattern in patterns:
        if not any(c.matches(pattern) for c in columns):
            names = ", ".join(c.name for c in columns) or "none"
            raise ValueError(f"no column of these channels is called {pattern!r}; there are: {names}")
    return [c for c in columns if any(c.matches(pattern) for pattern in patterns)]


def _channel(name: str, columns: Sequence[Column], commanded: set[str]) -> Channel:
    own = {c.name for c in columns}
    if commanded & own and own - commanded:
        raise ValueError(f"channel {name!r} is commanded in part: {', '.join(sorted(own))}")
    units = {c.unit for c in columns if c.unit}
    if len(units) > 1:
        raise ValueError(f"channel {name!r} is of several units: {', '.join(sorted(units))}")
    group = MOTOR if own & commanded else name
    noise = 0.0 if group == MOTOR else float(np.median([noise_of(c.values) for c in columns]))
    elements = tuple(c.element for c in columns)
    return Channel(name, len(columns), next(iter(units), "1"), noise, group, elements if any(elements) else ())


def _rows_of(spec: StreamSpec, columns: Sequence[Column], dt: float | None) -> NDArray[np.float32]:
    """The rows (T, D) as a memory of this spec reads them; other columns of the table are left out."""
    if dt is not None and abs(dt / spec.dt - 1) > RATE_TOLERANCE:
        raise ValueError(f"the memory reads {1 / spec.dt:.4g} rows a second, these come at {1 / dt:.4g}")
    # joint_0 is joint[0] too, though it may be the only one here.
    found = {label_of(c.name): c for c in columns} | {c.name: c for c in columns}
    missing = [label for label in spec.labels if label not in found]
    if missing:
        raise ValueError(f"the memory reads channels that are not there: {', '.join(missing)}")
    chosen = zip((found[label] for label in spec.labels), spec.units, strict=True)
    return np.column_stack([c.values * factor(c.name, c.unit, unit) for c, unit in chosen]).astype(np.float32)
