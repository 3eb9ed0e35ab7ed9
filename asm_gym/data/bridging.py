"""Bridge numbers that are missing for a moment.

spent_i    + dt while number i is missing, - 0.1 dt while it is there, at least 0 [s]
bridged    spent_i <= ``seconds`` for all that are missing in a row: it is not judged
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from asm_gym.readings import spans
from asm_gym.validation import check_number

BRIDGED_ROWS = 2  # rows that are bridged if nobody says for how long
PAID_BACK = 0.1  # share of rows that may be missing for good without an alarm


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

    def goes_over(self, missing: NDArray[np.bool_]) -> bool:
        """Return whether the next row lacks numbers (D,), and none for longer than it may."""
        spent = self._spent + self.dt
        paid_back = np.maximum(self._spent - PAID_BACK * self.dt, 0.0)
        self._spent = np.where(missing, spent, paid_back)
        longest = self.seconds * (1 + 1e-9)
        is_short = self._spent[missing] <= longest
        return bool(missing.any() and is_short.all())


def bridged(stream: NDArray[np.floating[Any]], dt: float, seconds: float) -> NDArray[np.bool_]:
    """Return which rows (T,) of a recording (T, D) a bridge of so many seconds goes over."""
    bridge = Bridge(seconds, dt, stream.shape[1])
    is_bridged = [bridge.goes_over(missing) for missing in np.isnan(stream)]
    return np.array(is_bridged, np.bool_)


def filled(stream: NDArray[np.float32], dt: float, seconds: float) -> NDArray[np.float32]:
    """Return a recording (T, D) with gaps of at most so many seconds interpolated."""
    longest = int(seconds / dt + 1e-9)
    result = stream.copy()
    for column in result.T:
        for start, stop in spans(np.isnan(column)):
            is_inside = start > 0 and stop < len(column)
            is_short = stop - start <= longest
            if is_inside and is_short:
                ends = [start - 1, stop]
                column[start:stop] = np.interp(range(start, stop), ends, column[ends])
    return result
