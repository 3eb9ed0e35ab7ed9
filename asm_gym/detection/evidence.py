"""Evidence: whitened errors accumulated over a short while, at several time scales.

    evidence   w_t = (1 - a) w_{t-1} + a ẽ_t,   w_0 = 0
               v_i = w_i² (2 - a) / (a (1 - (1 - a)^{2t}))              nominal mean 1 for white errors, for every t
    pooled     s_t = (Σ_i r_i^p)^(1/p)                                  r_i: v_i against its worst, see ``tails``

A large p lets the most surprising error decide, and several add up. ``accumulated`` serves to fit; in use the compiled
step of ``detector`` does the same.

Source: Lowry et al. 1992 (multivariate EWMA chart, its exact variance at start-up).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from asm_gym.compilation import compiled
from asm_gym.detection.base import Array, Floats

POWER = 8  # p
CONTEXT_GAIN = 0.2  # weight of the newest row in the running mean of the context
TINY = float(np.finfo(np.float64).tiny)


class Evidence(NamedTuple):
    """Evidence of B streams; never changed in place."""

    vector: Floats  # (B, G, X) w_t, for each of G gains
    context: Floats  # (B, C) running mean of the contexts
    steps: NDArray[np.int64]  # (B,) t, rows so far


def no_evidence(batch: int, gains: int, size: int, context: int = 0) -> Evidence:
    """Return w_0 for ``batch`` streams of ``size`` errors."""
    return Evidence(np.zeros((batch, gains, size)), np.zeros((batch, context)), np.zeros(batch, np.int64))


@compiled
def accumulated(whitened: Array, contexts: Array, gains: Array) -> tuple[Floats, Floats]:
    """Return w_t (T, G, X) of whitened errors ẽ_t (T, X), and the running mean of the contexts (T, C)."""
    T, X = whitened.shape
    vectors, running = np.zeros((T, len(gains), X)), np.zeros(contexts.shape)
    for t in range(T):
        before = max(t - 1, 0)  # in the first row all is still 0
        for g in range(len(gains)):
            for i in range(X):
                w = vectors[before, g, i]
                vectors[t, g, i] = w + gains[g] * (whitened[t, i] - w)
        for c in range(contexts.shape[1]):
            running[t, c] = running[before, c] + CONTEXT_GAIN * (contexts[t, c] - running[before, c])
    return vectors, running


def strength(evidence: Evidence, gains: Array) -> Floats:
    """Return v (B, G, X), the squared evidence in each error."""
    variance = gains / (2.0 - gains) * (1.0 - (1.0 - gains) ** (2 * evidence.steps[:, None]))  # (B, G) of each w_t,i
    squared: Floats = evidence.vector**2 / variance[:, :, None]
    return squared


def pool(ratios: Array) -> tuple[Floats, Floats]:
    """Return (Σ_i r_i^p)^(1/p) (B,), and each ratio's part of it (B, X), which add up to it; r >= 0."""
    greatest = np.maximum(ratios.max(axis=1, keepdims=True), TINY)
    powers = (ratios / greatest) ** POWER
    total = powers.sum(axis=1, keepdims=True)
    pooled = greatest * total ** (1.0 / POWER)
    return pooled[:, 0], pooled * (powers / np.maximum(total, TINY))
