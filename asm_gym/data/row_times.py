"""When rows of a log were sensed: its rate, and rows put where they belong in time, with those that were lost as NaN.

n_i = (t_i - t_{i-1})/dt       dt: the mean step, gaps left out
near whole numbers   a row keeps its values and stands n_i places after the one before; places between are NaN
elsewhere            values between two stamps are interpolated; where these are far apart, NaN
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from asm_gym.data.reader_notes import note

Column = NDArray[np.generic]

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


def increasing(times: Column) -> NDArray[np.intp]:
    """(N,) which rows are kept: of several with the same stamp the first, where only few are; all others."""
    again = np.concatenate([[False], np.diff(times) == 0.0])
    if not again.any() or again.mean() > MOST_DOUBLED:
        return np.arange(len(times))
    note(f"{int(again.sum())} rows have the same time as the one before, and are left out")
    return np.flatnonzero(~again)


def period(times: Column) -> float | None:
    """Seconds from row to row in the mean, lost rows counted; None of fewer than two.

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
    if np.mean((counts >= 1) & (np.abs(steps / median - counts) <= NEARLY)) >= MOSTLY:
        near = counts >= 1
        mean = float(steps[near].sum() / counts[near].sum())
    else:
        mean = float(steps[steps <= FAR * median].mean())
    return float(f"{mean:.6g}")  # stamps jitter, and rates that differ by rounding would be two rates


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
    steady = abs(float(steps.sum() / max(whole.sum(), 1)) - 1) <= DRIFT
    if steady and np.all(whole >= 1) and np.all(np.abs(steps - whole) <= JITTER):
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
