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

FEWEST, MOSTLY, NEARLY, COARSE = 10, 0.95, 0.1, 200.0
"""A step is told from so many changes on; so large a share of them must be whole multiples of it, within so many steps;
and most must be fewer steps apart than the last, for every number is near a multiple of a small step."""


def resolution(values: NDArray[Any]) -> float:
    """Return δ of readings (T,), in their unit; 0 where no steps can be told."""
    known = values[np.isfinite(values)].astype(np.float64)
    changes = np.abs(np.diff(known))
    rounding = float(np.spacing(np.float32(np.abs(known).max()))) if len(known) else 0.0
    changes = changes[changes > 2 * rounding]
    if len(changes) < FEWEST:
        return 0.0
    step = _median(changes[changes < 1.5 * changes.min()])
    ratios = changes / step
    if _median(ratios) > COARSE:
        return 0.0
    tolerance = NEARLY + 2 * rounding / step + 1e-3 * ratios
    near = np.abs(ratios - np.rint(ratios)) <= np.minimum(tolerance, 0.25)
    return float(f"{step:.4g}") if np.count_nonzero(near) / len(near) >= MOSTLY else 0.0


def noise_of(values: NDArray[Any]) -> float:
    """Return the standard deviation of the white part of a signal (T,), from its third differences.

    Third differences of white noise have 20 times its variance, those of a smooth signal are small. Source: Gasser,
    Sroka and Jennen-Steinmetz 1986 for noise by differences.
    """
    known = values[np.isfinite(values)].astype(np.float64)
    if len(known) < 8:
        return 0.0
    return float(f"{_median(np.abs(np.diff(known, 3))) / 0.6745 / np.sqrt(20):.3g}")


def _median(values: NDArray[np.float64]) -> float:
    """Return the median of finite numbers; ``np.median`` takes ten times as long for so few."""
    ordered, half = np.sort(values), len(values) // 2
    return float(ordered[half] if len(values) % 2 else (ordered[half - 1] + ordered[half]) / 2.0)


def spans(mask: NDArray[np.bool_]) -> list[tuple[int, int]]:
    """Return the runs of True in ``mask`` (T,), as half-open [start, stop) steps."""
    edges = np.diff(np.concatenate([[0], np.asarray(mask, np.int8), [0]]))  # (T + 1,)
    return list(
        zip(np.flatnonzero(edges == 1).tolist(), np.flatnonzero(edges == -1).tolist(), strict=True)
    )
