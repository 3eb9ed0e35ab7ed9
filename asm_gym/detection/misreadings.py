"""Readings that cannot be true: far out of the healthy range, after a step larger than any healthy one.

misread    x_t < least - m or x_t > most + m,  and  |x_t - x_{t-1}| > s       m and s: see ``commands``

The errors that such a reading makes may be no larger than those of a sense that hardly moves otherwise. A sense that
stays out of range is misread in its first row alone; one that never moved in healthy rows is not judged.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from asm_gym.detection.commands import command_limits

Floats = NDArray[np.floating[Any]]


def widened(healthy: Floats | None, other: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return the least, the most and the greatest step (3, X) of two sets of healthy rows; of one where one is None."""
    if healthy is None:
        return other
    least = np.minimum(healthy[:1], other[:1])
    largest = np.maximum(healthy[1:], other[1:])
    return np.concatenate([least, largest]).astype(np.float32)


def misread(healthy: Floats, before: Floats, rows: Floats) -> NDArray[np.bool_]:
    """Return which numbers (N, X) are misread.

    Args:
        healthy: (3, X) the least, the most and the greatest step of healthy rows.
        before: (N, X) the row before each; of a number that is not finite any step is possible.
        rows: (N, X).
    """
    least, most, largest_step = command_limits(healthy)
    is_outside = (rows < least) | (rows > most)
    step = np.abs(np.asarray(rows, np.float64) - before)
    return np.asarray(is_outside & (step > largest_step) & (healthy[2] > 0))


def without_misreadings(healthy: Floats, stream: Floats) -> Floats:
    """Return a stream (T, X) with NaN for each number that is misread; itself where none is."""
    before = np.vstack([np.full_like(stream[:1], np.nan), stream[:-1]])
    wrong = misread(healthy, before, stream)
    if not wrong.any():
        return stream
    for row in np.flatnonzero(wrong.any(axis=1)).tolist():
        if row:
            wrong[row] &= ~wrong[row - 1]
    return np.where(wrong, np.nan, stream).astype(stream.dtype)
