"""Adaptation: follow slow drift row by row, or learn a policy's few episodes on top of a memory of the body.

    followed      ε_t = ψ((Δ_t - Δ̂_t)/σ_t) σ_t,   n_t = ‖f(h_t)‖² + ‖a_t‖²
                  ΔU = η ε_t f(h_t)ᵀ / n_t    ΔD = η ε_t a_tᵀ / n_t
    specialised   ΔD, ΔU = argmin Σ (r_t - ΔD a_t - ΔU f(h_t))² + λ (‖ΔD‖² + ‖ΔU‖²),   r_t = (Δ_t - Δ̂_t)/s

Symbols as in ``association``. η is the share of an error that one step removes, so that learning cannot diverge. The
hidden units stay. λ is chosen for each sense on rows that were not learned; λ = ∞ leaves the memory as it is.

Sources: Nagumo and Noda 1967 (IEEE Trans. Automatic Control 12(3)) for the normalised delta rule; Hoerl and Kennard
1970 for ridge regression, here towards what is known instead of towards 0.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from asm_gym.memory.association import (
    LARGEST,
    SMALLEST,
    Association,
    Change,
    complete,
    hidden_units,
    log_variance,
    synapses,
)
from asm_gym.memory.energy import Array
from asm_gym.memory.learning import coincidence
from asm_gym.memory.linear import PENALTIES, held_out

LARGEST_ERROR = 3.0  # standard deviations to which errors are clipped when penalties are compared


def followed(association: Association, exists: Change, a: Array, delta: Array, rate: float) -> Association:
    """Return the association after a batch of inputs (B, I) and changes (B, X), ``rate`` being η in (0, 1]."""
    f = hidden_units(a, association.V)
    variance = log_variance(f, association.W_S, association.b_S, association.span_S)
    spread = association.remainder * np.exp(np.float32(0.5) * variance)
    error = np.clip(delta - complete(f, a, association.U, association.D), -spread, spread)
    error *= np.float32(rate) / (np.sum(f * f, axis=1) + np.sum(a * a, axis=1))[:, None]
    return association._replace(
        U=association.U + coincidence(error, f) * exists.U, D=association.D + coincidence(error, a) * exists.D
    )


def specialise(
    known: Association, a: Array, delta: Array, groups: NDArray[np.intp], changes: slice, size: int
) -> Association:
    """Return the association that has also learned inputs (N, I) and changes (N, X); the rest as in ``synapses``."""
    exists = synapses(groups, changes, a.shape[1], size)
    f = hidden_units(a, known.V)
    left = (delta - complete(f, a, known.U, known.D)) / known.remainder
    D, U = known.D.copy(), known.U.copy()
    for g in range(int(groups.max()) + 1):
        own = groups == g
        read, units = exists.D[own][0] > 0, exists.U[own][0] > 0
        found = _ridge_towards_known(np.hstack([a[:, read], f[:, units]]), left[:, own]) * known.remainder[own, None]
        D[np.ix_(own, read)] += found[:, : int(read.sum())]
        U[np.ix_(own, units)] += found[:, int(read.sum()) :]
    fresh = len(held_out(a))
    f, a, delta = f[-fresh:], a[-fresh:], delta[-fresh:]
    error = (delta - complete(f, a, U, D)) / known.remainder
    # The body's memory knows how errors differ between contexts; the policy's rows tell how large they are overall.
    scale = np.mean(error**2 * np.exp(-log_variance(f, known.W_S, known.b_S, known.span_S)), axis=0)
    larger = np.log(np.maximum(scale, 1e-6)).astype(np.float32)
    span_S = np.clip(known.span_S + larger, SMALLEST, LARGEST)
    return known._replace(D=D, U=U, b_S=known.b_S + larger, span_S=span_S)


def _ridge_towards_known(inputs: Array, left: Array) -> NDArray[np.float32]:
    """Return (X, J) to add to the weights of inputs (N, J), which leave (N, X); 0 where held-out rows ask for none."""
    exact, target = np.asarray(inputs, np.float64), np.asarray(left, np.float64)
    fresh = len(held_out(inputs))
    shown = max(len(inputs) - fresh, 1)
    tried = [np.zeros((target.shape[1], exact.shape[1])), *_ridges(exact[:shown], target[:shown])]
    errors = (np.clip(target[-fresh:] - exact[-fresh:] @ w.T, -LARGEST_ERROR, LARGEST_ERROR) for w in tried)
    best = np.argmin(np.array([np.mean(error**2, axis=0) for error in errors]), axis=0)  # (X,)
    final = [tried[0], *_ridges(exact, target)]
    return np.array([final[n][x] for x, n in enumerate(best)], np.float32)


def _ridges(inputs: NDArray[np.float64], target: NDArray[np.float64]) -> list[NDArray[np.float64]]:
    """Return the weights (X, J) for each penalty."""
    values, vectors = np.linalg.eigh(inputs.T @ inputs / len(inputs))
    seen = vectors.T @ (inputs.T @ target) / len(inputs)  # (J, X)
    return [(vectors @ (seen / (np.maximum(values, 0.0) + penalty)[:, None])).T for penalty in PENALTIES]
