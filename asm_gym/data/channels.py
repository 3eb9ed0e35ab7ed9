"""Turn the columns of a log into the channels of a stream.

Columns that differ in a number only, ``joint[0], joint[1]`` or ``joint_0, joint_1``, are the elements of one channel,
and so are those of a two-dimensional array; others are channels of their own. An angle that turns over is a channel of
two numbers, its sine and its cosine. What is no channel says ``asm_gym.data.columns``.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from contextlib import nullcontext, suppress
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from asm_gym.data.clock import Clock, find_clock
from asm_gym.data.columns import Column, LogLayout, decide
from asm_gym.data.names import TAU, TURN, TURNED, factor, is_command, label_of, split_unit
from asm_gym.data.reader_notes import note
from asm_gym.data.tables import Columns, laid_out
from asm_gym.data.timing import Timing, evenly, timing_of
from asm_gym.readings import noise_of
from asm_gym.spec import MOTOR, Channel, StreamSpec
from asm_gym.validation import check_number

# Words of a label that say that nothing is wrong.
NORMAL = ("", "0", "false", "no", "none", "normal", "nominal", "ok", "good", "healthy", "nan")
RESAMPLED = (
    1.5  # A log with a clock is read at another rate, up to so many times its own or as much slower
)
SLOWEST = 1e-6  # the least rate of a log [Hz]: a row in eleven days
RATE_TOLERANCE = (
    0.01  # how far a log's rate may be off that of the memory which reads it, as a share
)


class Recorded(NamedTuple):
    """The episode in a table."""

    stream: NDArray[np.float32]  # (T, D)
    spec: StreamSpec
    # (T,) where a label says that something is wrong; (0,) where the table has no label
    faults: NDArray[np.bool_]


class ColumnPlan:
    """Which columns of a source make a row of a memory's stream, and how: the same for files and for live rows.

    A channel of sine and cosine is made of the angle of that name. Raises ValueError where a column is of another unit,
    or of the ``whole`` is missing.
    """

    def __init__(self, names: Iterable[str], spec: StreamSpec, whole: bool = True) -> None:
        bare = {name: split_unit(name)[0] for name in names}
        # joint_0 is joint[0] too, though it may be the only one here.
        places = {label_of(short): name for name, short in bare.items()} | {
            short: name for name, short in bare.items()
        }
        self.codes = np.array(spec.missing)
        self.columns, self._scale, self._turned = list[str](), list[float](), list[int]()
        missing = []
        for channel in spec.channels:
            by_label = any(label in places for label in channel.labels)
            turned = channel.elements == TURNED and not by_label
            for k, label in enumerate(channel.labels):
                wanted = channel.name if turned else label
                name = places.get(wanted)
                if name is None and not by_label:
                    name = places.get(f"{channel.name}[{k}]")  # a list by its channel's name
                if name is None:
                    missing.append(wanted)
                    continue
                scale = factor(*split_unit(name), channel.unit)
                self.columns.append(name)
                self._scale.append(scale * TAU / TURN[channel.unit] if turned else scale)
                self._turned.append(1 + k if turned else 0)
        if missing and whole:
            names = ", ".join(dict.fromkeys(missing))
            raise ValueError(f"the memory reads channels that are not there: {names}")

    def row(self, values: Mapping[str, Any]) -> NDArray[np.float64]:
        """Return the numbers (D,) of a row by the names of its columns; NaN of those that it lacks."""
        found = (values.get(name) for name in self.columns)
        return self._made(
            np.array([math.nan if value is None else value for value in found], np.float64)
        )

    def rows(self, table: Mapping[str, NDArray[Any]]) -> NDArray[np.float64]:
        """Return the rows (T, D) of a table."""
        return self._made(
            np.column_stack([table[name] for name in self.columns]).astype(np.float64)
        )

    def _made(self, numbers: NDArray[np.float64]) -> NDArray[np.float64]:
        """The numbers (..., D) of a stream of those of the columns."""
        if self.codes.size:
            numbers = np.where(np.isin(numbers, self.codes), np.nan, numbers)
        numbers = numbers * self._scale
        for k, turned in enumerate(self._turned):
            if turned:
                numbers[..., k] = (np.sin, np.cos)[turned - 1](numbers[..., k])
        return numbers


def read_recorded(frame: Any, layout: LogLayout, others: Sequence[Columns] = ()) -> Recorded:
    """Return the rows of a table, their channels, and which are labelled as faulty; as ``Episode.from_table`` does.

    ``others`` are tables of the same log or folder: what a column is, all of them tell.
    """
    table = laid_out(frame)
    clock = clock_of(table, layout)
    columns = [] if layout.spec else decide([table, *others], layout, clock)
    spec = layout.spec or described(columns, layout)
    plan = ColumnPlan(table, spec)
    rows = plan.rows(table)
    labels = [
        v for n, v in table.items() if n not in plan.columns and layout.marks(split_unit(n)[0], v)
    ]
    faults = (
        np.logical_or.reduce([_marked(values) for values in labels])
        if labels
        else np.zeros(0, np.bool_)
    )
    timing = None
    with suppress(ValueError) if layout.rate is not None else nullcontext():
        timing = None if clock is None else timing_of(table, clock)
    dt, by_clock = _period(timing, layout)
    if by_clock and timing is not None:
        rows = np.column_stack([rows, faults] if labels else [rows])
        rows = evenly(rows[timing.kept], timing.times, dt)
        if labels:
            rows, faults = rows[:, :-1], np.nan_to_num(rows[:, -1]) > 0
    if layout.spec is not None and abs(dt / spec.dt - 1) > RATE_TOLERANCE:
        raise ValueError(
            f"the memory reads {1 / spec.dt:.4g} rows a second, these come at {1 / dt:.4g}"
        )
    if layout.spec is None:
        spec = with_noise(replace(spec, dt=dt), np.array([noise_of(x) for x in rows.T]))
        _note_columns(columns)
    return Recorded(rows.astype(np.float32), spec, faults)


def clock_of(table: Columns, layout: LogLayout) -> Clock | None:
    """Return the clock of a table; None where there is none, or none can be read and ``rate`` is said."""
    try:
        return find_clock(table, layout.clock, layout.spec.dt if layout.spec else None)
    except ValueError:
        if layout.rate is None or layout.clock:
            raise
        return None


def _period(timing: Timing | None, layout: LogLayout) -> tuple[float, bool]:
    """How far apart rows are to be [s], and whether their clock tells where each belongs."""
    own = timing.dt if timing is not None else None
    said = 1.0 / check_number("rate", layout.rate, low=SLOWEST) if layout.rate is not None else None
    meant = 1.0 / layout.nominal if layout.nominal is not None else None
    if own is None or timing is None:
        if (known := said or meant) is not None:
            return known, False
        raise ValueError(
            "how many rows come a second? Say the rate [Hz] of this layout (--rate), or name or add a column of times "
            "(--clock)"
        )
    if said is None and meant is not None and abs(own / meant - 1) <= RATE_TOLERANCE:
        return meant, True
    dt = said or (layout.spec.dt if layout.spec is not None else own)
    if 1 / RESAMPLED <= own / dt <= RESAMPLED:
        if abs(dt / own - 1) > RATE_TOLERANCE:
            note(
                f"rows that come at {1 / own:.4g} a second are read at {1 / dt:.4g}, by their clock"
            )
        return dt, True
    if said is not None:
        clock = timing.clock.name
        note(
            f"the clock {clock!r} says {1 / own:.4g} rows a second: by --rate {layout.rate:g} it is not read"
        )
        return said, False
    return own, True


def _marked(values: NDArray[Any]) -> NDArray[np.bool_]:
    """(T,) where a label says that something is wrong."""
    if values.dtype.kind in "biuf":
        return np.asarray(np.nan_to_num(values.astype(np.float64)) != 0)
    return np.array([str(cell).strip().lower() not in NORMAL for cell in values])


def described(columns: Sequence[Column], layout: LogLayout) -> StreamSpec:
    """Return the spec of the columns that are read; its period is 1 s, and its noise 0."""
    for column in columns:
        if column.role in ("mixed", "double"):
            raise ValueError(f"{column.name} {column.why}")
    for pattern in layout.channels:
        _chosen(columns, pattern)
    used = [c for c in columns if c.read]
    if not used:
        why = "; ".join(f"{c.name} {c.why}" for c in columns)[:300]
        raise ValueError(f"a frame must hold columns of numbers, got {why or 'nothing'}")
    for name, count in Counter(c.name for c in used).items():
        if count > 1:
            raise ValueError(f"columns must have different names, got {name!r} twice")
    commanded = {c.name for pattern in layout.action for c in _chosen(used, pattern)}
    if layout.by_name and not layout.action:
        sensed = {c.channel for c in used if not is_command(c.name)}
        commanded = {c.name for c in used if c.channel not in sensed} if sensed else set()
    parts: dict[str, list[Column]] = {}
    for column in sorted(used, key=lambda c: c.name in commanded):  # the action stands last
        parts.setdefault(column.name if column.turn else column.channel, []).append(column)
    channels = tuple(_channel(name, part, commanded) for name, part in parts.items())
    return StreamSpec(
        channels, 1.0, "table", tuple(sorted({c.code for c in used if not math.isnan(c.code)}))
    )


def _chosen(columns: Sequence[Column], pattern: str) -> list[Column]:
    """Those that match a pattern. Raises ValueError where none does."""
    found = [c for c in columns if c.matches(pattern)]
    if not found:
        names = ", ".join(c.name for c in columns) or "none"
        raise ValueError(f"no column of these channels is called {pattern!r}; there are: {names}")
    return found


def _channel(name: str, columns: Sequence[Column], commanded: set[str]) -> Channel:
    own, units = {c.name for c in columns}, {c.unit for c in columns if c.unit}
    if commanded & own and own - commanded:
        raise ValueError(f"channel {name!r} is commanded in part: {', '.join(sorted(own))}")
    if len(units) > 1:
        raise ValueError(f"channel {name!r} is of several units: {', '.join(sorted(units))}")
    group = MOTOR if own & commanded else columns[0].channel
    if columns[0].turn:
        return Channel(name, 2, "rad" if columns[0].turn < 7 else "deg", 0.0, group, TURNED)
    elements = tuple(c.element for c in columns)
    return Channel(
        name, len(columns), next(iter(units), "1"), 0.0, group, elements if any(elements) else ()
    )


def with_noise(spec: StreamSpec, noise: NDArray[np.float64]) -> StreamSpec:
    """Return a spec whose sensed channels have the median of the white noise (..., D) of their numbers."""
    channels = [
        channel
        if channel.group == MOTOR
        else replace(channel, noise=float(np.median(noise[..., place])))
        for channel, place in zip(spec.channels, spec.slices.values(), strict=True)
    ]
    return replace(spec, channels=tuple(channels))


def _note_columns(columns: Sequence[Column]) -> None:
    """Say what is left out, and why."""
    for role in dict.fromkeys(
        c.role for c in columns if not c.read and c.role not in ("clock", "ignored")
    ):
        same = [c for c in columns if c.role == role]
        names = ", ".join(c.name for c in same[:6]) + (
            f" and {len(same) - 6} others" if len(same) > 6 else ""
        )
        note(f"left out: {names}: {same[0].why}")
    for column in columns:
        if column.read and column.why:
            note(f"{column.name}: {column.why}")
