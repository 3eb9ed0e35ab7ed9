"""Find the clock of a log, and the unit in which it counts.

unit       behind the name; or else by what a number since 1970 would be, by velocities against differences of
           positions, by the memory's rate, and by the unit that gives 1 to 1000 rows a second
pair       columns of seconds and of nanoseconds are one clock
choice     the steadiest of those called so; a clock in whole seconds gives way to a counter that agrees with it
text       ISO 8601, 24/11/2026 10:00:00.5, 11/24/2026 10:00:00.5, 10:00:00.5
"""

from __future__ import annotations

import re
from collections.abc import Collection, Iterable, Mapping, Sequence
from contextlib import suppress
from datetime import UTC, datetime
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from asm_gym.data.names import CLOCK, COUNTERS, LONGER, SECONDS, is_clock, split_unit
from asm_gym.data.reader_notes import note

Floats = NDArray[np.float64]

# least number since 1970, and its unit [s]
EPOCHS = (
    (1e17, 1e-9),
    (1e14, 1e-6),
    (1e11, 1e-3),
    (1e8, 1.0),
)
SLOWEST_WITHOUT_UNIT = (
    2.0  # step from which on a clock without a unit is not believed to count seconds
)
UNITS = {1.0: "s", 1e-3: "ms", 1e-6: "us", 1e-9: "ns"}
# [s]; Excel and MATLAB count days, from 1982 on so many, in steps so short
DAY, LEAST_DATE, BRIEF = (
    86400.0,
    3e4,
    1e-4,
)
MOST_DOUBLED = (
    0.02  # share of rows that may have the stamp of the one before: they were written twice
)
DISAGREE = 0.01  # how far two clocks may be off each other, as a share, before that is said
ALIKE = 0.2  # how far two clocks, or a clock and a memory, may be off, as a share, and tell each other's unit

# rows from which on velocities tell the unit, and how well they must explain positions
FEWEST, ALIKE_MOTION = (
    8,
    0.9,
)

_PAIR = re.compile(
    r"(?P<of>.*?)[._\[ ]*(?P<unit>nanosec(?:ond)?s?|nsecs?|ns|usecs?|us|micros)\]?", re.I
)
_SECONDS = ("secs", "sec", "seconds", "s")
_PLACES = {
    "velocity": "position",
    "velocities": "positions",
    "vel": "pos",
    "qvel": "qpos",
} | dict.fromkeys(("qd", "dq", "v"), "q")
"""What a position is called, by what its velocity is called."""


class Clock(NamedTuple):
    """Columns of times that add up to one, and the seconds in a number of each; None where its name does not say."""

    columns: tuple[str, ...]
    units: tuple[float | None, ...] = (None,)

    @property
    def name(self) -> str:
        """What the user calls it."""
        return " + ".join(self.columns)

    def seconds(self, table: Mapping[str, NDArray[Any]]) -> Floats:
        """Return (T,) seconds, from the first row where the clock counts from 1970, which would cost digits."""
        parts = [
            _seconds(c, u, table[c], len(self.columns) > 1)
            for c, u in zip(self.columns, self.units, strict=True)
        ]
        if len(parts) == 1 or np.nanmax(parts[1], initial=0.0) >= 1.0:  # both count all the time
            return parts[0]
        return parts[0] + parts[1]

    def moment(self, row: Mapping[str, Any]) -> float | None:
        """Return the time of a row [s]; None where it has none. Raises ValueError where it cannot be read."""
        cells = [row.get(column) for column in self.columns]
        if any(cell is None for cell in cells):
            return None
        found = [
            _moment(c, u, str(cell))
            for c, u, cell in zip(self.columns, self.units, cells, strict=True)
        ]
        return found[0] if len(found) == 1 or found[1] >= 1.0 else found[0] + found[1]


