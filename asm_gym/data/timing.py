"""Put the rows of a log where they belong in time.

steps                n_i = (t_i - t_{i-1})/dt, dt being the mean step without gaps
near whole numbers   a row keeps its values and stands n_i places after the one before, NaN between
elsewhere            values between two stamps are interpolated, NaN if these are far apart
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

Floats = NDArray[np.float64]

JITTER = 0.35  # share of a step by which a stamp may be off, and its row still be the one due
MOST_DRIFT = 0.011  # share by which a clock may be off the rate that is read, and no row be moved
NEARLY_WHOLE = 0.15  # how near a whole multiple of the median a step is if rows were lost
MOSTLY_WHOLE = 0.95  # share of steps that must be so near; else stamps jitter
MOST_CUTS = 0.02  # share of rows at which time may go back or leap, and the log be cut there
FAR = 2.5  # how much longer than nine in ten a step must be, so that nothing in it is known
MOST_TIMES_LOST = 4  # a log may have lost so many times its rows, or ten minutes
LEAP_S = 600.0  # ten minutes: a longer step may be of a clock that was set anew [s]


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
    steps = np.diff(times.seconds, prepend=np.nan)
    repeats = steps == 0.0
    if repeats.mean() > MOST_REPEATED:
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
    steps = np.diff(times)
    if not len(steps):
        return whole
    median = float(np.median(steps))
    if not median > 0:
        return whole

    longest = MOST_TIMES_LOST * size * median + LEAP_S
    is_cut = (steps < 0) | (steps > longest)
    cuts = np.flatnonzero(is_cut) + 1
    most_cuts = max(1, MOST_CUTS * size)
    if not 1 <= len(cuts) <= most_cuts:
        return whole
    stretches = pairwise([0, *cuts.tolist(), size])
    return [(start, stop) for start, stop in stretches if stop - start > 1]


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
    ratios = steps / median
    counts = np.rint(ratios)
    is_counted = counts >= 1
    is_whole = np.abs(ratios - counts) <= NEARLY_WHOLE
    if np.mean(is_counted & is_whole) >= MOSTLY_WHOLE:
        rows = counts[is_counted].sum()
        mean = steps[is_counted].sum() / rows
    else:
        mean = steps[steps <= FAR * median].mean()
    return float(f"{mean:.6g}")  # rates that differ by rounding would be two rates


def _check_increasing(times: Floats) -> None:
    """Raise ValueError unless times are finite and increase."""
    not_finite = np.flatnonzero(~np.isfinite(times))
    if len(not_finite):
        row = not_finite[0]
        raise ValueError(
            f"time must be a number in every row, got {times[row]} in row {row}: --rate HZ goes "
            "without"
        )
    not_rising = np.flatnonzero(np.diff(times) <= 0)
    if len(not_rising):
        row = not_rising[0]
        raise ValueError(
            f"time must increase from row to row, got {times[row]:g} s before "
            f"{times[row + 1]:g} s: cut the log there, choose another clock with --clock NAME, or "
            "say --rate HZ"
        )


def evenly(rows: Floats, times: Floats, dt: float) -> Floats:
    """Return rows that are ``dt`` apart, NaN where one was lost.

    Args:
        rows: (T, D).
        times: (T,) when they were sensed [s].
        dt: time from row to row [s].

    Raises:
        ValueError: time leaps.
    """
    steps = np.diff(times) / dt
    length = steps.sum()
    size = int(length) + 1
    if size > MOST_TIMES_LOST * len(times) + LEAP_S / dt:
        leap = int(np.argmax(steps))
        raise ValueError(
            f"time jumps by {steps[leap] * dt:g} s after {times[leap]:g} s: cut the log there"
        )
    counts = np.rint(steps)
    drift = length / max(counts.sum(), 1) - 1
    is_near = (counts >= 1) & (np.abs(steps - counts) <= JITTER)
    if abs(drift) <= MOST_DRIFT and is_near.all():
        return _placed(rows, np.concatenate([[0], counts]).cumsum(dtype=np.intp))
    due = times[0] + dt * np.arange(size)
    return _interpolated(rows, times, due, dt)


def _placed(rows: Floats, places: NDArray[np.intp]) -> Floats:
    """Return rows (T, D) at their places (T,), NaN between them."""
    placed = np.full((places[-1] + 1, rows.shape[1]), np.nan)
    placed[places] = rows
    return placed


def _interpolated(rows: Floats, times: Floats, due: Floats, dt: float) -> Floats:
    """Return rows (N, D) at the times (N,) at which they are due, NaN within gaps."""
    nine_in_ten = float(np.quantile(np.diff(times), 0.9))
    longest = FAR * max(dt, nine_in_ten)
    after = np.searchsorted(times, due)
    after = np.clip(after, 1, len(times) - 1)
    next_stamp = times[after]
    last_stamp = times[after - 1]
    at_stamp = (next_stamp == due) | (last_stamp == due)
    in_gap = next_stamp - last_stamp > longest
    columns = [np.interp(due, times, column) for column in rows.T]
    interpolated = np.column_stack(columns)
    interpolated[in_gap & ~at_stamp] = np.nan
    return interpolated
