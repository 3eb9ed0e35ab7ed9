"""Put the rows of a log where they belong in time, and bridge numbers that are missing for a moment.

step       n_i = (t_i - t_{i-1})/dt, dt being the mean step, gaps left out
near whole numbers   a row keeps its values and stands n_i places after the one before; places between are NaN
elsewhere            values between two stamps are interpolated; where these are far apart, NaN
spent_i    + dt while number i is missing, - 0.1 dt while it is there, at least 0     [s]
bridged    spent_i <= ``seconds`` for all that are missing in a row: it is not judged; for longer they are an alarm
"""

from __future__ import annotations

from collections.abc import Mapping
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from asm_gym.data.clock import MOST_DOUBLED, Clock
from asm_gym.data.reader_notes import note
from asm_gym.readings import spans
from asm_gym.validation import check_number

Floats = NDArray[np.float64]
Rows = NDArray[np.floating[Any]]

JITTER = (
    0.35  # by what share of a step a stamp may be off, and its row still be the one that was due
)
DRIFT = 0.011  # how far a clock may be off the rate that is read, as a share, and no row be moved for it
# rows were lost where MOSTLY steps are NEARLY whole multiples of the median; else jitter
NEARLY, MOSTLY = (
    0.15,
    0.95,
)
MOST_CUTS = 0.02  # share of rows at which time may go back or leap, and the log be cut there
FAR = 2.5  # how much longer than nine in ten a step must be, so that nothing in it is known
MOST_LOST = (
    4  # a log may have lost so many times its rows, or ten minutes; more is a clock that was set
)
BRIDGED_ROWS = 2  # rows that are bridged where nobody says for how long
PAID_BACK = 0.1  # of a second that is whole, how much may be missing for good: a tenth of all rows
TOGETHER_S = 0.5  # alarms that are no further apart have one cause [s]
# why there is an alarm
SURPRISING, MISSING, NOT_FINITE, LATE = (
    "surprise",
    "missing data",
    "not finite",
    "late",
)


class Timing(NamedTuple):
    """When the rows of a log were sensed."""

    clock: Clock
    times: Floats  # (N,) of the rows that are kept [s]
    # (N,) which rows of the log these are: one of several with the same time
    kept: NDArray[np.intp]
    dt: float | None  # from row to row in the mean [s]; None of a single row


def timing_of(table: Mapping[str, NDArray[Any]], clock: Clock) -> Timing:
    """Return when the rows of a table were sensed. Raises ValueError where its clock cannot be read."""
    times = clock.seconds(table)
    again = np.concatenate([[False], np.diff(times) == 0.0])
    if again.any() and again.mean() <= MOST_DOUBLED:
        note(f"{int(again.sum())} rows have the same time as the one before, and are left out")
        kept = np.flatnonzero(~again)
    else:
        kept = np.arange(len(times))
    return Timing(clock, times[kept], kept, period(times[kept]))


def recordings(times: Floats) -> list[tuple[int, int]]:
    """Return the stretches of rows, half-open, between which time (T,) goes back or leaps: each is a recording."""
    steps = np.diff(times)
    usual = float(np.median(steps)) if len(steps) else 0.0
    cuts = np.flatnonzero((steps < 0) | (steps > MOST_LOST * len(times) * usual + 600)) + 1
    if usual <= 0 or not len(cuts) or len(cuts) > max(1, MOST_CUTS * len(times)):
        return [(0, len(times))]
    return [(a, b) for a, b in pairwise([0, *cuts.tolist(), len(times)]) if b - a > 1]


