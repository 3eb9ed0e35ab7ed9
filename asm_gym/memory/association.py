"""Association: predict the change of each group of senses from the past, the command and the other senses.

    a_t = [v_{t-1}, Δ_t, Δ_{t-1}, u_t, 1]          values before, changes now and before, the commanded action
    h_t = V a_t                                    hidden units; those of group g have no synapse from its own Δ_t
    Δ̂_t = D a_t + U f(h_t)                         group g is predicted by its own units only
    log σ²_t = W_S f(h_t) + b_S, within span_S     expected variance of the error
    g²_t = (1 + τ l_t/l̃) / (1 + τ)                 l_t: leverage of the inputs of a group, l̃: its usual value
    ε_t = (Δ_t - Δ̂_t) / (s σ_t g_t)                normalised error; s is the spread that D alone leaves

The linear part D has a closed form (``linear``). The hidden units learn what D leaves (``association_learning``).
span_S are the limits of nominal contexts, and g grows up to the greatest leverage of nominal rows only, so that a fault
cannot excuse itself by an unusual context.

Leverage is the distance of the inputs from those learned from, for each group without its own changes, by one inverse:

    l_g = a_gᵀ (E[a_g a_gᵀ] + λ I)⁻¹ a_g = ‖z‖² - ‖Q_g z_Δ‖²    a_g: a without Δ_g;  z = R a;  Rᵀ R = (E[a aᵀ] + λ I)⁻¹

Sources: Whittington and Bogacz 2017 (Neural Computation 29(5)) for learning from prediction errors; Salvatori et al.
2021 (NeurIPS) for association by predictive coding; Besag 1975 for judging parts given the rest; Bishop 2006, section
3.3.2, for leverage.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from asm_gym.memory.energy import Array, activate, inner_kernel, kernel, outward

# log σ² of 0.25 % of a channel's spread, and of 55 spreads
SMALLEST, LARGEST = (
    np.float32(-12.0),
    np.float32(8.0),
)


class Association(NamedTuple):
    """The synapses of I inputs, M hidden units and X changes; float32, 0 where there is no synapse."""

    V: Array  # (M, I)
    U: Array  # (X, M)
    D: Array  # (X, I)
    W_S: Array  # (X, M)
    b_S: Array  # noqa: N815 (X,)
    span_S: Array  # noqa: N815 (2, X) limits of log σ²
    remainder: Array  # (X,) s
    R: Array  # (I, I) lower triangle, or (0, I) where leverage is not known; the changes come last
    Q: Array  # (X, X) rows Q_g: an orthonormal basis of what Δ_g adds to z_Δ, the changes' part of z
    doubt: Array  # (3, X) of g²: its value at leverage 0, its slope, and the leverage from which on it grows no more


def association_shapes(inputs: int, units: int, changes: int) -> dict[str, tuple[int, ...]]:
    """Return the shape of each array of ``Association`` by name."""
    M, X = units, changes
    precision = {"W_S": (X, M), "b_S": (X,), "span_S": (2, X), "remainder": (X,)}
    far = {"R": (inputs, inputs), "Q": (X, X), "doubt": (3, X)}
    return {"V": (M, inputs), "U": (X, M), "D": (X, inputs), **precision, **far}


def no_doubt(inputs: int, changes: int) -> dict[str, Array]:
    """Return R, Q and ``doubt`` by which g is 1 everywhere."""
    doubt = np.repeat(np.array([[1.0], [0.0], [0.0]], np.float32), changes, axis=1)
    return {
        "R": np.zeros((0, inputs), np.float32),
        "Q": np.zeros((changes, changes), np.float32),
        "doubt": doubt,
    }


class Change(NamedTuple):
    """One array for each array that predicts: the change of a batch, or a mask of the synapses that exist."""

    V: Array  # (M, I)
    U: Array  # (X, M)
    D: Array  # (X, I)


def synapses(groups: NDArray[np.intp], changes: slice, inputs: int, size: int) -> Change:
    """Return masks that are 1 where there is a synapse and 0 elsewhere.

    ``groups`` (X,) numbers the group of each change from 0, ``changes`` are the columns of the X changes among the
    ``inputs`` I, and ``size`` is the number of hidden units of a group.
    """
    unit_group = np.repeat(np.arange(groups.max() + 1), size)  # (M,)
    V, D = (
        np.ones((len(unit_group), inputs), np.float32),
        np.ones((len(groups), inputs), np.float32),
    )
    V[:, changes] = unit_group[:, None] != groups
    D[:, changes] = groups[:, None] != groups
    return Change(V, (groups[:, None] == unit_group).astype(np.float32), D)


def spans(U: Array) -> NDArray[np.intp]:
    """Return (X, 2): first and one past the last column of the synapses of each row of ``U`` (X, M)."""
    if not U.size:
        return np.zeros((len(U), 2), np.intp)
    exists = U != 0
    begins, ends = exists.argmax(axis=1), U.shape[1] - exists[:, ::-1].argmax(axis=1)
    return np.where(exists.any(axis=1)[:, None], np.stack([begins, ends], axis=1), 0).astype(
        np.intp
    )


@kernel
def hidden_units(a: Array, V: Array) -> Array:
    """Return f(h) (B, M) for inputs ``a`` (B, I)."""
    return activate(outward(a, V))


@kernel
def complete(f: Array, a: Array, U: Array, D: Array) -> Array:
    """Return Δ̂ (B, X) from hidden units ``f`` (B, M) and inputs ``a`` (B, I)."""
    out = outward(f, U)
    out += outward(a, D)
    return out


@kernel
def log_variance(f: Array, W_S: Array, b_S: Array, span_S: Array) -> Array:
    """Return log σ² (B, X) in the context ``f`` (B, M), within ``span_S`` (2, X)."""
    out = outward(f, W_S)
    for n in range(out.shape[0]):
        for i in range(out.shape[1]):
            out[n, i] = min(max(out[n, i] + b_S[i], span_S[0, i]), span_S[1, i])
    return out


def unbounded(size: int) -> Array:
    """Return the widest limits (2, X) for ``size`` X."""
    return np.repeat(np.array([[SMALLEST], [LARGEST]]), size, axis=1)


@kernel
def leverage(a: Array, R: Array, Q: Array, groups: NDArray[np.intp], first: int) -> Array:
    """Return l (B, X) of inputs (B, I), of which the X changes begin at ``first``; ``groups`` (X,) are numbered."""
    B, X, past = len(a), len(groups), a.shape[1] - len(groups)
    # squares of a group, at its number
    b, z, squares = (
        np.empty_like(a),
        np.empty_like(a),
        np.empty(X, a.dtype),
    )
    tail = np.empty((B, X), a.dtype)
    for n in range(B):  # numba takes seconds to compile an assignment to a slice
        for i in range(past):
            b[n, i] = a[n, i if i < first else i + X]
        for i in range(X):
            b[n, past + i] = a[n, first + i]
    if B > 1:
        np.dot(b, R.T, z)
    else:
        for i in range(a.shape[1]):  # each weight is read once, and no zeros
            total = np.float32(0)
            for j in range(i + 1):
                total += R[i, j] * b[0, j]
            z[0, i] = total
    for n in range(B):
        for i in range(X):
            tail[n, i] = z[n, past + i]
    out = outward(tail, Q)
    for n in range(B):
        total = np.float32(0)
        for i in range(a.shape[1]):
            total += z[n, i] * z[n, i]
        for i in range(X):
            squares[i] = total
        for i in range(X):
            squares[groups[i]] -= out[n, i] * out[n, i]
        for i in range(X):
            out[n, i] = max(squares[groups[i]], np.float32(0))
    return out


@inner_kernel
def normalised_errors(
    inputs: Array,
    changes: Array,
    whole: Array,
    V: Array,
    U: Array,
    D: Array,
    W_S: Array,
    b_S: Array,
    span_S: Array,
    remainder: Array,
    spans: NDArray[np.intp],
    R: Array,
    Q: Array,
    doubt: Array,
    groups: NDArray[np.intp],
    first: int,
) -> tuple[Array, Array]:
    """Return ε (B, X), 0 where ``whole`` (B, 1) is 0, and f(h) (B, M) for inputs (B, I) and changes (B, X)."""
    f = hidden_units(inputs, V)
    out = outward(inputs, D)
    if inputs.shape[0] > 1:
        driven = outward(f, U)
        for n in range(out.shape[0]):
            for i in range(out.shape[1]):
                out[n, i] += driven[n, i]
    else:
        for i in range(U.shape[0]):
            total = np.float32(0)
            for j in range(spans[i, 0], spans[i, 1]):
                total += f[0, j] * U[i, j]
            out[0, i] += total
    spread = log_variance(f, W_S, b_S, span_S)
    for n in range(out.shape[0]):
        for i in range(out.shape[1]):
            error = (changes[n, i] - out[n, i]) / remainder[i]
            out[n, i] = whole[n, 0] * error * np.exp(np.float32(-0.5) * spread[n, i])
    if R.shape[0]:
        far = leverage(inputs, R, Q, groups, first)
        for n in range(out.shape[0]):
            for i in range(out.shape[1]):
                out[n, i] /= np.sqrt(doubt[0, i] + doubt[1, i] * min(far[n, i], doubt[2, i]))
    return out, f
