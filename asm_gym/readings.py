"""What readings show of a sensor: its white noise, and the steps in which it speaks.

    σ    the median of third differences / (0.6745 √20)
    δ    the smallest change between two rows, if nearly all other changes are whole multiples of it, else 0

A quantised channel at rest repeats itself, and is healthy; noise below δ cannot be seen in it. Its rounding has the
spread δ/√12 (Widrow and Kollar 2008, Quantization noise).
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

FEWEST_CHANGES = 10  # from which a step can be told
MOST_CHANGES = 0.95  # so large a share of them must be whole multiples of the step
NEARLY_MULTIPLE = 0.1  # of a step, by which a whole multiple may be missed
LOOSEST_MULTIPLE = 0.25  # however large the rounding is
# Most changes must be of fewer steps than this, as every number is near a multiple of a small step.
COARSE = 200.0


def resolution(values: NDArray[Any]) -> float:
    """Return δ of readings (T,), in their unit; 0 where no steps can be told."""
    known = values[np.isfinite(values)].astype(np.float64)
    if len(known) < FEWEST_CHANGES:
        return 0.0
    largest = np.float32(np.abs(known).max())
    rounding = float(np.spacing(largest))
    differences = np.abs(np.diff(known))
    changes = differences[differences > 2 * rounding]
    if len(changes) < FEWEST_CHANGES:
        return 0.0

    is_smallest = changes < 1.5 * changes.min()
    step = _median(changes[is_smallest])
    ratios = changes / step
    if _median(ratios) > COARSE:
        return 0.0
    tolerance = NEARLY_MULTIPLE + 2 * rounding / step + 1e-3 * ratios
    tolerance = np.minimum(tolerance, LOOSEST_MULTIPLE)
    deviations = np.abs(ratios - np.rint(ratios))
    multiples = np.count_nonzero(deviations <= tolerance)
    if multiples / len(ratios) < MOST_CHANGES:
        return 0.0
    return float(f"{step:.4g}")


def noise_of(values: NDArray[Any]) -> float:
    """Return the standard deviation of the white part of a signal (T,), from its third differences.

    Third differences of white noise have 20 times its variance, those of a smooth signal are small. Source: Gasser,
    Sroka and Jennen-Steinmetz 1986 for noise by differences.
    """
    known = values[np.isfinite(values)].astype(np.float64)
    if len(known) < 8:
        return 0.0
    third_differences = np.abs(np.diff(known, 3))
    spread = _median(third_differences) / 0.6745 / np.sqrt(20)
    return float(f"{spread:.3g}")


def _median(values: NDArray[np.float64]) -> float:
    """Return the median of finite numbers; ``np.median`` takes ten times as long for so few."""
    ordered = np.sort(values)
    half = len(values) // 2
    if len(values) % 2:
        return float(ordered[half])
    return float((ordered[half - 1] + ordered[half]) / 2.0)


def spans(mask: NDArray[np.bool_]) -> list[tuple[int, int]]:
    """Return the runs of True in ``mask`` (T,), as half-open [start, stop) steps."""
    padded = np.concatenate([[False], mask, [False]])  # (T + 2,)
    edges = np.flatnonzero(padded[1:] != padded[:-1])
    return [(start, stop) for start, stop in edges.reshape(-1, 2).tolist()]
