"""Find the clock of a log, and put its rows where they belong in time.

unit       behind the name; without one, large numbers count s, ms, µs or ns since 1970, and others seconds
text       ISO 8601, 2022-10-26T08:17:21.847Z
step       n_i = (t_i - t_{i-1})/dt, dt being the mean step, gaps left out
near whole numbers   a row keeps its values and stands n_i places after the one before; places between are NaN
elsewhere            values between two stamps are interpolated; where these are far apart, NaN
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from datetime import UTC, datetime
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from asm_gym.data.names import CLOCK, SECONDS, is_clock
from asm_gym.data.reader_notes import note

Floats = NDArray[np.float64]

EPOCHS = ((1e17, 1e-9), (1e14, 1e-6), (1e11, 1e-3), (1e8, 1.0))  # least number since 1970, and its unit [s]
SLOWEST_WITHOUT_UNIT = 2.0  # step from which on a clock without a unit is not believed to count seconds
JITTER = 0.35  # by what share of a step a stamp may be off, and its row still be the one that was due
DRIFT = 0.011  # how far a clock may be off the rate that is read, as a share, and no row be moved for it
NEARLY, MOSTLY = 0.15, 0.95  # rows were lost where MOSTLY steps are NEARLY whole multiples of the median; else jitter
MOST_DOUBLED = 0.02  # share of rows that may have the stamp of the one before: they were written twice
FAR = 2.5  # how much longer than nine in ten a step must be, so that nothing in it is known
MOST_LOST = 4  # a log may have lost so many times its rows, or ten minutes; more is a clock that was set


class Clock(NamedTuple):
    """A column of times."""

    column: str
    unit: float | None = None  # seconds in one of its numbers; None where its name does not say

    def seconds(self, values: NDArray[Any]) -> Floats:
        """Return (T,) seconds, from the first row where the clock counts from 1970, which would cost digits."""
        if values.dtype.kind == "M":
            return np.asarray((values - values[:1]) / np.timedelta64(1, "ns"), np.float64) * 1e-9
        if values.dtype.kind not in "biuf":
            start = self.moment(str(values[0]))
            return np.array([self.moment(str(cell)) - start for cell in values])
        if values.ndim != 1 or not len(values):
            raise ValueError(f"the clock {self.column!r} must hold a number a row, got the shape {values.shape}")
        known = values[np.isfinite(values)]
        unit = self.unit_of(float(known[0])) if len(known) else 1.0
        step = float(np.median(np.diff(known))) if len(known) > 2 else 0.0
        if self.unit is None and unit == 1.0 and step >= SLOWEST_WITHOUT_UNIT:
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
                moment = datetime.fromisoformat(cell.strip())
            except ValueError:
                raise ValueError(f"the clock {self.column!r} must hold a time, got {cell[:40]!r}") from None
            moment = moment if moment.tzinfo else moment.replace(tzinfo=UTC)  # all rows are of the same zone
            return (moment - datetime(1970, 1, 1, tzinfo=UTC)).total_seconds()
        return number * self.unit_of(number)


class Timing(NamedTuple):
    """When the rows of a log were sensed."""

    clock: Clock
    times: Floats  # (N,) of the rows that are kept [s]
    kept: NDArray[np.intp]  # (N,) which rows of the log these are: one of several with the same time
    dt: float | None  # from row to row in the mean [s]; None of a single row


def clock_among(names: Iterable[str]) -> Clock | None:
    """Return the first of these columns that is a clock; None where none is."""
    for name in names:
        if is_clock(name):
            found = CLOCK.fullmatch(name.strip())
            assert found is not None
            return Clock(name, SECONDS[found["unit"].lower()] if found["unit"] else None)
    return None


def timing_of(table: Mapping[str, NDArray[Any]]) -> Timing | None:
    """Return when the rows of a table were sensed; None without a clock. Raises ValueError where it cannot be read."""
    clock = clock_among(table)
    if clock is None:
        return None
    times = clock.seconds(table[clock.column])
    again = np.concatenate([[False], np.diff(times) == 0.0])
    if again.any() and again.mean() <= MOST_DOUBLED:
        note(f"{int(again.sum())} rows have the same time as the one before, and are left out")
        kept = np.flatnonzero(~again)
    else:
        kept = np.arange(len(times))
    return Timing(clock, times[kept], kept, period(times[kept]))


def period(times: Floats) -> float | None:
    """Return the seconds from row to row in the mean, lost rows counted; None of fewer than two rows."""
    if len(times) < 2:
        return None
    if not np.isfinite(times).all():
        row = int(np.argmin(np.isfinite(times)))
        raise ValueError(f"time must be a number in every row, got {times[row]} in row {row}")
    steps = np.diff(times)
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


def evenly(rows: Floats, times: Floats, dt: float) -> Floats:
    """Return rows (T, D) as rows that are ``dt`` [s] apart, NaN where one was lost; unchanged where they are."""
    steps = np.diff(times) / dt
    whole = np.rint(steps)
    size = int(np.sum(steps)) + 1
    if size > MOST_LOST * len(times) + 600 / dt:
        gap = int(np.argmax(steps))
        raise ValueError(f"time jumps by {steps[gap] * dt:g} s after {times[gap]:g} s: cut the log there")
    steady = abs(float(steps.sum() / max(whole.sum(), 1)) - 1) <= DRIFT
    if steady and np.all(whole >= 1) and np.all(np.abs(steps - whole) <= JITTER):
        places = np.concatenate([[0], np.cumsum(whole)]).astype(np.intp)
        if len(places) == places[-1] + 1:
            return rows
        placed = np.full((places[-1] + 1, rows.shape[1]), np.nan)
        placed[places] = rows
        return placed
    due = times[0] + dt * np.arange(size)
    far = FAR * max(dt, float(np.quantile(steps, 0.9)) * dt)
    after = np.clip(np.searchsorted(times, due), 1, len(times) - 1)
    unknown = (times[after] - times[after - 1] > far) & (times[after] != due) & (times[after - 1] != due)
    interpolated = np.column_stack([np.interp(due, times, column) for column in rows.T])
    interpolated[unknown] = np.nan
    return interpolated
