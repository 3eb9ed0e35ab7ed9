"""Specialising: what a memory of a body leaves of a policy's few episodes is regressed on what it reads and its units.

    r_t = (Δ_t - Δ̂_t)/s            what association leaves                a_t, f(h_t): as in ``association``
    ΔD, ΔU = argmin Σ (r_t - ΔD a_t - ΔU f(h_t))² + λ (‖ΔD‖² + ‖ΔU‖²)      λ = ∞: the memory stays as it is

The units stay as they are, so that a few rows are enough. λ is chosen for each sense by the error that it leaves in
rows that were not learned from, and ``learn_precision`` goes on from those.

Source: Hoerl and Kennard 1970 for ridge regression, here towards what is known and not towards 0.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from asm_gym.memory.association import Association, complete, hidden_units, synapses
from asm_gym.memory.energy import Array
from asm_gym.memory.linear import PENALTIES, tried_on
from asm_gym.memory.precision import LARGEST, SMALLEST, log_variance

WORST = 3.0
"""Standard deviations that an error counts at most where penalties are tried."""


def specialise(
    known: Association, a: Array, delta: Array, groups: NDArray[np.intp], changes: slice, size: int
) -> Association:
    """The association that also knows these rows; the one given is left as it is.

    Args:
        known: of the body.
        a: (N, I) inputs of whole episodes, one after another.
        delta: (N, X) changes, standardised.
        groups, changes, size: as in ``synapses``.
    """
    exists = synapses(groups, changes, a.shape[1], size)
    f = hidden_units(a, known.V)
    left = (delta - complete(f, a, known.U, known.D)) / known.remainder
    D, U = known.D.copy(), known.U.copy()
    for g in range(int(groups.max()) + 1):
        own = groups == g
        read, units = exists.D[own][0] > 0, exists.U[own][0] > 0
        found = _towards_known(np.hstack([a[:, read], f[:, units]]), left[:, own]) * known.remainder[own, None]
        D[np.ix_(own, read)] += found[:, : int(read.sum())]
        U[np.ix_(own, units)] += found[:, int(read.sum()) :]
    fresh = len(tried_on(a))
    f, a, delta = f[-fresh:], a[-fresh:], delta[-fresh:]
    error = (delta - complete(f, a, U, D)) / known.remainder
    # How much an error counts for in a context is the body's to say; how large errors are at all is the policy's.
    scale = np.mean(error**2 * np.exp(-log_variance(f, known.W_S, known.b_S, known.span_S)), axis=0)
    larger = np.log(np.maximum(scale, 1e-6)).astype(np.float32)
    span_S = np.clip(known.span_S + larger, SMALLEST, LARGEST)
    return known._replace(D=D, U=U, b_S=known.b_S + larger, span_S=span_S)


def _towards_known(inputs: Array, left: Array) -> NDArray[np.float32]:
    """(X, J) to be added to the weights of inputs (N, J), which leave (N, X); 0 where fresh rows ask for nothing."""
    exact, target = np.asarray(inputs, np.float64), np.asarray(left, np.float64)
    fresh = len(tried_on(inputs))
    shown = max(len(inputs) - fresh, 1)
    tried = [np.zeros((target.shape[1], exact.shape[1])), *_ridges(exact[:shown], target[:shown])]
    lost = [np.mean(np.clip(target[-fresh:] - exact[-fresh:] @ w.T, -WORST, WORST) ** 2, axis=0) for w in tried]
    best = np.argmin(np.array(lost), axis=0)  # (X,)
    final = [tried[0], *_ridges(exact, target)]
    return np.array([final[n][x] for x, n in enumerate(best)], np.float32)


def _ridges(inputs: NDArray[np.float64], target: NDArray[np.float64]) -> list[NDArray[np.float64]]:
    """(X, J) the weights for each penalty."""
    values, vectors = np.linalg.eigh(inputs.T @ inputs / len(inputs))
    seen = vectors.T @ (inputs.T @ target) / len(inputs)  # (J, X)
    return [(vectors @ (seen / (np.maximum(values, 0.0) + penalty)[:, None])).T for penalty in PENALTIES]
