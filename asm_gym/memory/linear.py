"""The linear part of association in closed form: each group of senses given all else, as for a Gaussian.

    C = E[(a_t - m)(a_t - m)ᵀ]     P = (C + λ I)⁻¹        a_t: inputs of association, the changes among them
    Δ̂_g = m_g + D_g (a_t - m),     D_g = -P_gg⁻¹ P_g·      0 from g itself

One inverse serves every group. λ is chosen for each sense by its error on held-out rows; D is then computed from all
rows. ``specialise`` learns a policy's few episodes on top of a memory of the body:

    ΔD, ΔU = argmin Σ (r_t - ΔD a_t - ΔU f(h_t))² + λ (‖ΔD‖² + ‖ΔU‖²),   r_t = (Δ_t - Δ̂_t)/s

Sources: Besag 1975 and Lauritzen 1996 for conditionals of a Gaussian; Hoerl and Kennard 1970 for ridge regression.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.linalg.blas import dgemm, dsyrk

from asm_gym.memory.association import (
    LARGEST,
    SMALLEST,
    Association,
    complete,
    hidden_units,
    leverage,
    log_variance,
    synapses,
)
from asm_gym.memory.energy import Array

Floats = NDArray[np.float64]

PENALTIES = 10.0 ** np.arange(-8, 3)  # λ, in units of the variance of a standardised input
EXACT = 1e-8  # mean squared errors below this are equally good
MOST_INPUTS = 8192  # C of these takes 0.5 GiB, and its eigenvectors minutes
FEW_PENALTY = 1e-4  # λ where rows are too few to choose it
LEAST_VARIANCE = (
    1e-4  # λ of leverage: inputs that are constant, or copies of others, have no endless one
)
HELD_OUT = 5  # the last one in so many rows is held out
LARGEST_ERROR = 3.0  # standard deviations to which errors are clipped when penalties of ``specialise`` are compared


class Moments(NamedTuple):
    """Mean and covariance of rows."""

    mean: Floats  # (I,)
    values: Floats  # (I,) eigenvalues of C
    vectors: Floats  # (I, I) its eigenvectors, one a column


def gram(a: Floats) -> Floats:
    """Return aᵀ a (I, I) for rows (N, I). SciPy's BLAS is up to four times as fast as NumPy's on new processors."""
    upper: Floats = np.triu(dsyrk(1.0, a.T))
    return upper + np.triu(upper, 1).T


def along(a: Floats, W: Floats) -> Floats:
    """Return a @ W.T, (N, P) from (N, Q), by SciPy's BLAS."""
    return dgemm(1.0, W.T, a.T, trans_a=True).T


def moments(a: Array) -> Moments:
    """Return the moments of rows (N, I)."""
    centred = np.array(a, np.float64)
    mean = centred.mean(axis=0)
    centred -= mean
    return Moments(mean, *np.linalg.eigh(gram(centred) / len(centred)))


def conditional(found: Moments, penalty: float, groups: NDArray[np.intp], changes: slice) -> Floats:
    """Return D (X, I) for a penalty λ, with groups (X,) and changes as in ``association.synapses``."""
    places = np.arange(len(found.mean))[changes]  # (X,)
    P = (found.vectors / (np.maximum(found.values, 0.0) + penalty)) @ found.vectors.T
    D = np.zeros((len(places), len(P)))
    for g in range(int(groups.max()) + 1):
        own = places[groups == g]
        D[groups == g] = -np.linalg.solve(P[np.ix_(own, own)], P[own])
        D[np.ix_(groups == g, own)] = 0.0
    D[:, -1] = found.mean[places] - D[:, :-1] @ found.mean[:-1]
    return D


def check_inputs(count: int) -> None:
    """Refuse more inputs than can be weighed against each other. Raises ValueError."""
    if count > MOST_INPUTS:
        raise ValueError(
            f"a memory takes at most {MOST_INPUTS} inputs (values, changes, actions, rows), but this stream makes "
            f"{count}: leave channels out, or reduce them first"
        )


