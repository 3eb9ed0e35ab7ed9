"""Decide for every column of a log what it is, once, by its name and by how it behaves in the first recordings.

    label       by its name and whole numbers or       command   by its name
                words, or --label
    clock       the chosen one, and others             copy      equals another column
    constant    never moves, and stands alone          empty     holds no number
    words       text; with some numbers it is refused  ignored   --ignore, or not among --channels
    counter     whole numbers that rise by one and the same step, but for lost rows and where they begin anew; or
                max |x - (a + b t)| <= PACE range(x), and x never falls: a second clock; or -x does so
    sense       all others; with a code for missing data: a number at an end of the range that repeats, CODE_APART
                ranges away from all others, and large, or mostly in single rows; as an angle that turns over:
                |x_i - x_{i-1} ∓ P| < P/4 at every jump, and x reaches both ends of a turn of P = 360 or 2π

``--channels`` brings back what was set aside by its behaviour.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from asm_gym.data.clock import Clock, clocks_among
from asm_gym.data.names import (
    COUNTERS,
    SENSE,
    TAU,
    TURN,
    UNITS,
    element_of,
    is_command,
    is_label,
    split_unit,
)
from asm_gym.data.tables import is_numeric
from asm_gym.data.text import DOUBLED, numbers_in
from asm_gym.spec import StreamSpec

Floats = NDArray[np.float64]

READ = ("sense", "command")
# roles by behaviour that the elements of a channel do not get alone
KEPT_TOGETHER = (
    "constant",
    "counter",
)
BACK = "; name it among --channels to read it"
MIXED = 0.5  # share of numbers from which on a column with words is one of numbers

FEWEST = 8  # rows from which on a column is judged
STEADY = 0.9  # share of steps that must be the usual one in a counter
PACE = 2e-3  # how far a second clock is off a straight line, as a share of its range
CODE_APART = 5.0  # how many ranges of all others a code for missing data is away from them
CODES_AT_MOST = 0.5  # share of rows that may hold one
LEAST_CODE = 99.0  # a code is at least so large,
SINGLE = 0.8  # or at least this share of it stands in single rows


@dataclass(frozen=True)
class LogLayout:
    """How to read logs; most are arguments of ``Episode.from_table``, and options of the commands."""

    spec: StreamSpec | None = None  # of the memory that is to read them
    rate: float | None = None  # rows a second [Hz], whatever the clock says
    action: Sequence[str] = ()  # patterns of the columns that were commanded
    channels: Sequence[str] = ()  # patterns of the columns that are read; all where empty
    # patterns of the columns that say what is wrong, beside those that are called so
    labels: Sequence[str] = ()
    columns: Sequence[str] = ()  # names of the columns of files without a header
    by_name: bool = False  # without an ``action``, columns that are called so were commanded
    ignore: Sequence[str] = ()  # patterns of the columns that are left out
    clock: str = ""  # the column of times, perhaps with a unit behind it; by default the steadiest
    like: Path | None = (
        None  # of a folder only logs with the columns and the rate of this one are read
    )
    nominal: float | None = (
        None  # rows a second that somebody meant them to have, where no clock says it [Hz]
    )

    def marks(self, name: str, values: NDArray[Any]) -> bool:
        """Tell whether a column says which rows are faulty; one of fractions measures something."""
        if any(fnmatchcase(name, pattern) for pattern in self.ignore):
            return False
        whole = not is_numeric(values) or bool((known(values) == np.rint(known(values))).all())
        return (is_label(name) and whole) or any(
            fnmatchcase(name, pattern) for pattern in self.labels
        )


class Column(NamedTuple):
    """A column of a log, and what is done with it."""

    name: str  # without the unit
    unit: str  # empty where the log does not say
    role: str
    channel: str  # which it belongs to
    element: str  # of the channel; empty where it is the only one
    values: NDArray[Any]  # (T,)
    why: str = ""  # it has this role, and the option that changes that
    turn: float = 0.0  # a whole turn of an angle that turns over; 0 of others
    code: float = math.nan  # the number that stands for missing data

    @property
    def read(self) -> bool:
        """Whether it is part of the stream."""
        return self.role in READ

    def matches(self, pattern: str) -> bool:
        """Tell whether it or its channel is called so."""
        return any(
            name == pattern or fnmatchcase(name, pattern) for name in (self.name, self.channel)
        )


def decide(
    tables: Sequence[Mapping[str, NDArray[Any]]], layout: LogLayout, clock: Clock | None
) -> list[Column]:
    """Return what is done with each column of the first of some tables, by all of them; ``clock`` is that of all."""
    table = tables[0]
    times = [_times(each, clock) for each in tables]
    named = _named(table)
    stamps = {name for other in clocks_among(table) for name in other.columns}
    made, seen = list[Column](), dict[tuple[int, ...], str]()
    for header, column in named.items():
        every = [t[header] for t in tables if header in t and is_numeric(t[header])]
        role, why = _by_name(header, column, layout, clock, header in stamps)
        chosen = any(column.matches(p) for p in (*layout.channels, *layout.action))
        if role == "sense" and not chosen:
            role, why = _by_behaviour(column, every, times)
            cells = tuple(hash(np.ascontiguousarray(v, np.float64).tobytes()) for v in every)
            same = seen.setdefault(cells, column.name)
            if (
                role == "sense"
                and same != column.name
                and is_command(same) == is_command(column.name)
            ):
                role, why = "copy", f"equals {same}{BACK}"
        if role == "sense":
            role = "command" if is_command(column.name) else "sense"
            turn = max(turn_of(values, column.unit) for values in every)
            code = next((c for values in every if not math.isnan(c := code_of(values))), math.nan)
            said = [f"turns over at {turn:g}: read as its sine and cosine"] if turn else []
            said += [] if math.isnan(code) else [f"{code:g} is taken for missing data"]
            column, why = column._replace(turn=turn, code=code), "; ".join(said)
        made.append(column._replace(role=role, why=why))
    return _restored(made)


def _times(table: Mapping[str, NDArray[Any]], clock: Clock | None) -> NDArray[np.float64]:
    """When the rows of a table were sensed (T,) [s]; their numbers where no clock tells."""
    if clock is not None:
        with suppress(ValueError, KeyError):
            return clock.seconds(table)
    return np.arange(max(map(len, table.values()), default=0), dtype=np.float64)


def _named(table: Mapping[str, NDArray[Any]]) -> dict[str, Column]:
    """The columns by their headers, with unit, channel and element."""
    bare = {header: split_unit(header) for header in table}
    found = {
        header: element_of(name) for header, (name, _) in bare.items() if is_numeric(table[header])
    }
    stems = Counter(element.channel for element in found.values() if element)
    whole = {name for name, _ in bare.values()}
    made = {}
    for header, (name, unit) in bare.items():
        element = found.get(header)
        grouped = (
            element
            and (element.named or stems[element.channel] > 1)
            and element.channel not in whole
        )
        channel, part = (element.channel, element.name) if element and grouped else (name, "")
        made[header] = Column(name, unit, "sense", channel, part, table[header])
    return made


def _by_name(
    header: str, column: Column, layout: LogLayout, clock: Clock | None, is_stamp: bool
) -> tuple[str, str]:
    """The role of a column by its name, by the options, and by the kind of its cells; else a sense."""
    asked_for = any(column.matches(pattern) for pattern in layout.channels)
    left_out = any(column.matches(pattern) or header == pattern for pattern in layout.ignore)
    other = header.partition(DOUBLED)[0]
    rules = (
        (left_out, "ignored", "by --ignore"),
        (clock is not None and header in clock.columns, "clock", "tells the rate"),
        (
            layout.marks(column.name, column.values) and column.name not in layout.channels,
            "label",
            f"rows it marks are not learned from{BACK}",
        ),
        (bool(layout.channels) and not asked_for, "ignored", "not among --channels"),
        (is_stamp and not layout.channels, "clock", f"another clock{BACK}"),
        (
            DOUBLED in header,
            "double",
            f"differs from another column of the name {other!r}; --ignore '{header}' leaves it out",
        ),
        (
            is_numeric(column.values) and not np.isfinite(column.values).any(),
            "empty",
            "holds no number",
        ),
    )
    role, why = next(((role, why) for holds, role, why in rules if holds), ("sense", ""))
    return _words(column) if role == "sense" and not is_numeric(column.values) else (role, why)


def _words(column: Column) -> tuple[str, str]:
    """Whether a column of text holds words, or numbers with words among them."""
    if column.values.dtype.kind in "Mm":
        return "clock", f"another clock{BACK}"
    empty = np.array([not str(cell).strip() for cell in column.values], np.bool_)
    numbers = np.isfinite(numbers_in(column.values)) | empty
    if empty.all():
        return "empty", "holds nothing"
    if numbers[~empty].mean() < MIXED:
        return "words", "holds words"
    row = int(np.argmin(numbers))
    what = f"must hold numbers, got {str(column.values[row])[:40]!r} in row {row + 1}"
    return "mixed", f"{what}; --ignore '{column.name}' leaves it out"


def _by_behaviour(
    column: Column, every: Sequence[NDArray[Any]], times: Sequence[NDArray[np.float64]]
) -> tuple[str, str]:
    """The role of a column of numbers by what it does in every table."""
    if all(map(is_constant, every)):
        return "constant", f"never moves{BACK}"
    if column.unit in UNITS or SENSE.fullmatch(column.name):
        return "sense", ""
    moving = [values for values in every if not is_constant(values)]
    fewest = 2 if column.name.lower() in COUNTERS else FEWEST
    for way, sign in (("rises", 1.0), ("falls", -1.0)):
        going = [sign * values for values in moving]
        if all(
            counts(v, fewest) or any(len(v) == len(t) and follows(v, t) for t in times)
            for v in going
        ):
            return "counter", f"{way} by a constant{BACK}"
    return "sense", ""


def _restored(columns: list[Column]) -> list[Column]:
    """The columns, those of a channel kept together: one joint that stands, or turns steadily, is none the less one."""
    moving = {c.channel for c in columns if c.read and c.element}
    alone = not any(c.read for c in columns)  # nothing else is left
    return [
        c._replace(
            role="command" if is_command(c.name) else "sense",
            why="" if alone else f"{c.why.removesuffix(BACK)}, beside others that do not",
        )
        if c.role in KEPT_TOGETHER and (alone or c.channel in moving)
        else c
        for c in columns
    ]


def known(values: NDArray[Any]) -> Floats:
    """Return the numbers of a column that are finite."""
    return np.asarray(values[np.isfinite(values)], np.float64)


def is_constant(values: NDArray[Any]) -> bool:
    """Tell whether a column holds numbers, and never moves."""
    found = known(values)
    return len(found) > 0 and bool((found == found[0]).all())


def counts(values: NDArray[Any], fewest: int = FEWEST) -> bool:
    """Tell whether a column (T,) counts: rows, messages, ticks of a controller; it may lose some, and begin anew."""
    found = known(values)
    if len(found) < fewest or len(found) < len(values) or (found != np.rint(found)).any():
        return False
    steps = np.diff(found)
    if (
        len(rises := steps[steps != 0]) > 1
        and len(rises) < len(steps)
        and (rises == rises[0]).all()
        and rises[0] > 0
    ):
        return len(np.unique(found)) > 2  # an index, of episodes or of cycles
    usual = float(np.median(steps))
    if usual <= 0 or np.mean(steps == usual) < STEADY:
        return False
    forward = steps[steps > 0]
    anew = np.flatnonzero(steps < 0)  # it wraps, or begins again: near its least number
    return bool(
        (forward % usual == 0).all()
        and (found[anew + 1] <= found.min() + usual * (FEWEST + 1)).all()
    )


def follows(values: NDArray[Any], times: Floats) -> bool:
    """Tell whether a column (T,) is a second clock: it goes on as ``times`` (T,) do."""
    if len(values) < FEWEST or not np.isfinite(values).all() or not np.isfinite(times).all():
        return False
    since = values.astype(np.float64) - float(values[0])
    span = float(np.ptp(since))
    if not span or (np.diff(since) < 0).any():
        return False
    slope, offset = np.polyfit(times - times.mean(), since, 1)
    return float(np.abs(since - offset - slope * (times - times.mean())).max()) <= PACE * span


def turn_of(values: NDArray[Any], unit: str) -> float:
    """Return the length of a turn of a column (T,) that holds an angle which turns over, 360 or 2π; else 0."""
    found = known(values)
    for turn in [TURN[unit]] if unit in TURN else [] if unit else [360.0, TAU]:
        if len(found) < FEWEST or np.ptp(found) > 1.01 * turn:
            continue
        steps = np.diff(found)
        jumps = np.abs(steps) > 0.6 * turn
        ends = (-turn / 2, turn / 2) if found.min() < -0.05 * turn else (0.0, turn)
        reached = found.min() - ends[0] < 0.1 * turn and ends[1] - found.max() < 0.1 * turn
        smooth = np.abs(steps - turn * np.rint(steps / turn))
        if (
            jumps.any()
            and reached
            and len(np.unique(found)) > FEWEST
            and (smooth < 0.25 * turn).all()
        ):
            return turn
    return 0.0


def code_of(values: NDArray[Any]) -> float:
    """Return the number that stands for missing data in a column (T,), such as -99999; NaN where there is none."""
    found = known(values)
    for code in (found.min(), found.max()) if len(found) else ():
        others = found[found != code]
        often = len(found) - len(others)
        single = often >= FEWEST and np.mean(np.diff(np.flatnonzero(values == code)) > 1) >= SINGLE
        if not (abs(code) >= LEAST_CODE or single) or not 2 <= often <= CODES_AT_MOST * len(values):
            continue
        if float(np.abs(others - code).min()) > CODE_APART * float(np.ptp(others)) > 0:
            return float(code)
    return math.nan
