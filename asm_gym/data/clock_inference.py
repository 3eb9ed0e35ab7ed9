"""Find the clock of a log by the names of its columns and by what they hold.

named      columns called time, stamp, …; two of one time, seconds and a fraction, are a pair
steadiest  of these the one whose steps differ least, if few rows repeat the stamp before
rising     else a column that rises with them, whose unit its name or its size says
unit       by the name, by the size of numbers since 1970, else by the rate of rows
"""

from __future__ import annotations

import re
from collections.abc import Collection, Iterable, Mapping, Sequence
from contextlib import suppress
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from asm_gym.data.clock import DATE, DAY_S, NUMBER, LogClock, kind_of, numbers_of, unit_by_size
from asm_gym.data.column_behaviour import are_whole, finite
from asm_gym.data.column_names import CLOCK_NAME, COUNTERS, LONGER, SECONDS, is_clock, split_unit
from asm_gym.data.reader_notes import note
from asm_gym.data.table_layout import is_numeric

Floats = NDArray[np.float64]
Table = Mapping[str, NDArray[Any]]

MOST_REPEATED = 0.02  # share of rows that may have the stamp of the row before: written twice
DISAGREE = 0.01  # share by which two clocks may differ before the user is told
ALIKE = 0.2  # share by which a clock may differ from the memory that tells its unit
SHORTEST_PERIOD_S = 1e-3  # plausible times from row to row, which tell a unit,
LONGEST_PERIOD_S = 1.0  # from this to that [s]
LEAST_DATE = 3e4  # Excel and MATLAB count days, from 1982 on so many
LEAST_STAMP = 1e14  # microseconds since 1970, in March 1973: few other numbers are as large
RISES = "rises from row to row"
UNNAMED_UNITS = ("s", "ms", "us", "ns")  # in which a clock that says no unit may count

_FRACTION = re.compile(
    r"(?P<stem>.*?)[._\[ ]*(?P<unit>nanosec(?:ond)?s?|nanos|nsecs?|ns|usecs?|us|micros)\]?", re.I
)
_SECONDS = ("secs", "sec", "seconds", "s")


class NamedClock(NamedTuple):
    """Columns that are called as a clock is, and the seconds in a number of each; None if unsaid."""

    columns: tuple[str, ...]
    units: tuple[float | None, ...] = (None,)


class _Candidate(NamedTuple):
    """A clock that a table may have, and how evenly it goes on."""

    clock: LogClock
    times: Floats  # (T,) [s]
    repeated: float = 1.0  # share of rows with the stamp of the row before
    jitter: float = 1.0  # median difference of a step from the median, as a share of that


def clocks_among(names: Iterable[str]) -> list[NamedClock]:
    """Return the clocks among columns by their names; seconds and a fraction of them are one."""
    names = list(names)
    pairs = _pairs(names)
    fractions = {pair.columns[1] for pair in pairs.values()}
    single = {name for name in names if is_clock(name)} - fractions
    return [_clock_of(name, pairs) for name in names if name in single.union(pairs)]


def _clock_of(name: str, pairs: Mapping[str, NamedClock]) -> NamedClock:
    """Return the pair that a column begins, or the clock that it is alone."""
    if name in pairs:
        return pairs[name]
    return NamedClock((name,), (unit_by_name(name),))


def _pairs(names: Sequence[str]) -> dict[str, NamedClock]:
    """Return the pairs of seconds and a fraction, by the column of seconds."""
    by_lower_name = {name.lower(): name for name in reversed(names)}
    pairs: dict[str, NamedClock] = {}
    for name in names:
        match = _FRACTION.fullmatch(name)
        if match is None:
            continue
        unit = 1e-6
        if match["unit"].lower().startswith("n"):
            unit = 1e-9
        before = name[: match.start("unit")]
        behind = name[match.end("unit") :]
        for word in _SECONDS:
            called = f"{before}{word}{behind}".lower()
            seconds = by_lower_name.get(called)
            if seconds is not None:
                pairs.setdefault(seconds, NamedClock((seconds, name), (1.0, unit)))
    return pairs