def _seconds(column: str, unit: float | None, values: NDArray[Any], paired: bool) -> Floats:
    values, unit = _numbers(column, unit, values)
    if values.ndim != 1 or not len(values):
        raise ValueError(
            f"the clock {column!r} must hold a number a row, got the shape {values.shape}"
        )
    known = values[np.isfinite(values)]
    first = float(known[0]) if len(known) else 0.0
    unit = _epoch(first) if unit is None else unit
    if first < EPOCHS[-1][0] or (paired and unit < 1.0):
        return values.astype(np.float64) * unit
    since = (
        values.astype(np.int64) - int(known[0]) if values.dtype.kind in "biu" else values - first
    )
    return np.asarray(since, np.float64) * unit


def _epoch(number: float) -> float:
    """The unit in which a number since 1970 counts; of others, seconds."""
    return next((unit for least, unit in EPOCHS if number >= least), 1.0)


def _numbers(
    column: str, unit: float | None, values: NDArray[Any]
) -> tuple[NDArray[Any], float | None]:
    """The numbers (T,) of a column of times, and their unit: nanoseconds since 1970 of dates, seconds of a day."""
    import pandas as pd

    if values.dtype.kind in "biuf":
        return values, unit
    if values.dtype.kind == "M":
        return values.astype("M8[ns]").astype(np.int64), 1e-9
    text = pd.Series(values).astype("string").str.strip().replace("", pd.NA)
    numbers = pd.to_numeric(text, errors="coerce")
    if (numbers.notna() | text.isna()).all():
        return numbers.to_numpy(np.float64, na_value=np.nan), unit
    if text.str.fullmatch(r"\d{1,2}:\d\d:\d\d(\.\d+)?").fillna(True).all():
        day = (pd.to_timedelta(text) / pd.Timedelta(seconds=1)).to_numpy(np.float64)
        return day + 86400.0 * np.concatenate([[0], np.cumsum(np.diff(day) < -43200)]), 1.0
    # 11/05/2026 may begin with the day or the month: read so that the whole takes the least time.
    ends = text.dropna().iloc[[0, -1]]
    orders = sorted((True, False), key=lambda order: _span(ends, order) if len(text) > 1 else 0)
    ways: list[dict[str, Any]] = [{"format": "mixed", "dayfirst": order} for order in orders]
    for how in ({"format": "ISO8601"}, *ways):
        with suppress(ValueError, TypeError):
            moments = pd.to_datetime(text, utc=True, **how).dt.as_unit("ns")
            since = moments.astype(np.int64)
            return (
                since if moments.notna().all() else since.where(moments.notna())
            ).to_numpy(), 1e-9
    odd = next(str(cell) for cell in text[numbers.isna() & text.notna()])
    raise ValueError(
        f"the clock {column!r} must hold a time, got {odd[:40]!r}: --rate HZ reads the rows without it"
    )


def _span(ends: Any, day_first: bool) -> float:
    """How far apart two dates are [s]; infinite where they cannot be read, or the second comes first."""
    import pandas as pd

    with suppress(ValueError, TypeError):
        first, last = pd.to_datetime(ends, utc=True, format="mixed", dayfirst=day_first)
        return float((last - first).total_seconds()) if last >= first else np.inf
    return np.inf


def _moment(column: str, unit: float | None, cell: str) -> float:
    """The time of one cell [s]."""
    with suppress(ValueError):
        number = float(cell or "nan")
        return number * (_epoch(number) if unit is None else unit)
    with suppress(ValueError):
        moment = datetime.fromisoformat(cell.strip())
        return moment.replace(tzinfo=moment.tzinfo or UTC).timestamp()
    numbers, found = _numbers(column, unit, np.array([cell], object))
    return float(numbers[0]) * (found or 1.0)


def clocks_among(names: Iterable[str]) -> list[Clock]:
    """Return the clocks among columns by their names; seconds and nanoseconds of one time are one clock."""
    names = list(names)
    lower = {name.lower(): name for name in reversed(names)}
    pairs = {}
    for name, found in ((name, _PAIR.fullmatch(name)) for name in names):
        for end in _SECONDS if found else ():
            assert found is not None
            coarse = lower.get(
                name[: found.start("unit")].lower() + end + name[found.end("unit") :].lower(), name
            )
            if coarse != name and coarse not in pairs:
                pairs[coarse] = Clock(
                    (coarse, name), (1.0, 1e-9 if found["unit"].lower().startswith("n") else 1e-6)
                )
    fine = {pair.columns[1] for pair in pairs.values()}
    single = {
        name: Clock((name,), (_named_unit(name),))
        for name in names
        if is_clock(name) and name not in fine
    }
    return [clock for name in names if (clock := pairs.get(name) or single.get(name))]


