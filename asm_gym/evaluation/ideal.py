"""What the best observer could know: a faulty episode beside its healthy twin.

The twin has the same seed, the same sensor noise and no fault, so d_t = x_t - x'_t is what the fault did to the stream.
An observer who knew both courses beforehand, and only not which of them it is in, would form the likelihood ratio
under the sensor noise σ. Its logarithm is Gaussian in both cases, N(±S/2, S), with

    S_T = Σ_{t ≤ T} Σ_i (d_ti / σ_i)²
    AUROC = Φ(√(S/2)),    power at the false-alarm rate α: Φ(√S - Φ⁻¹(1 - α))

(Neyman and Pearson 1933; Van Trees 1968, section 2.2: a known signal in white noise.) No detector does better.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.stats import norm

from asm_gym.evaluation.defaults import REPORTED_RATE

Array = NDArray[np.floating[Any]]

RESOLUTION = 1e-3
"""The noise of a channel that has none, as a share of its spread: commands are exact, but nobody foresees them so."""


def noise_floor(noise: Array, streams: list[Array]) -> NDArray[np.float64]:
    """(D,) the standard deviation that counts as noise: the sensors' own, and ``RESOLUTION`` of the nominal spread.

    Args:
        noise: (D,) of the sensors.
        streams: nominal episodes, (T, D) each.
    """
    spread = np.concatenate(streams).astype(np.float64).std(axis=0)
    floor: NDArray[np.float64] = np.maximum(np.maximum(noise, RESOLUTION * spread), 1e-9)
    return floor


def separation(faulty: Array, twin: Array, noise: Array, onset: int) -> NDArray[np.float64]:
    """(T - onset,) S from the onset up to each step; the shorter episode decides T.

    Args:
        faulty: (T, D).
        twin: (T', D), of the same seed.
        noise: (D,) standard deviations, all positive.
        onset: the first step with the fault.

    Raises:
        ValueError: the two differ before the onset, so that they are no twins.
    """
    length = min(len(faulty), len(twin))
    if not np.array_equal(faulty[: min(onset, length)], twin[: min(onset, length)]):
        raise ValueError(f"the episodes differ before the onset at step {onset}: they are not twins")
    difference = np.asarray(faulty[onset:length], np.float64) - twin[onset:length]
    # A reading that is not finite is seen at once by whoever looks.
    gain = np.where(np.isfinite(difference), (difference / noise) ** 2, np.inf).sum(axis=1)
    summed: NDArray[np.float64] = np.cumsum(gain)
    return summed


def auroc_bound(separation: Array | float) -> NDArray[np.float64]:
    """The largest AUROC that any detector can have at this S."""
    bound: NDArray[np.float64] = norm.cdf(np.sqrt(np.asarray(separation, np.float64) / 2))
    return bound


def power_bound(separation: Array | float, rate: float) -> NDArray[np.float64]:
    """The largest probability of detection at this S and false-alarm ``rate``."""
    bound: NDArray[np.float64] = norm.cdf(np.sqrt(np.asarray(separation, np.float64)) - norm.isf(rate))
    return bound


def earliest(separation: Array, rate: float = REPORTED_RATE, power: float = 0.95) -> int | None:
    """The first step since the onset at which the power reaches ``power``; None where it never does."""
    enough = np.flatnonzero(power_bound(separation, rate) >= power)
    return int(enough[0]) if enough.size else None
