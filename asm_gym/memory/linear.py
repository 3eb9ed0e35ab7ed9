"""The linear part of association, known in closed form: each group of senses given all else, as a Gaussian has it.

    C = E[(a_t - m)(a_t - m)ᵀ]     P = (C + λ I)⁻¹        a_t: the inputs of association, the changes among them
    Δ̂_g = m_g + D_g (a_t - m),     D_g = -P_gg⁻¹ P_g·      0 from g itself

One inverse serves every group: D_g is the ridge regression of group g on everything else. λ is chosen for each sense by
the error that it leaves in rows that C has not seen, and D then follows from all rows. From few rows it is given, and
D reads the past and the command alone. ``learn_by_delta`` comes to D by local steps, as far as their number allows.

Sources: Besag 1975 (parts given the rest) and Lauritzen 1996 for conditionals of a Gaussian; Hoerl and Kennard 1970 for
ridge regression.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.linalg.blas import dgemm, dsyrk

from asm_gym.memory.energy import Array, outward
from asm_gym.memory.learning import Synapse, coincidence, cosine_decay, shuffled

Floats = NDArray[np.float64]

PENALTIES = 10.0 ** np.arange(-8, 3)
"""λ, in units of the variance of a standardised input."""

EXACT = 1e-8
"""Mean squared error of a standardised change below which one penalty is as good as another."""

MOST_INPUTS = 8192
"""C of these takes 0.5 GiB, and its eigenvectors minutes."""

FEW_PENALTY = 1e-4
"""λ where rows are too few to choose it by: the last of them may all be of one skill, and then ask for far too much."""

DELTA_RATE, DELTA_BATCH, DELTA_PASSES = 3e-3, 256, 200
"""Of the delta rule: the largest change of a synapse in a step, rows of a step, passes over all rows."""

HELD_OUT = 5
"""One in so many rows, the last ones, shows what was learned from the others is worth."""


class Moments(NamedTuple):
    """What rows have in common."""

    mean: Floats  # (I,)
    values: Floats  # (I,) eigenvalues of C
    vectors: Floats  # (I, I) its eigenvectors, one a column


def gram(a: Floats) -> Floats:
    """aᵀ a (I, I) for rows (N, I), by SciPy's BLAS: NumPy's takes four times as long on a processor newer than it."""
    upper: Floats = np.triu(dsyrk(1.0, a.T))
    return upper + np.triu(upper, 1).T


def along(a: Floats, W: Floats) -> Floats:
    """a @ W.T: (N, P) from (N, Q), by SciPy's BLAS too."""
    found: Floats = dgemm(1.0, W.T, a.T, trans_a=True).T
    return found


def moments(a: Array) -> Moments:
    """Of rows (N, I)."""
    centred = np.array(a, np.float64)
    mean = centred.mean(axis=0)
    centred -= mean
    return Moments(mean, *np.linalg.eigh(gram(centred) / len(centred)))


def conditional(found: Moments, penalty: float, groups: NDArray[np.intp], changes: slice) -> Floats:
    """D (X, I), of which the last column is what makes the means agree.

    Args:
        found: of the inputs, of which the last is a constant 1.
        penalty: λ > 0.
        groups: (X,) the group of each change, counted from 0.
        changes: where the changes stand among the inputs.
    """
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
    """Raises ValueError where there are too many to weigh each against every other."""
    if count > MOST_INPUTS:
        raise ValueError(
            f"every number of a stream is weighed against every other here, at most {MOST_INPUTS} of them (values, "
            f"changes, actions, rows), but this stream makes {count}: leave channels out, or reduce them before"
        )


def learn_linear(a: Array, groups: NDArray[np.intp], changes: slice) -> NDArray[np.float32]:
    """D (X, I) from N rows (N, I) of whole episodes, one after another; the other arguments as in ``conditional``."""
    fresh = np.asarray(tried_on(a), np.float64)
    shown = moments(a[: max(len(a) - len(fresh), 1)])
    left = []
    for penalty in PENALTIES:
        error = fresh[:, changes] - along(fresh, conditional(shown, penalty, groups, changes))
        left.append(np.maximum(np.mean(error**2, axis=0), EXACT))
    best = np.argmin(np.array(left)[::-1], axis=0)  # (X,) of equals the greatest, so counted from the end
    everything, D = moments(a), np.zeros((len(groups), a.shape[1]))
    for n, penalty in enumerate(PENALTIES[::-1]):
        if np.any(best == n):
            D[best == n] = conditional(everything, penalty, groups, changes)[best == n]
    return D.astype(np.float32)


def learn_from_past(a: Array, changes: slice) -> NDArray[np.float32]:
    """D (X, I) from few rows (N, I): no change reads what another sense does now, as if all were of one group."""
    one_group = np.zeros(len(np.arange(a.shape[1])[changes]), np.intp)
    return conditional(moments(a), FEW_PENALTY, one_group, changes).astype(np.float32)


def tried_on(a: Array) -> Array:
    """The last rows, which what was learned from the others is tried on; all, where there are fewer than five."""
    return a[len(a) - len(a) // HELD_OUT :] if len(a) >= HELD_OUT else a


def learn_by_delta(a: Array, changes: slice, exists: Array, rng: np.random.Generator) -> NDArray[np.float32]:
    """D (X, I) from N rows (N, I) in random order, each synapse by what its own two ends do (Widrow and Hoff 1960).

    Args:
        changes: where what is to be predicted stands among the inputs.
        exists: (X, I) 1 where there is a synapse.
    """
    D = np.zeros(exists.shape, np.float32)
    synapse, updates = Synapse(D), DELTA_PASSES * len(a) // DELTA_BATCH
    for n, rows in zip(range(updates), shuffled(len(a), DELTA_BATCH, rng), strict=False):
        seen = a[rows]
        error = np.ascontiguousarray(seen[:, changes]) - outward(seen, D)
        synapse.learn(coincidence(error, seen) * exists, cosine_decay(DELTA_RATE, n / updates))
    return D
