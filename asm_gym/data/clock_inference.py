"""Find the clock of a log by the names of its columns and by what they hold.

named      columns called time, stamp, …; two of one time, seconds and a fraction, are a pair
steadiest  of these the one whose steps differ least, if few rows repeat the stamp before
rising     else a column that rises with them, whose unit its name or its size says
unit       by the name, by the size of numbers since 1970, else by the rate of rows
"""

from __future__ import annotations

import re
from collections.abc import Collection, Iterable, Mapping
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from asm_gym.data.clock import DATE, DAY_S, NUMBER, LogClock, kind_of, numbers_of, unit_by_size
from asm_gym.data.names import CLOCK, COUNTERS, LONGER, SECONDS, is_clock, split_unit
from asm_gym.data.reader_notes import note

Floats = NDArray[np.float64]
Table = Mapping[str, NDArray[Any]]

MOST_REPEATED = 0.02  # share of rows that may have the stamp of the row before: written twice
DISAGREE = 0.01  # share by which two clocks may differ before the user is told
ALIKE = 0.2  # share by which a clock may differ from the memory that tells its unit
SLOWEST_HZ, FASTEST_HZ = 1.0, 1000.0  # plausible rates of rows, which tell a unit
LEAST_DATE = 3e4  # Excel and MATLAB count days, from 1982 on so many
UNNAMED_UNITS = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9}

_FRACTION = re.compile(
    r"(?P<stem>.*?)[._\[ ]*(?P<unit>nanosec(?:ond)?s?|nanos|nsecs?|ns|usecs?|us|micros)\]?", re.I
)
_SECONDS = ("secs", "sec", "seconds", "s")


class NamedClock(NamedTuple):
    """Columns that are called as a clock is, and the seconds in a number of each; None if unsaid."""

    columns: tuple[str, ...]
    units: tuple[float | None, ...] = (None,)


def clocks_among(names: Iterable[str]) -> list[NamedClock]:
    """Return the clocks among columns by their names; seconds and a fraction of them are one."""
    names = list(names)
    pairs = _pairs(names)
    fractions = {pair.columns[1] for pair in pairs.values()}
    clocks = []
    for name in names:
        if name in pairs:
            clocks.append(pairs[name])
        elif is_clock(name) and name not in fractions:
            clocks.append(NamedClock((name,), (unit_by_name(name),)))
    return clocks


def _pairs(names: list[str]) -> dict[str, NamedClock]:
    """Return the pairs of seconds and a fraction, by the column of seconds."""
    by_lower_name = {name.lower(): name for name in reversed(names)}
    pairs: dict[str, NamedClock] = {}
    for name in names:
        match = _FRACTION.fullmatch(name)
        if match is None:
            continue
        start, end = match.span("unit")
        unit = 1e-9 if match["unit"].lower().startswith("n") else 1e-6
        for word in _SECONDS:
            seconds = by_lower_name.get(f"{name[:start]}{word}{name[end:]}".lower())
            if seconds is not None and seconds != name and seconds not in pairs:
                pairs[seconds] = NamedClock((seconds, name), (1.0, unit))
    return pairs


def unit_by_name(name: str) -> float | None:
    """Return the seconds in a number of a clock's column, by its name; None if that says none."""
    if name.lower() == "ipoc":
        return 1e-3  # KUKA's counter of milliseconds
    match = CLOCK.fullmatch(name.strip())
    if match is not None and match["unit"]:
        return SECONDS[match["unit"].lower()]
    unit = LONGER.get(split_unit(name)[1].lower())
    return unit or SECONDS.get(name.lower().rpartition("_")[2])


