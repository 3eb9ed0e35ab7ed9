"""Cross-fitting: predict every row by what was learned without it.

    Δ̂_n = prediction of row n by what was learned from the two thirds of the episodes that n is not in
    c = Σ_n ψ(Δ_n) Δ̂_n / Σ_n Δ̂_n², clipped to [0, 1]               share of such predictions to believe

Rows of one episode are alike, so thirds are of whole episodes, drawn at random.

Sources: Stone 1974 (cross-validation); Chernozhukov et al. 2018 (Econometrics Journal) for the name and the use.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

from asm_gym.memory.energy import Array

THIRDS = 3

LARGEST_ERROR = 3.0
"""Standard deviations to which errors are clipped in ``trust``."""

SMALLEST_SPREAD = np.float32(1e-4)
"""Spread below which single precision is noise."""


def thirds(rows: int, lengths: Sequence[int], rng: np.random.Generator) -> NDArray[np.intp]:
    """Return the third (N,) of each row: 0, 1 or 2.

    Args:
        rows: N.
        lengths: rows of each episode. With fewer than three episodes, thirds are of consecutive rows.
        rng: draws the third of each episode.
    """
    if len(lengths) >= THIRDS:
        return np.repeat(rng.permutation(len(lengths)) % THIRDS, lengths)
    return np.arange(rows) * THIRDS // max(rows, 1)


def crossfit(
    expect: Callable[[NDArray[np.bool_], NDArray[np.bool_]], Array], third: NDArray[np.intp], size: int
) -> Array:
    """Return the prediction (N, X) of each row by what was learned from the other thirds.

    Args:
        expect: learns from the rows of one mask (N,), and predicts (M, X) the M rows of another.
        third: (N,) of ``thirds``.
        size: X.
    """
    found = np.zeros((len(third), size), np.float32)
    for k in range(THIRDS):
        asked = third == k
        found[asked] = expect(~asked, asked)
    return found


def trust(left: Array, expected: Array) -> Array:
    """Return c (X,) in [0, 1]: the share of the predictions (N, X) that leaves the least of the targets (N, X)."""
    known = np.sum(expected**2, axis=0)
    clipped = np.clip(left, -LARGEST_ERROR, LARGEST_ERROR)
    share: Array = np.sum(clipped * expected, axis=0) / np.maximum(known, SMALLEST_SPREAD)
    return np.clip(share, 0.0, 1.0).astype(np.float32)
