"""Put the rows of a log where they belong in time, and bridge numbers that are missing for a moment.

steps                n_i = (t_i - t_{i-1})/dt, dt being the mean step without gaps
near whole numbers   a row keeps its values and stands n_i places after the one before, NaN between
elsewhere            values between two stamps are interpolated, NaN if these are far apart
spent_i              + dt while number i is missing, - 0.1 dt while it is there, at least 0 [s]
bridged              spent_i <= ``seconds`` for all that are missing in a row: it is not judged
"""

from __future__ import annotations

from collections.abc import Mapping
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from asm_gym.data.clock import LogClock, Times
from asm_gym.data.clock_inference import MOST_REPEATED
from asm_gym.data.reader_notes import note
from asm_gym.readings import spans
from asm_gym.validation import check_number

Floats = NDArray[np.float64]
Rows = NDArray[np.floating[Any]]

JITTER = 0.35  # share of a step by which a stamp may be off, and its row still be the one due
MOST_DRIFT = 0.011  # share by which a clock may be off the rate that is read, and no row be moved
NEARLY_WHOLE = 0.15  # how near a whole multiple of the median a step is if rows were lost
MOSTLY_WHOLE = 0.95  # share of steps that must be so near; else stamps jitter
MOST_CUTS = 0.02  # share of rows at which time may go back or leap, and the log be cut there
FAR = 2.5  # how much longer than nine in ten a step must be, so that nothing in it is known
MOST_TIMES_LOST = 4  # a log may have lost so many times its rows, or ten minutes
LEAP_S = 600.0  # ten minutes: a longer step may be of a clock that was set anew [s]
BRIDGED_ROWS = 2  # rows that are bridged if nobody says for how long
PAID_BACK = 0.1  # share of rows that may be missing for good without an alarm
TOGETHER_S = 0.5  # alarms that are no further apart have one cause [s]

# Reasons of alarms.
SURPRISING = "surprise"
MISSING_DATA = "missing data"
NOT_FINITE = "not finite"
LATE = "late"


class Timing(NamedTuple):
    """When the rows of a log were sensed."""

    times: Times  # of the rows that are kept
    kept: NDArray[np.intp]  # (N,) their numbers in the log: one of several with the same time
    dt: float | None  # mean time from row to row; None of a single row [s]


def timing_of(table: Mapping[str, NDArray[Any]], clock: LogClock) -> Timing:
    """Return when the rows of a table were sensed.

    Raises:
        ValueError: its clock cannot be read.
    """
    times = clock.times(table)
    repeats = np.diff(times.seconds, prepend=np.nan) == 0.0
    if np.mean(repeats) > MOST_REPEATED:
        repeats[:] = False
    elif repeats.any():
        note(f"{repeats.sum()} rows have the same time as the one before, and are left out")
    kept = np.flatnonzero(~repeats)
    times = times._replace(seconds=times.seconds[kept])
    return Timing(times, kept, period(times.seconds))


def recordings(times: Floats) -> list[tuple[int, int]]:
    """Return the stretches of rows, half-open, between which time (T,) goes back or leaps."""
    size = len(times)
    whole = [(0, size)]
    if size < 2:
        return whole
    steps = np.diff(times)
    median = float(np.median(steps))
    if not median > 0:
        return whole

    longest = MOST_TIMES_LOST * size * median + LEAP_S
    is_cut = (steps < 0) | (steps > longest)
    cuts = np.flatnonzero(is_cut) + 1
    if not len(cuts) or len(cuts) > max(1, MOST_CUTS * size):
        return whole
    ends = pairwise([0, *cuts.tolist(), size])
    return [(start, stop) for start, stop in ends if stop - start > 1]


def period(times: Floats) -> float | None:
    """Return the mean time from row to row, lost rows counted; None of fewer than two rows [s].

    Raises:
        ValueError: a time is not finite, or does not increase.
    """
    if len(times) < 2:
        return None
    _check_increasing(times)
    steps = np.diff(times)
    median = float(np.median(steps))
    counts = np.rint(steps / median)
    is_whole = np.abs(steps / median - counts) <= NEARLY_WHOLE
    is_counted = counts >= 1
    if np.mean(is_counted & is_whole) >= MOSTLY_WHOLE:
        mean = steps[is_counted].sum() / counts[is_counted].sum()
    else:
        mean = steps[steps <= FAR * median].mean()
    return float(f"{mean:.6g}")  # rates that differ by rounding would be two rates


def _check_increasing(times: Floats) -> None:
    """Raise ValueError unless times are finite and increase."""
    is_finite = np.isfinite(times)
    if not is_finite.all():
        row = int(np.argmin(is_finite))
        raise ValueError(
            f"time must be a number in every row, got {times[row]} in row {row}: --rate HZ goes "
            "without"
        )
    rises = np.diff(times) > 0
    if not rises.all():
        row = int(np.argmin(rises))
        raise ValueError(
            f"time must increase from row to row, got {times[row]:g} s before "
            f"{times[row + 1]:g} s: cut the log there, choose another clock with --clock NAME, or "
            "say --rate HZ"
        )


