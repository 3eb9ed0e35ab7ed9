"""Find the clock of a log, and put its rows where they belong in time.

unit       behind the name; without one, large numbers count s, ms, µs or ns since 1970, and others seconds
text       ISO 8601, 2022-10-26T08:17:21.847Z
step       n_i = (t_i - t_{i-1})/dt, dt being the mean step, gaps left out
near whole numbers   a row keeps its values and stands n_i places after the one before; places between are NaN
elsewhere            values between two stamps are interpolated; where these are far apart, NaN
"""

from __future__ import annotations

from collections.abc import Iterable
from datetime import datetime
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from asm_gym.data.names import CLOCK, SECONDS, is_clock
from asm_gym.data.reader_notes import note

Column = NDArray[Any]

EPOCHS = ((1e17, 1e-9), (1e14, 1e-6), (1e11, 1e-3), (1e8, 1.0))
"""From which number on, and in which unit, a clock without a unit counts from 1970: 1e8 s is March 1973."""

SLOWEST_WITHOUT_UNIT = 2.0
"""A clock without a unit that goes on by so much from row to row is not believed to count seconds."""

JITTER = 0.35
"""By what share of a step a stamp may be off, and its row still be the one that was due."""

DRIFT = 0.011
"""How far a clock may be off the rate that is read, as a share, and no row be moved for it."""

NEARLY, MOSTLY = 0.15, 0.95
"""A clock loses rows and does not jitter where so many steps are that near to whole multiples of the median."""

MOST_DOUBLED = 0.02
"""Share of rows that may have the stamp of the one before: they were written twice."""

FAR = 2.5
"""How much longer than nine in ten a step must be, so that nothing in it is known."""

MOST_LOST = 4
"""A log of T rows may have lost so many times T, or ten minutes: more is a clock that was set, or two logs in one."""


class Clock(NamedTuple):
    """A column of times.

    Attributes:
        column: its name.
        unit: seconds in one of its numbers; None where its name does not say.
    """

    column: str
    unit: float | None = None

    def seconds(self, values: Column) -> NDArray[np.float64]:
        """Return (T,) seconds, from the first row where the clock counts from 1970, which would cost digits.

        Raises:
            ValueError: it holds no times, or may count anything.
        """
        if values.dtype.kind == "M":
            return np.asarray((values - values[:1]) / np.timedelta64(1, "ns"), np.float64) * 1e-9
        if values.dtype.kind not in "biuf":
            start = self.moment(str(values[0]))
            return np.array([self.moment(str(cell)) - start for cell in values])
        if values.ndim != 1 or not len(values):
            raise ValueError(f"the clock {self.column!r} must hold a number a row, got the shape {values.shape}")
        known = values[np.isfinite(values)]
        unit = self.unit_of(float(known[0])) if len(known) else 1.0
        if self.unit is None and unit == 1.0 and len(known) > 2:
            step = float(np.median(np.diff(known)))
            if step >= SLOWEST_WITHOUT_UNIT:
                raise ValueError(
                    f"{self.column!r} goes on by {step:g} from row to row, and says no unit: "
                    f"call it '{self.column} [ms]' or '{self.column} [s]'"
                )
        if not len(known) or float(known[0]) < EPOCHS[-1][0]:
            return values.astype(np.float64) * unit
        since = values.astype(np.int64) - int(known[0]) if values.dtype.kind in "biu" else values - known[0]
        return np.asarray(since, np.float64) * unit

    def unit_of(self, number: float) -> float:
        """Return the seconds in one of its numbers, of which this is one."""
        if self.unit is not None:
            return self.unit
        return next((unit for least, unit in EPOCHS if number >= least), 1.0)

    def moment(self, cell: str) -> float:
        """Return the time of a cell of text [s]. Raises ValueError where it is none."""
        try:
            number = float(cell or "nan")
        except ValueError:
            try:
                found = datetime.fromisoformat(cell.strip())
            except ValueError:
                raise ValueError(f"the clock {self.column!r} must hold a time, got {cell[:40]!r}") from None
            ahead = found.utcoffset()  # without a zone all rows are of the same one
            since = (found.replace(tzinfo=None) - datetime(1970, 1, 1)).total_seconds()
            return since - (ahead.total_seconds() if ahead else 0.0)
        return number * self.unit_of(number)


