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
    ChangeLayout,
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
# λ of leverage: inputs that are constant, or copies of others, have no endless one
LEAST_VARIANCE = 1e-4
HELD_OUT = 5  # the last one in so many rows is held out
# Standard deviations to which errors are clipped when penalties of ``specialise`` are compared.
LARGEST_ERROR = 3.0


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


def conditional(rows: Moments, penalty: float, layout: ChangeLayout) -> Floats:
    """Return D (X, I) for a penalty λ."""
    columns = layout.columns
    P = (rows.vectors / (np.maximum(rows.values, 0.0) + penalty)) @ rows.vectors.T
    D = np.zeros((len(columns), len(P)))
    for group in layout.group_masks:
        own = columns[group]
        D[group] = -np.linalg.solve(P[np.ix_(own, own)], P[own])
        D[np.ix_(group, own)] = 0.0
    D[:, -1] = rows.mean[columns] - D[:, :-1] @ rows.mean[:-1]
    return D


def check_inputs(count: int) -> None:
    """Refuse more inputs than can be weighed against each other. Raises ValueError."""
    if count > MOST_INPUTS:
        raise ValueError(
            f"a memory takes at most {MOST_INPUTS} inputs (values, changes, actions, rows), but "
            f"this stream makes {count}: leave channels out, or reduce them first"
        )


def inverse_of(a: Array, layout: ChangeLayout) -> tuple[Array, Array]:
    """Return R (I, I) and Q (X, X) of ``Association`` from rows (N, I)."""
    ordered = np.take(a, layout.changes_last, axis=1).astype(np.float64)
    C = gram(ordered) / len(ordered) + LEAST_VARIANCE * np.eye(layout.inputs)
    R = np.linalg.inv(np.linalg.cholesky(C))
    X = len(layout.groups)
    of_changes = R[-X:, -X:]
    Q = np.zeros((X, X))
    for group in layout.group_masks:
        Q[group] = np.linalg.qr(of_changes[:, group])[0].T
    return R.astype(np.float32), Q.astype(np.float32)


def learn_linear(a: Array, layout: ChangeLayout) -> NDArray[np.float32]:
    """Return D (X, I) learned from rows (N, I) of whole episodes."""
    fresh = np.asarray(held_out(a), np.float64)
    shown = moments(a[: max(len(a) - len(fresh), 1)])
    costs = []
    for penalty in PENALTIES:
        expected = along(fresh, conditional(shown, penalty, layout))
        squares = (fresh[:, layout.changes] - expected) ** 2
        costs.append(np.maximum(np.mean(squares, axis=0), EXACT))
    # (X,) counted from the end: of equals the largest
    best = np.argmin(costs[::-1], axis=0)
    everything = moments(a)
    D = np.zeros((len(best), layout.inputs), np.float32)
    for n in np.unique(best):
        D[best == n] = conditional(everything, PENALTIES[-1 - n], layout)[best == n]
    return D


def learn_from_past(a: Array, layout: ChangeLayout) -> NDArray[np.float32]:
    """Return D (X, I) learned from few rows (N, I), without synapses from other senses' present changes."""
    one_group = layout._replace(groups=np.zeros_like(layout.groups))
    return conditional(moments(a), FEW_PENALTY, one_group).astype(np.float32)


def held_out(a: Array) -> Array:
    """Return the last fifth of the rows; all of fewer than five."""
    if len(a) < HELD_OUT:
        return a
    return a[len(a) - len(a) // HELD_OUT :]


def specialise(known: Association, a: Array, layout: ChangeLayout) -> Association:
    """Return the association that has also learned inputs (N, I)."""
    exists = synapses(layout)
    delta = np.ascontiguousarray(a[:, layout.changes])
    f = hidden_units(a, known.V)
    left = (delta - complete(f, a, known.U, known.D)) / known.remainder
    D = known.D.copy()
    U = known.U.copy()
    for group in layout.group_masks:
        read = exists.D[group][0] > 0
        units = exists.U[group][0] > 0
        added = _ridge_towards_known(np.hstack([a[:, read], f[:, units]]), left[:, group])
        added *= known.remainder[group, None]
        inputs = np.count_nonzero(read)
        D[np.ix_(group, read)] += added[:, :inputs]
        U[np.ix_(group, units)] += added[:, inputs:]

    fresh = len(held_out(a))
    f = f[-fresh:]
    a = a[-fresh:]
    error = (delta[-fresh:] - complete(f, a, U, D)) / known.remainder
    if len(known.R):
        far = leverage(a, known.R, known.Q, layout.groups, layout.changes_last)
        steady, slope, most = known.leverage_scale
        error /= np.sqrt(steady + slope * np.minimum(far, most))
    # The body's memory knows how errors differ between contexts; the policy's rows tell how large
    # they are overall.
    expected = log_variance(f, known.W_S, known.b_S, known.span_S)
    ratio = np.mean(error**2 * np.exp(-expected), axis=0)
    larger = np.log(np.maximum(ratio, 1e-6)).astype(np.float32)
    span_S = np.clip(known.span_S + larger, SMALLEST, LARGEST)
    return known._replace(D=D, U=U, b_S=known.b_S + larger, span_S=span_S)


def _ridge_towards_known(inputs: Array, left: Array) -> NDArray[np.float32]:
    """Return (X, J) to add to the weights of inputs (N, J), which leave (N, X); 0 where held-out rows ask for none."""
    exact = np.asarray(inputs, np.float64)
    target = np.asarray(left, np.float64)
    fresh = len(held_out(inputs))
    shown = max(len(inputs) - fresh, 1)
    costs = []
    for weights in _ridges(exact[:shown], target[:shown]):
        error = target[-fresh:] - exact[-fresh:] @ weights.T
        clipped = np.clip(error, -LARGEST_ERROR, LARGEST_ERROR)
        costs.append(np.mean(clipped**2, axis=0))
    best = np.argmin(costs, axis=0)  # (X,)
    final = np.array(_ridges(exact, target))
    return final[best, np.arange(len(best))].astype(np.float32)


def _ridges(inputs: Floats, target: Floats) -> list[Floats]:
    """Return weights (X, J) of zero, then those for each penalty."""
    values, vectors = np.linalg.eigh(inputs.T @ inputs / len(inputs))
    projected = vectors.T @ (inputs.T @ target) / len(inputs)  # (J, X)
    weights = [np.zeros((target.shape[1], inputs.shape[1]))]
    for penalty in PENALTIES:
        scale = np.maximum(values, 0.0) + penalty
        weights.append((vectors @ (projected / scale[:, None])).T)
    return weights