def evenly(rows: Floats, times: Floats, dt: float) -> Floats:
    """Return rows that are ``dt`` apart, NaN where one was lost; unchanged if they are so.

    Args:
        rows: (T, D).
        times: (T,) when they were sensed [s].
        dt: time from row to row [s].

    Raises:
        ValueError: time leaps.
    """
    steps = np.diff(times) / dt
    size = int(np.sum(steps)) + 1
    if size > MOST_TIMES_LOST * len(times) + LEAP_S / dt:
        gap = int(np.argmax(steps))
        raise ValueError(
            f"time jumps by {steps[gap] * dt:g} s after {times[gap]:g} s: cut the log there"
        )
    counts = np.rint(steps)
    drift = steps.sum() / max(counts.sum(), 1) - 1
    is_near = (counts >= 1) & (np.abs(steps - counts) <= JITTER)
    if abs(drift) <= MOST_DRIFT and is_near.all():
        places = np.cumsum(counts, dtype=np.intp)
        return _placed(rows, np.concatenate([[0], places]))
    due = times[0] + dt * np.arange(size)
    return _interpolated(rows, times, due, dt)


def _placed(rows: Floats, places: NDArray[np.intp]) -> Floats:
    """Return rows (T, D) at their places (T,), NaN between them."""
    size = places[-1] + 1
    if len(places) == size:
        return rows
    placed = np.full((size, rows.shape[1]), np.nan)
    placed[places] = rows
    return placed


def _interpolated(rows: Floats, times: Floats, due: Floats, dt: float) -> Floats:
    """Return rows (N, D) at the times (N,) at which they are due, NaN within gaps."""
    nine_in_ten = float(np.quantile(np.diff(times), 0.9))
    longest = FAR * max(dt, nine_in_ten)
    after = np.clip(np.searchsorted(times, due), 1, len(times) - 1)
    next_stamp = times[after]
    last_stamp = times[after - 1]
    in_gap = next_stamp - last_stamp > longest
    at_stamp = (next_stamp == due) | (last_stamp == due)
    interpolated = np.column_stack([np.interp(due, times, column) for column in rows.T])
    interpolated[in_gap & ~at_stamp] = np.nan
    return interpolated


def bridge_of(seconds: float | None, dt: float) -> float:
    """Return for how long something may be missing [s]: by default two rows of ``dt`` [s]."""
    if seconds is None:
        return BRIDGED_ROWS * dt
    return seconds


class Bridge:
    """Tell which rows are bridged: those with numbers missing for at most ``seconds``.

    Args:
        seconds: for how long a number may be missing [s].
        dt: time from row to row [s].
        size: D, numbers of a row.
    """

    def __init__(self, seconds: float, dt: float, size: int) -> None:
        self.seconds = check_number("bridge", seconds, low=0.0)
        self.dt = dt
        self._spent = np.zeros(size)

    def over(self, missing: NDArray[np.bool_]) -> bool:
        """Return whether the next row lacks numbers (D,), and none for longer than it may."""
        spent = self._spent + self.dt
        paid_back = np.maximum(self._spent - PAID_BACK * self.dt, 0.0)
        self._spent = np.where(missing, spent, paid_back)
        is_short = self._spent[missing] <= self.seconds * (1 + 1e-9)
        return bool(missing.any() and is_short.all())


def bridged(stream: Rows, dt: float, seconds: float) -> NDArray[np.bool_]:
    """Return which rows (T,) of a recording (T, D) a bridge of so many seconds goes over."""
    bridge = Bridge(seconds, dt, stream.shape[1])
    return np.array([bridge.over(missing) for missing in np.isnan(stream)], np.bool_)


def filled(stream: NDArray[np.float32], dt: float, seconds: float) -> NDArray[np.float32]:
    """Return a recording (T, D) with gaps of at most so many seconds interpolated."""
    longest = int(seconds / dt + 1e-9)
    result = stream.copy()
    for column in result.T:
        for start, stop in spans(np.isnan(column)):
            is_inside = start > 0 and stop < len(column)
            if is_inside and stop - start <= longest:
                ends = [start - 1, stop]
                column[start:stop] = np.interp(range(start, stop), ends, column[ends])
    return result


def reason(row: Rows) -> str:
    """Return why a row (D,) whose surprise is over the threshold is an alarm."""
    if np.isnan(row).any():
        return MISSING_DATA
    if np.isfinite(row).all():
        return SURPRISING
    return NOT_FINITE


def blamed(row: Rows, shares: Rows) -> int | None:
    """Return the number of a row (D,) that an alarm points to, by their shares (D,); None if all miss."""
    if np.isnan(row).all():
        return None
    broken = ~np.isfinite(row)
    if broken.any():
        return int(np.argmax(broken))
    return int(np.argmax(shares))