def clock_among(names: Iterable[str]) -> Clock | None:
    """Return the first of these columns that is a clock; None where none is."""
    for name in names:
        if is_clock(name):
            found = CLOCK.fullmatch(name.strip())
            assert found is not None
            return Clock(name, SECONDS[found["unit"].lower()] if found["unit"] else None)
    return None


def distinct(times: Column) -> NDArray[np.intp]:
    """Return the rows (N,) that are kept: of several with the same stamp the first, where few are; all others."""
    again = np.concatenate([[False], np.diff(times) == 0.0])
    if not again.any() or again.mean() > MOST_DOUBLED:
        return np.arange(len(times))
    note(f"{int(again.sum())} rows have the same time as the one before, and are left out")
    return np.flatnonzero(~again)


def period(times: Column) -> float | None:
    """Return the seconds from row to row in the mean, lost rows counted; None of fewer than two rows.

    Where nearly all steps are whole multiples of the median, rows were lost between those that are more than one;
    elsewhere the clock jitters, and only steps that are far longer are gaps.

    Raises:
        ValueError: time does not increase.
    """
    if len(times) < 2 or times.ndim != 1:
        return None
    stamps = times.astype(np.float64)
    if not np.isfinite(stamps).all():
        row = int(np.argmin(np.isfinite(stamps)))
        raise ValueError(f"time must be a number in every row, got {stamps[row]} in row {row}")
    steps = np.diff(stamps)
    if not np.all(steps > 0):
        row = int(np.argmin(steps > 0)) + 1
        raise ValueError(
            f"time must increase from row to row, got {times[row - 1]:g} s before {times[row]:g} s: cut the log there"
        )
    median = float(np.median(steps))
    counts = np.rint(steps / median)
    near = counts >= 1
    if np.mean(near & (np.abs(steps / median - counts) <= NEARLY)) >= MOSTLY:
        mean = float(steps[near].sum() / counts[near].sum())
    else:
        mean = float(steps[steps <= FAR * median].mean())
    return float(f"{mean:.6g}")  # stamps jitter, and rates that differ by rounding would be two rates


def evenly(columns: dict[str, Column], times: Column, dt: float) -> dict[str, Column]:
    """Return the columns (T,) or (T, k) as rows that are ``dt`` [s] apart; unchanged where they are.

    Raises:
        ValueError: more rows are missing than can have been lost.
    """
    stamps = times.astype(np.float64)
    steps = np.diff(stamps) / dt
    whole = np.rint(steps)
    rows = int(np.sum(steps)) + 1
    if rows > MOST_LOST * len(stamps) + 600 / dt:
        gap = int(np.argmax(steps))
        raise ValueError(f"time jumps by {steps[gap] * dt:g} s after {stamps[gap]:g} s: cut the log there")
    steady = abs(float(steps.sum() / max(whole.sum(), 1)) - 1) <= DRIFT
    if steady and np.all(whole >= 1) and np.all(np.abs(steps - whole) <= JITTER):
        places = np.concatenate([[0], np.cumsum(whole)]).astype(np.intp)
        if len(places) == places[-1] + 1:
            return columns
        return {name: _placed(column, places) for name, column in columns.items()}
    due = stamps[0] + dt * np.arange(rows)
    far = FAR * max(dt, float(np.quantile(steps, 0.9)) * dt)
    return {name: interpolated(column, stamps, due, far) for name, column in columns.items()}


def _placed(column: Column, places: NDArray[np.intp]) -> Column:
    out = np.full((places[-1] + 1, *column.shape[1:]), np.nan)
    out[places] = column
    return out


def interpolated(column: Column, stamps: NDArray[np.float64], due: NDArray[np.float64], far: float) -> Column:
    """Return a column at the times ``due``: NaN between stamps that are ``far`` apart [s]; of words the last one."""
    after = np.clip(np.searchsorted(stamps, due), 1, len(stamps) - 1)
    if column.dtype.kind not in "biuf":
        words: Column = column[np.where(stamps[after] > due, after - 1, after)]
        return words
    flat = column.reshape(len(column), -1).astype(np.float64)
    out = np.column_stack([np.interp(due, stamps, flat[:, k]) for k in range(flat.shape[1])])
    out[(stamps[after] - stamps[after - 1] > far) & (stamps[after] != due) & (stamps[after - 1] != due)] = np.nan
    return out.reshape(len(due), *column.shape[1:])