def _named_unit(name: str) -> float | None:
    if name.lower() == "ipoc":
        return 1e-3  # KUKA's counter of milliseconds
    found = CLOCK.fullmatch(name.strip())
    if found is not None and found["unit"]:
        return SECONDS[found["unit"].lower()]
    return LONGER.get(split_unit(name)[1].lower()) or SECONDS.get(name.lower().rpartition("_")[2])


def find_clock(
    table: Mapping[str, NDArray[Any]], wanted: str = "", dt: float | None = None
) -> Clock | None:
    """Return the steadiest clock of a table, or the one that is ``wanted``; None where there is none.

    ``dt`` [s] is how far apart a memory reads rows: it tells the unit of a clock that says none. Raises ValueError
    where none can be read, and says why.
    """
    if wanted:
        return _with_unit(clock_called(wanted, table), table, dt)
    trouble, usable = "", list[tuple[tuple[float, float], Clock]]()
    for clock in clocks_among(table):
        try:
            clock = _with_unit(clock, table, dt)
            usable.append((_unsteadiness(clock.seconds(table)), clock))
        except ValueError as error:
            trouble = trouble or str(error)
    usable.sort(key=lambda each: each[0])
    steady = [clock for (doubled, _), clock in usable if doubled <= MOST_DOUBLED]
    if steady:
        _note_others(table, *steady)
        return steady[0]
    best = usable[0][1] if usable else None
    rising = _rising(table, [clock for _, clock in usable])
    if rising is not None and best is not None:
        note(
            f"the stamps of {best.name!r} repeat themselves: the clock is {rising.name!r}, which rises with them"
        )
    if rising is None and trouble:
        raise ValueError(trouble)
    return rising or best


def clock_called(wanted: str, columns: Collection[str]) -> Clock:
    """Return the clock of this name, with the unit behind it. Raises ValueError where there is none."""
    bare, unit = split_unit(wanted)
    names = {split_unit(name)[0]: name for name in columns} | {name: name for name in columns}
    name = names.get(wanted) or names.get(bare)
    if name is None:
        raise ValueError(f"no column is called {wanted!r}; there are: {', '.join(columns)[:300]}")
    pair = next(
        (
            clock
            for clock in clocks_among(columns)
            if clock.columns[0] == name and clock.columns[1:]
        ),
        None,
    )
    if pair is not None and not unit:
        return pair
    if unit and wanted not in columns and unit.lower() not in LONGER:
        raise ValueError(f"a clock counts in one of {', '.join(LONGER)}, got {wanted!r}")
    return Clock((name,), (LONGER.get(unit.lower()) or _named_unit(name),))


def _unsteadiness(times: Floats) -> tuple[float, float]:
    """The share of rows with the stamp of the one before, and how much steps differ, as a share."""
    steps = np.diff(times)
    if not len(steps) or not np.isfinite(times).all():
        return 1.0, 1.0
    median, doubled = float(np.median(steps)), float(np.mean(steps == 0.0))
    jitter = float(np.median(np.abs(steps / median - 1))) if median > 0 else 1.0
    return (0.0 if doubled <= MOST_DOUBLED else doubled) + float(median < 0), round(jitter, 2)


def _note_others(table: Mapping[str, NDArray[Any]], best: Clock, *others: Clock) -> None:
    for other in others if len(table[best.columns[0]]) > 2 else ():
        own, step = (
            float(np.ptp(clock.seconds(table))) / (len(table[best.columns[0]]) - 1)
            for clock in (best, other)
        )
        if own > 0 and step > 0 and abs(step / own - 1) > DISAGREE:
            rates = f"{1 / own:.4g} and {1 / step:.4g} rows a second"
            note(
                f"{best.name!r} and {other.name!r} disagree, {rates}: the former is read; --clock NAME chooses"
            )