def unit_by_name(name: str) -> float | None:
    """Return the seconds in a number of a clock's column, by its name; None if that says none."""
    if name.lower() == "ipoc":
        return 1e-3  # KUKA's counter of milliseconds
    match = CLOCK_NAME.fullmatch(name.strip())
    if match is not None and match["unit"]:
        return SECONDS[match["unit"].lower()]
    in_brackets = split_unit(name)[1].lower()
    behind = name.lower().rpartition("_")[2]
    return LONGER.get(in_brackets) or SECONDS.get(behind)


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

    candidates = []
    problems = []
    for named in clocks_among(table):
        try:
            candidates.append(_candidate(named, table, dt))
        except ValueError as error:
            problems.append(error)
    steady = [candidate for candidate in candidates if candidate.repeated <= MOST_REPEATED]
    if steady:
        steady.sort(key=lambda candidate: candidate.jitter)
        _note_disagreement(steady)
        return steady[0].clock

    coarse = [candidate.clock for candidate in candidates]
    rising = _rising(table, coarse)
    if rising is not None:
        if coarse:
            note(
                f"the stamps of {coarse[0].name!r} repeat themselves: the clock is "
                f"{rising.name!r}, which rises with them"
            )
        return rising
    if problems:
        raise problems[0]
    return next(iter(coarse), None)


def clock_called(wanted: str, names: Collection[str]) -> NamedClock:
    """Return the clock of a name, perhaps with a unit behind it, ``tick [ms]``.

    Raises:
        ValueError: there is no such column, or the unit is unknown.
    """
    bare, unit = split_unit(wanted)
    headers = {split_unit(name)[0]: name for name in names}
    headers |= {name: name for name in names}
    header = headers.get(wanted) or headers.get(bare)
    if header is None:
        known = ", ".join(names)
        raise ValueError(f"no column is called {wanted!r}; there are: {known[:300]}")
    if header == wanted or not unit:
        return _clock_of(header, _pairs(list(names)))
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
        return LogClock((column,), kind=kind, reason=reason)

    units: list[float] = []
    for name, unit in zip(named.columns, named.units, strict=True):
        numbers = numbers_of(name, table[name])
        if unit is None:
            unit = _unit_of(name, numbers, dt)
        if units and np.nanmax(numbers, initial=0.0) * unit >= 1.0:
            break  # no fraction of a second
        units.append(unit)
    return LogClock(named.columns[: len(units)], tuple(units), reason=reason)


def _unit_of(column: str, numbers: NDArray[Any], dt: float | None) -> float:
    """Return the seconds in a number of a clock that says no unit, and tell the user."""
    known = finite(numbers)
    by_size = None
    if len(known):
        by_size = unit_by_size(known[0])
    if by_size is not None or len(known) < 3:
        return by_size or 1.0
    step = float(np.median(np.diff(known)))
    if step <= 0:
        return 1.0

    unit = plausible_unit(step, dt, are_whole(known))
    if known[0] > LEAST_DATE and step * DAY_S < LONGEST_PERIOD_S:
        unit = "days"
    if unit != "s":
        rate = 1 / (step * LONGER[unit])
        note(
            f"{column!r} goes on by {step:g} from row to row and says no unit: read in {unit}, "
            f"{rate:.4g} rows a second; in s it would be {1 / step:.4g}: "
            f"--clock '{column} [s]', or the line `clock` of the schema, says otherwise"
        )
    return LONGER[unit]


