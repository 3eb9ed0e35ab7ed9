"""When rows of a log were sensed: its rate, and rows put where they belong in time, with those that were lost as NaN.

n_i = (t_i - t_{i-1})/dt       dt: the median step
near whole numbers   a row keeps its values and stands n_i places after the one before; places between are NaN
elsewhere            values between two stamps are interpolated; where these are far apart, NaN
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Column = NDArray[np.generic]

JITTER = 0.35
"""By what share of a step a stamp may be off, and its row still be the one that was due."""

FAR = 2.5
"""How much longer than nine in ten a step must be, so that nothing in it is known."""

MOST_LOST = 4
"""A log of T rows may have lost so many times T, or ten minutes: more is a clock that was set, or two logs in one."""


def period(times: Column) -> float | None:
    """Seconds from row to row, None of fewer than two. Raises ValueError where time does not increase."""
    if len(times) < 2 or times.ndim != 1:
        return None
    stamps = times.astype(np.float64)
    if not np.isfinite(stamps).all():
        row = int(np.argmin(np.isfinite(stamps)))
        raise ValueError(f"time must be a number in every row, got {stamps[row]} in row {row}")
    steps = np.diff(stamps)
    if not np.all(steps > 0):
        row = int(np.argmin(steps > 0)) + 1
        raise ValueError(f"time must increase from row to row, got {times[row - 1]:g} s before {times[row]:g} s")
    return float(f"{np.median(steps):.6g}")  # stamps jitter, and rates that differ by rounding would be two rates


def regular(columns: dict[str, Column], times: Column, dt: float) -> dict[str, Column]:
    """The columns (T,) or (T, k) as rows that are ``dt`` [s] apart; unchanged where they are.

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
    if np.all(whole >= 1) and np.all(np.abs(steps - whole) <= JITTER):
        places = np.concatenate([[0], np.cumsum(whole)]).astype(np.intp)
        if len(places) == places[-1] + 1:
            return columns
        return {name: _placed(column, places) for name, column in columns.items()}
    due = stamps[0] + dt * np.arange(rows)
    after = np.clip(np.searchsorted(stamps, due), 1, len(stamps) - 1)
    far = FAR * max(dt, float(np.quantile(steps, 0.9)) * dt)
    lost = (stamps[after] - stamps[after - 1] > far) & (stamps[after] != due) & (stamps[after - 1] != due)
    return {name: _between(column, stamps, due, lost) for name, column in columns.items()}


def _placed(column: Column, places: NDArray[np.intp]) -> Column:
    out = np.full((places[-1] + 1, *column.shape[1:]), np.nan)
    out[places] = column
    return out


def _between(column: Column, stamps: NDArray[np.float64], due: NDArray[np.float64], lost: NDArray[np.bool_]) -> Column:
    flat = column.reshape(len(column), -1).astype(np.float64)
    out = np.column_stack([np.interp(due, stamps, flat[:, k]) for k in range(flat.shape[1])])
    out[lost] = np.nan
    return out.reshape(len(due), *column.shape[1:])


def noise_of(values: Column) -> float:
    """Standard deviation of what is white in a signal (T,), from its third differences; 0 where most repeat.

    Third differences of white noise have 20 times its variance, those of a smooth signal are small. Source: Gasser,
    Sroka and Jennen-Steinmetz 1986 for noise by differences.
    """
    known = values[np.isfinite(values)].astype(np.float64)
    if len(known) < 8:
        return 0.0
    third = np.abs(np.diff(known, 3))
    return float(f"{np.median(third) / 0.6745 / np.sqrt(20):.3g}")
