"""Traces: the past of senses and actions over many time scales.

    c^k_t = λ_k c^k_{t-1} + g_k r_t          r_t = [x_t, a_t, 1], standardised;  c_0 = 0

λ runs from 0, the row itself, to 0.995, which halves in 140 rows. A trace has no learned weight, so no error needs to
travel back through time. g gives all traces the same mean square.

Sources: de Vries and Principe 1992 (Neural Networks 5(4)) for leaky integrators as a memory; Shankar and Howard 2012
(Neural Computation 24(1)) for a spectrum of them as a timeline of the past.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from asm_gym.memory.energy import Array, kernel

DECAYS = np.array([0.0, 0.5, 0.75, 0.875, 0.9375, 0.97, 0.985, 0.995], np.float32)
"""λ (K,)."""

FAINTEST = 1e-3
"""Smallest root mean square of a trace that is scaled."""


@kernel
def advance(traces: Array, rows: Array, gains: Array) -> Array:
    """Return c_t (B, K R) from c_{t-1} and the rows r_t (B, R)."""
    B, R = rows.shape
    out = np.empty_like(traces)
    for n in range(B):
        for k in range(len(gains)):
            for i in range(R):
                out[n, k * R + i] = DECAYS[k] * traces[n, k * R + i] + gains[k] * rows[n, i]
    return out


def at_rest(batch: int, row: int) -> NDArray[np.float32]:
    """Return c_0 of ``batch`` streams with rows of ``row`` numbers."""
    return np.zeros((batch, len(DECAYS) * row), np.float32)


def fit_gains(episodes: Sequence[Array]) -> NDArray[np.float32]:
    """Return g (K,) that give each trace of these episodes (T, R) a mean square of 1."""
    plain = np.float32(1) - DECAYS
    ordered = sorted(episodes, key=len, reverse=True)
    squares, width = np.zeros(len(DECAYS)), ordered[0].shape[1]
    traces = at_rest(len(ordered), width)
    for t in range(len(ordered[0])):
        rows = np.array([episode[t] for episode in ordered if t < len(episode)], np.float32)
        traces = advance(traces[: len(rows)], rows, plain)
        squares += np.sum(traces.reshape(len(rows), len(DECAYS), width) ** 2, axis=(0, 2), dtype=np.float64)
    count = width * sum(len(episode) for episode in episodes)
    gains: NDArray[np.float32] = (plain / np.maximum(np.sqrt(squares / count), FAINTEST)).astype(np.float32)
    return gains
