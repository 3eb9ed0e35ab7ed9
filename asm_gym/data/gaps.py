"""Bridge numbers that are missing for a moment; for longer, they are an alarm.

    spent_i    + dt while number i is missing, - 0.1 dt while it is there, at least 0     [s]
    bridged    spent_i <= ``seconds`` for all that are missing in a row

A row that is bridged is not judged. A number that is missing again and again counts in the end.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from asm_gym.readings import spans
from asm_gym.validation import check_number

Floats = NDArray[np.floating[Any]]

BRIDGED_ROWS = 2  # rows that are bridged where nobody says for how long
PAID_BACK = 0.1  # of a second that is whole, how much may be missing for good: a tenth of all rows
SURPRISING, MISSING, NOT_FINITE, LATE = "surprise", "missing data", "not finite", "late"  # why there is an alarm


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


def bridged(stream: Floats, dt: float, seconds: float) -> NDArray[np.bool_]:
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


def reason(row: Floats) -> str:
    """Say why a row (D,) whose surprise is over the threshold is an alarm."""
    if np.isnan(row).any():
        return MISSING
    return SURPRISING if np.isfinite(row).all() else NOT_FINITE


def blamed(row: Floats, shares: Floats) -> int | None:
    """Return the number of a row (D,) that an alarm points to, by their shares (D,); None where all are missing."""
    if np.isnan(row).all():
        return None
    broken = ~np.isfinite(row)
    return int(np.argmax(broken)) if broken.any() else int(np.argmax(shares))