def period(times: Floats) -> float | None:
    """Return the seconds from row to row in the mean, lost rows counted; None of fewer than two rows."""
    if len(times) < 2:
        return None
    if not np.isfinite(times).all():
        row = int(np.argmin(np.isfinite(times)))
        raise ValueError(
            f"time must be a number in every row, got {times[row]} in row {row}: --rate HZ goes without"
        )
    steps = np.diff(times)
    if not np.all(steps > 0):
        row = int(np.argmin(steps > 0)) + 1
        raise ValueError(
            f"time must increase from row to row, got {times[row - 1]:g} s before {times[row]:g} s: cut the log there, "
            "choose another clock with --clock NAME, or say --rate HZ"
        )
    median = float(np.median(steps))
    counts = np.rint(steps / median)
    near = counts >= 1
    if np.mean(near & (np.abs(steps / median - counts) <= NEARLY)) >= MOSTLY:
        mean = float(steps[near].sum() / counts[near].sum())
    else:
        mean = float(steps[steps <= FAR * median].mean())
    # stamps jitter, and rates that differ by rounding would be two rates
    return float(f"{mean:.6g}")


def evenly(rows: Floats, times: Floats, dt: float) -> Floats:
    """Return rows (T, D) as rows that are ``dt`` [s] apart, NaN where one was lost; unchanged where they are."""
    steps = np.diff(times) / dt
    whole = np.rint(steps)
    size = int(np.sum(steps)) + 1
    if size > MOST_LOST * len(times) + 600 / dt:
        gap = int(np.argmax(steps))
        raise ValueError(
            f"time jumps by {steps[gap] * dt:g} s after {times[gap]:g} s: cut the log there"
        )
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
    unknown = (
        (times[after] - times[after - 1] > far) & (times[after] != due) & (times[after - 1] != due)
    )
    interpolated = np.column_stack([np.interp(due, times, column) for column in rows.T])
    interpolated[unknown] = np.nan
    return interpolated


def bridge_of(seconds: float | None, dt: float) -> float:
    """Return for how long something may be missing [s]: two rows of ``dt`` [s], where nobody says it."""
    return BRIDGED_ROWS * dt if seconds is None else seconds


class Bridge:
    """Tell which rows (D,), ``dt`` [s] apart, are bridged: those with numbers missing for at most ``seconds``."""

    def __init__(self, seconds: float, dt: float, size: int) -> None:
        self.seconds, self.dt = check_number("bridge", seconds, low=0.0), dt
        self._spent = np.zeros(size)

    def over(self, missing: NDArray[np.bool_]) -> bool:
        """Tell whether the next row (D,) lacks a number, and none for longer than it may be missing."""
        paid = np.maximum(self._spent - PAID_BACK * self.dt, 0.0)
        self._spent = np.where(missing, self._spent + self.dt, paid)
        return bool(missing.any() and (self._spent[missing] <= self.seconds * (1 + 1e-9)).all())


def bridged(stream: Rows, dt: float, seconds: float) -> NDArray[np.bool_]:
    """Return which rows (T,) of a recording (T, D) a bridge of so many seconds goes over."""
    bridge = Bridge(seconds, dt, stream.shape[1])
    return np.array([bridge.over(missing) for missing in np.isnan(stream)], np.bool_)


def filled(stream: NDArray[np.float32], dt: float, seconds: float) -> NDArray[np.float32]:
    """Return a recording (T, D) with gaps of at most so many seconds interpolated between their neighbours."""
    most, out = int(seconds / dt + 1e-9), stream.copy()
    for column in out.T:
        for start, stop in spans(np.isnan(column)):
            if start and stop < len(column) and stop - start <= most:
                ends = [start - 1, stop]
                column[start:stop] = np.interp(np.arange(start, stop), ends, column[ends])
    return out


def reason(row: Rows) -> str:
    """Say why a row (D,) whose surprise is over the threshold is an alarm."""
    if np.isnan(row).any():
        return MISSING
    return SURPRISING if np.isfinite(row).all() else NOT_FINITE


def blamed(row: Rows, shares: Rows) -> int | None:
    """Return the number of a row (D,) that an alarm points to, by their shares (D,); None where all are missing."""
    if np.isnan(row).all():
        return None
    broken = ~np.isfinite(row)
    return int(np.argmax(broken)) if broken.any() else int(np.argmax(shares))