def _with_unit(clock: Clock, table: Mapping[str, NDArray[Any]], dt: float | None) -> Clock:
    """The clock with its unit, told by its numbers where its name does not say."""
    column, values = clock.columns[0], table[clock.columns[0]]
    if clock.units[0] is not None or values.dtype.kind not in "biuf" or values.ndim != 1:
        return clock
    known = values[np.isfinite(values)].astype(np.float64)
    step = float(np.median(np.diff(known))) if len(known) > 2 else 0.0
    if not step > 0 or known[0] >= EPOCHS[-1][0]:
        return clock
    plausible = (
        [u for u in UNITS if 1.0 <= 1 / (step * u) <= 1000.0]
        if step >= SLOWEST_WITHOUT_UNIT
        else []
    )
    moved = _seconds_a_row(table) or dt
    alike = [u for u in UNITS if moved is not None and abs(step * u / moved - 1) < ALIKE]
    unit = DAY if known[0] > LEAST_DATE and step < BRIEF else next(iter([*alike, *plausible]), 1.0)
    if unit != 1.0:
        note(
            f"{column!r} goes on by {step:g} from row to row and says no unit: read in {UNITS.get(unit, 'days')}, a "
            f"plausible rate; --clock '{column} [s]' or --rate HZ says otherwise"
        )
    return Clock((column,), (unit,))


def _rising(table: Mapping[str, NDArray[Any]], coarse: Sequence[Clock]) -> Clock | None:
    """A clock that is not called so: its numbers rise, and its name, their size, or a coarse clock tells the unit."""
    for name, values in table.items():
        unnamed = name.strip().lower() in COUNTERS
        if unnamed and values.dtype.kind == "O" and len(values):  # an index of dates
            with suppress(ValueError):
                if (np.diff(Clock((name,)).seconds(table)) > 0).all():
                    return Clock((name,))
        if (
            values.dtype.kind not in "biuf"
            or values.ndim != 1
            or len(values) < 3
            or not np.isfinite(values).all()
        ):
            continue
        if (
            any(name in clock.columns for clock in coarse)
            or not np.mean(np.diff(values) > 0) > 1 - MOST_DOUBLED
        ):
            continue
        unit = _named_unit(name) or (
            _epoch(float(values[0])) if values[0] >= EPOCHS[1][0] else None
        )
        # an index of seconds
        unit = 1.0 if unit is None and unnamed and (values != np.rint(values)).any() else unit
        for whole in (float(np.ptp(clock.seconds(table))) for clock in coarse):
            span = float(values[-1]) - float(values[0])
            unit = unit or next(
                (u for u in UNITS if whole > 0 and abs(span * u / whole - 1) < ALIKE), None
            )
        if unit is not None:
            return Clock((name,), (unit,))
    return None


def _seconds_a_row(table: Mapping[str, NDArray[Any]]) -> float | None:
    """The seconds from row to row by which velocities explain the differences of positions; None without any."""
    names, found = {split_unit(name)[0]: values for name, values in table.items()}, list[float]()
    for name, speeds in names.items():
        for speed, place in _PLACES.items():
            other = re.sub(rf"(?<![A-Za-z]){speed}(?![A-Za-z])", place, name, count=1, flags=re.I)
            pair = names.get(other, speeds), speeds
            if other == name or any(
                x.dtype.kind not in "biuf" or x.ndim != 1 or len(x) < FEWEST for x in pair
            ):
                continue
            moved = np.gradient(pair[0].astype(np.float64))
            if np.ptp(speeds) > 0 and np.corrcoef(moved, speeds)[0, 1] > ALIKE_MOTION:
                found.append(float(moved @ speeds) / float(speeds @ speeds))
    return float(np.median(found)) if found and np.median(found) > 0 else None