def infer_clock(table: Table, wanted: str = "", dt: float | None = None) -> LogClock | None:
    """Return the clock of a table; None if it has none.

    Args:
        table: columns (T,) by name.
        wanted: the name of the clock, perhaps with a unit behind it.
        dt: period of the memory that reads the table, which tells the unit of a clock [s].

    Raises:
        ValueError: there is no such column, or no clock can be read.
    """
    if wanted:
        return resolve(clock_called(wanted, table), table, dt, "chosen by --clock")

    trouble = ""
    steady: list[tuple[float, LogClock]] = []
    coarse: list[LogClock] = []
    for named in clocks_among(table):
        try:
            clock = resolve(named, table, dt, "called as a clock is")
            repeated, jitter = _unsteadiness(clock.times(table).seconds)
        except ValueError as error:
            trouble = trouble or str(error)
            continue
        if repeated <= MOST_REPEATED:
            steady.append((jitter, clock))
        else:
            coarse.append(clock)
    if steady:
        steady.sort(key=lambda each: each[0])
        clocks = [clock for _, clock in steady]
        _note_disagreement(table, clocks)
        return clocks[0]

    rising = _rising(table, coarse)
    if rising is not None:
        if coarse:
            note(
                f"the stamps of {coarse[0].name!r} repeat themselves: the clock is "
                f"{rising.name!r}, which rises with them"
            )
        return rising
    if trouble:
        raise ValueError(trouble)
    return coarse[0] if coarse else None


def clock_called(wanted: str, names: Collection[str]) -> NamedClock:
    """Return the clock of a name, perhaps with a unit behind it, ``tick [ms]``.

    Raises:
        ValueError: there is no such column, or the unit is unknown.
    """
    bare, unit = split_unit(wanted)
    headers = {split_unit(name)[0]: name for name in names}
    header = wanted if wanted in names else headers.get(wanted) or headers.get(bare)
    if header is None:
        raise ValueError(f"no column is called {wanted!r}; there are: {', '.join(names)[:300]}")
    if wanted in names or not unit:
        pair = _pairs(list(names)).get(header)
        return pair or NamedClock((header,), (unit_by_name(header),))
    if unit.lower() not in LONGER:
        raise ValueError(f"a clock counts in one of {', '.join(LONGER)}, got {wanted!r}")
    return NamedClock((header,), (LONGER[unit.lower()],))


def resolve(named: NamedClock, table: Table, dt: float | None, reason: str) -> LogClock:
    """Return a clock with its kind and its units, by what its columns hold.

    Raises:
        ValueError: they hold no times.
    """
    column = named.columns[0]
    kind = kind_of(column, table[column])
    if kind != NUMBER:
        return LogClock((column,), (1.0,), kind, reason)

    if len(named.columns) == 2:
        seconds_unit, fraction_unit = named.units
        assert seconds_unit is not None
        assert fraction_unit is not None
        fraction = numbers_of(named.columns[1], table[named.columns[1]])
        if np.nanmax(fraction, initial=0.0) * fraction_unit < 1.0:
            return LogClock(named.columns, (seconds_unit, fraction_unit), NUMBER, reason)

    unit = named.units[0]
    if unit is None:
        unit = _unit_of(column, numbers_of(column, table[column]), dt)
    return LogClock((column,), (unit,), NUMBER, reason)


def _unit_of(column: str, numbers: NDArray[Any], dt: float | None) -> float:
    """Return the seconds in a number of a clock that says no unit, and tell the user."""
    known = np.asarray(numbers[np.isfinite(numbers)], np.float64)
    if not len(known):
        return 1.0
    by_size = unit_by_size(known[0])
    if by_size is not None or len(known) < 3:
        return by_size or 1.0
    step = float(np.median(np.diff(known)))
    if step <= 0:
        return 1.0
    if known[0] > LEAST_DATE and step * DAY_S < 1 / SLOWEST_HZ and step < 1e-4:
        units = {"days": DAY_S}
    else:
        units = plausible_units(step, dt, bool((known == np.rint(known)).all()))
    name, unit = next(iter(units.items()))
    if unit != 1.0:
        note(
            f"{column!r} goes on by {step:g} from row to row and says no unit: read in {name}, "
            f"{1 / (step * unit):.4g} rows a second; in s it would be {1 / step:.4g}: "
            f"--clock '{column} [s]', or the line `clock` of the schema, says otherwise"
        )
    return unit


