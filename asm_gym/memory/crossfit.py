"""Cross-fitting: what would be expected of each row by whoever has not learned from it.

    Δ̂_n = the expectation of row n by what was learned from the two thirds of the episodes that n is not in
    c = Σ_n ψ(Δ_n) Δ̂_n / Σ_n Δ̂_n², kept within 0 and 1           how far such expectations are to be believed

Rows of one episode are much alike, so thirds are of whole episodes, drawn at random. Each row is asked once, and none
is left out of the final learning, which is from all of them.

Sources: Stone 1974 (cross-validation), Chernozhukov et al. 2018 (Econometrics Journal) for the name and the use.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

from asm_gym.memory.energy import Array

THIRDS = 3

DOUBTED = 3.0
"""Standard deviations that an error counts at most where the hidden units are tried."""

SMALLEST_SPREAD = np.float32(1e-4)
"""Of what is left of a change: below it, single precision is what is heard."""


def thirds(rows: int, lengths: Sequence[int], rng: np.random.Generator) -> NDArray[np.intp]:
    """(N,) which third each of ``rows`` is in: 0, 1 or 2.

    Args:
        rows: N.
        lengths: of the episodes, which add up to N. With fewer than three of them, thirds are of rows that follow
            each other.
    """
    if len(lengths) >= THIRDS:
        return np.repeat(rng.permutation(len(lengths)) % THIRDS, lengths)
    return np.arange(rows) * THIRDS // max(rows, 1)


def crossfit(
    expect: Callable[[NDArray[np.bool_], NDArray[np.bool_]], Array], third: NDArray[np.intp], size: int
) -> Array:
    """(N, X) what is expected of each row by what was learned from the other thirds.

    Args:
        expect: learns from the rows that a mask (N,) names, and expects (M, X) of the M rows that another one does.
        third: (N,) as ``thirds`` has it.
        size: X.
    """
    found = np.zeros((len(third), size), np.float32)
    for k in range(THIRDS):
        asked = third == k
        found[asked] = expect(~asked, asked)
    return found


def trust(left: Array, expected: Array) -> Array:
    """(X,) in [0, 1]: what share of the ``expected`` (N, X) leaves the least of what was ``left`` (N, X) to expect."""
    known = np.sum(expected**2, axis=0)
    share: Array = np.sum(np.clip(left, -DOUBTED, DOUBTED) * expected, axis=0) / np.maximum(known, SMALLEST_SPREAD)
    return np.clip(share, 0.0, 1.0).astype(np.float32)