def inverse_of(a: Array, groups: NDArray[np.intp], changes: slice) -> tuple[Array, Array]:
    """Return R (I, I) and Q (X, X) of ``Association`` from rows (N, I); the rest as in ``synapses``."""
    exact, X = (
        np.hstack([a[:, : changes.start], a[:, changes.stop :], a[:, changes]]).astype(np.float64),
        len(groups),
    )
    R = np.linalg.inv(
        np.linalg.cholesky(gram(exact) / len(exact) + LEAST_VARIANCE * np.eye(exact.shape[1]))
    )
    Q = np.zeros((X, X))
    for g in range(int(groups.max()) + 1):
        Q[groups == g] = np.linalg.qr(R[-X:, -X:][:, groups == g])[0].T
    return R.astype(np.float32), Q.astype(np.float32)


def learn_linear(a: Array, groups: NDArray[np.intp], changes: slice) -> NDArray[np.float32]:
    """Return D (X, I) learned from rows (N, I) of whole episodes; other arguments as in ``conditional``."""
    fresh = np.asarray(held_out(a), np.float64)
    shown = moments(a[: max(len(a) - len(fresh), 1)])
    left = []
    for penalty in PENALTIES:
        error = fresh[:, changes] - along(fresh, conditional(shown, penalty, groups, changes))
        left.append(np.maximum(np.mean(error**2, axis=0), EXACT))
    # (X,) counted from the end: of equals the largest
    best = np.argmin(np.array(left)[::-1], axis=0)
    everything, D = moments(a), np.zeros((len(groups), a.shape[1]))
    for n, penalty in enumerate(PENALTIES[::-1]):
        if np.any(best == n):
            D[best == n] = conditional(everything, penalty, groups, changes)[best == n]
    return D.astype(np.float32)


def learn_from_past(a: Array, changes: slice) -> NDArray[np.float32]:
    """Return D (X, I) learned from few rows (N, I), without synapses from other senses' present changes."""
    one_group = np.zeros(len(np.arange(a.shape[1])[changes]), np.intp)
    return conditional(moments(a), FEW_PENALTY, one_group, changes).astype(np.float32)


def held_out(a: Array) -> Array:
    """Return the last fifth of the rows; all of fewer than five."""
    return a[len(a) - len(a) // HELD_OUT :] if len(a) >= HELD_OUT else a


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
        found = (
            _ridge_towards_known(np.hstack([a[:, read], f[:, units]]), left[:, own])
            * known.remainder[own, None]
        )
        D[np.ix_(own, read)] += found[:, : int(read.sum())]
        U[np.ix_(own, units)] += found[:, int(read.sum()) :]
    fresh = len(held_out(a))
    f, a, delta = f[-fresh:], a[-fresh:], delta[-fresh:]
    error = (delta - complete(f, a, U, D)) / known.remainder
    if len(known.R):
        far = leverage(a, known.R, known.Q, groups, changes.start)
        error /= np.sqrt(known.doubt[0] + known.doubt[1] * np.minimum(far, known.doubt[2]))
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
    errors = (
        np.clip(target[-fresh:] - exact[-fresh:] @ w.T, -LARGEST_ERROR, LARGEST_ERROR)
        for w in tried
    )
    best = np.argmin(np.array([np.mean(error**2, axis=0) for error in errors]), axis=0)  # (X,)
    final = [tried[0], *_ridges(exact, target)]
    return np.array([final[n][x] for x, n in enumerate(best)], np.float32)


def _ridges(inputs: NDArray[np.float64], target: NDArray[np.float64]) -> list[NDArray[np.float64]]:
    """Return the weights (X, J) for each penalty."""
    values, vectors = np.linalg.eigh(inputs.T @ inputs / len(inputs))
    seen = vectors.T @ (inputs.T @ target) / len(inputs)  # (J, X)
    return [
        (vectors @ (seen / (np.maximum(values, 0.0) + penalty)[:, None])).T for penalty in PENALTIES
    ]