def plausible_unit(step: float, dt: float | None, is_whole: bool) -> str:
    """Return the likeliest of ``UNNAMED_UNITS`` in which a clock counts.

    Args:
        step: by how much it goes on from row to row.
        dt: period of the memory that reads it; None without one [s].
        is_whole: all its numbers are whole.
    """
    shortest = SHORTEST_PERIOD_S
    longest = LONGEST_PERIOD_S
    if dt is not None:
        shortest = dt * (1 - ALIKE)
        longest = dt * (1 + ALIKE)
    units = UNNAMED_UNITS
    if dt is None and is_whole:
        units = units[::-1]  # 0, 1, 2, … is a controller's count of ms, and no log of seconds
    for unit in units:
        if shortest <= step * LONGER[unit] <= longest:
            return unit
    return "s"


def _candidate(named: NamedClock, table: Table, dt: float | None) -> _Candidate:
    """Return a clock, and how evenly it goes on.

    Raises:
        ValueError: its columns hold no times.
    """
    clock = resolve(named, table, dt, "called as a clock is")
    times = clock.times(table).seconds
    steps = np.diff(times)
    if not len(steps) or not np.isfinite(times).all():
        return _Candidate(clock, times)
    median = np.median(steps)
    if median < 0:
        return _Candidate(clock, times)

    repeated = float(np.mean(steps == 0.0))
    if median == 0:
        return _Candidate(clock, times, repeated)
    deviations = np.abs(steps / median - 1)
    # Rounded, so that of clocks about as steady the first column is read.
    jitter = round(float(np.median(deviations)), 2)
    return _Candidate(clock, times, repeated, jitter)


def _note_disagreement(candidates: list[_Candidate]) -> None:
    """Tell the user of clocks whose rates differ from that of the first."""
    first, *others = candidates
    steps = len(first.times) - 1
    span = float(np.ptp(first.times))
    if steps < 2 or not span > 0:
        return
    for other in others:
        other_span = float(np.ptp(other.times))
        if other_span > 0 and abs(other_span / span - 1) > DISAGREE:
            rate = steps / span
            other_rate = steps / other_span
            note(
                f"{first.clock.name!r} and {other.clock.name!r} disagree, {rate:.4g} and "
                f"{other_rate:.4g} rows a second: the former is read; --clock NAME chooses"
            )


def _rising(table: Table, coarse: list[LogClock]) -> LogClock | None:
    """Return a column that is not called a clock and is one: it rises, and its unit is known."""
    stamps = {column for clock in coarse for column in clock.columns}
    for name, values in table.items():
        if name in stamps:
            continue
        if _is_index_of_dates(name, values):
            return LogClock((name,), kind=DATE, reason=RISES)
        if _rises(values):
            unit = _unit_of_rising(name, values)
            if unit is not None:
                return LogClock((name,), (unit,), reason=RISES)
    return None


def _is_index_of_dates(name: str, values: NDArray[Any]) -> bool:
    """Return whether a column is called as an index is, and holds dates that rise."""
    if is_numeric(values) or not _is_index(name) or not len(values):
        return False
    with suppress(ValueError):
        dates = LogClock((name,), kind=kind_of(name, values))
        steps = np.diff(dates.times({name: values}).seconds)
        return dates.kind == DATE and bool((steps > 0).all())
    return False


def _is_index(name: str) -> bool:
    """Return whether a column is called as one that counts rows."""
    return name.strip().lower() in COUNTERS


def _rises(values: NDArray[Any]) -> bool:
    """Return whether numbers (T,) rise in nearly all rows."""
    if not is_numeric(values) or len(values) < 3 or not np.isfinite(values).all():
        return False
    steps = np.diff(values.astype(np.float64))  # a fall of unsigned numbers would be a leap
    rising_share = np.mean(steps > 0)
    return bool(rising_share > 1 - MOST_REPEATED)


def _unit_of_rising(name: str, values: NDArray[Any]) -> float | None:
    """Return the seconds in a number of a column that rises; None if nothing tells."""
    if _is_index(name) and not are_whole(values):
        return 1.0  # an index of seconds
    first = float(values[0])
    unit = unit_by_name(name)
    if unit is None and first >= LEAST_STAMP:
        return unit_by_size(first)
    return unit