def plausible_units(step: float, dt: float | None, is_whole: bool) -> dict[str, float]:
    """Return the units [s] by name in which a clock may count, the likeliest first.

    Args:
        step: by how much it goes on from row to row.
        dt: period of the memory that reads it; None without one [s].
        is_whole: all its numbers are whole.
    """
    rates = {name: 1 / (step * unit) for name, unit in UNNAMED_UNITS.items()}
    if dt is not None:
        alike = [name for name, rate in rates.items() if abs(1 / (rate * dt) - 1) < ALIKE]
    else:
        alike = [name for name, rate in rates.items() if SLOWEST_HZ <= rate <= FASTEST_HZ]
        if is_whole:
            alike.reverse()  # 0, 1, 2, … is a controller's count of ms, and no log of seconds
    return {name: UNNAMED_UNITS[name] for name in alike} | UNNAMED_UNITS


def _unsteadiness(times: Floats) -> tuple[float, float]:
    """Return the share of rows with the stamp of the row before, and how much steps differ."""
    steps = np.diff(times)
    if not len(steps) or not np.isfinite(times).all():
        return 1.0, 1.0
    median = float(np.median(steps))
    if median < 0:
        return 1.0, 1.0
    repeated = float(np.mean(steps == 0.0))
    if median == 0:
        return repeated, 1.0
    return repeated, round(float(np.median(np.abs(steps / median - 1))), 2)


def _note_disagreement(table: Table, clocks: list[LogClock]) -> None:
    """Tell the user of clocks whose rates differ from that of the first."""
    periods = [float(np.ptp(clock.times(table).seconds)) for clock in clocks]
    rows = len(table[clocks[0].columns[0]])
    if rows < 3 or not periods[0] > 0:
        return
    for clock, period in zip(clocks[1:], periods[1:], strict=True):
        if period > 0 and abs(period / periods[0] - 1) > DISAGREE:
            rates = f"{(rows - 1) / periods[0]:.4g} and {(rows - 1) / period:.4g} rows a second"
            note(
                f"{clocks[0].name!r} and {clock.name!r} disagree, {rates}: the former is read; "
                "--clock NAME chooses"
            )


def _rising(table: Table, coarse: list[LogClock]) -> LogClock | None:
    """Return a column that is not called a clock and is one: it rises, and its unit is known."""
    stamps = {column for clock in coarse for column in clock.columns}
    for name, values in table.items():
        unit = _unit_of_rising(name, values)
        if unit is not None and name not in stamps:
            kind = NUMBER if values.dtype.kind in "biuf" else DATE
            return LogClock((name,), (unit,), kind, "rises from row to row")
    return None


def _unit_of_rising(name: str, values: NDArray[Any]) -> float | None:
    """Return the seconds in a number of a column that rises; None if it does not, or says no unit."""
    is_index = name.strip().lower() in COUNTERS
    if values.dtype.kind in "OM" and is_index and len(values):
        try:
            is_clock_of_dates = kind_of(name, values) == DATE
        except ValueError:
            return None
        dates = LogClock((name,), kind=DATE).times(table={name: values}).seconds
        return 1.0 if is_clock_of_dates and bool((np.diff(dates) > 0).all()) else None

    is_numeric = values.dtype.kind in "biuf" and values.ndim == 1 and len(values) >= 3
    if not is_numeric or not np.isfinite(values).all():
        return None
    if np.mean(np.diff(values) > 0) <= 1 - MOST_REPEATED:
        return None
    if is_index and (values != np.rint(values)).any():
        return 1.0  # an index of seconds
    unit = unit_by_name(name)
    if unit is None and float(values[0]) >= 1e14:
        unit = unit_by_size(float(values[0]))
    return unit
