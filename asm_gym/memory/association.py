"""Association: predict the change of each group of senses from the past, the command and the other senses.

    a_t = [v_{t-1}, Δ_t, Δ_{t-1}, u_t, 1]          values before, changes now and before, the commanded action
    h_t = V a_t                                    hidden units; those of group g have no synapse from its own Δ_t
    Δ̂_t = D a_t + U f(h_t)                         group g is predicted by its own units only
    log σ²_t = W_S f(h_t) + b_S, within span_S     expected variance of the error
    g²_t = (1 + τ l_t/l̃) / (1 + τ)                 l_t: leverage of the inputs of a group, l̃: its usual value
    ε_t = (Δ_t - Δ̂_t) / (s σ_t g_t)                normalised error; s is the spread that D alone leaves

The linear part D has a closed form (``linear_association``). The hidden units learn what D leaves
(``association_learning``). span_S are the limits of nominal contexts, and g grows up to the greatest leverage of
nominal rows only, so that a fault cannot excuse itself by an unusual context.

Leverage is the distance of the inputs from those learned from, for each group without its own changes, by one inverse:

    l_g = a_gᵀ (E[a_g a_gᵀ] + λ I)⁻¹ a_g = ‖z‖² - ‖Q_g z_Δ‖²    a_g: a without Δ_g;  z = R a;  Rᵀ R = (E[a aᵀ] + λ I)⁻¹

Sources: Whittington and Bogacz 2017 (Neural Computation 29(5)) for learning from prediction errors; Salvatori et al.
2021 (NeurIPS) for association by predictive coding; Besag 1975 for judging parts given the rest; Bishop 2006, section
3.3.2, for leverage.
"""

from __future__ import annotations

from typing import Any, NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from asm_gym.memory.energy import (
    MOST_IN_ORDER,
    Array,
    activate,
    inner_kernel,
    kernel,
    outward,
)
from asm_gym.scaling import ScaledRows, StreamScaler

Ints = NDArray[np.intp]

SMALLEST = np.float32(-12.0)  # least log σ²: of 0.25 % of a channel's spread
LARGEST = np.float32(8.0)  # largest log σ²: of 55 spreads


class ChangeLayout(NamedTuple):
    """Which of the inputs are changes, and which changes form a group."""

    inputs: int  # I
    changes: slice  # columns of the X changes among the inputs
    groups: Ints  # (X,) group of each change, numbered from 0
    units: int = 0  # hidden units of each group

    @classmethod
    def of(cls, scaler: StreamScaler, units: int = 0) -> Self:
        """Return the layout of the inputs that a scaler reads from a row."""
        return cls(scaler.inputs, scaler.changes, scaler.groups, units)

    @property
    def columns(self) -> Ints:
        """Columns (X,) of the changes."""
        return np.arange(self.inputs)[self.changes]

    @property
    def changes_last(self) -> Ints:
        """Columns (I,) of the inputs, those of the changes at the end."""
        others = np.delete(np.arange(self.inputs), self.changes)
        return np.concatenate([others, self.columns])

    @property
    def group_masks(self) -> list[NDArray[np.bool_]]:
        """The mask (X,) of the changes of each group."""
        return [self.groups == group for group in range(int(self.groups.max()) + 1)]


class Association(NamedTuple):
    """The synapses of I inputs, M hidden units and X changes.

    All are float32, and 0 where there is no synapse.
    """

    V: Array  # (M, I)
    U: Array  # (X, M)
    D: Array  # (X, I)
    W_S: Array  # (X, M)
    b_S: Array  # noqa: N815 (X,)
    span_S: Array  # noqa: N815 (2, X) limits of log σ²
    remainder: Array  # (X,) s
    R: Array  # (I, I) lower triangle, or (0, I) where leverage is not known; the changes come last
    Q: Array  # (X, X) rows Q_g: orthonormal basis of what Δ_g adds to z_Δ, the changes' part of z
    # (3, X) of g²: value at leverage 0, slope, and the leverage above which it is constant
    leverage_scale: Array

    @classmethod
    def from_named(cls, arrays: dict[str, NDArray[Any]]) -> Self:
        """Restore what ``named`` returned; further arrays are ignored."""
        return cls(*(arrays[NAMES_IN_FILES.get(name, name)] for name in cls._fields))

    def named(self) -> dict[str, NDArray[Any]]:
        """Return the arrays of a checkpoint."""
        return {NAMES_IN_FILES.get(name, name): array for name, array in self._asdict().items()}


NAMES_IN_FILES = {"leverage_scale": "doubt"}
"""Arrays that checkpoints hold under another name."""


class Wiring(NamedTuple):
    """Where the row kernel finds the synapses and the group of each change."""

    spans: Ints  # (X, 2) first and one past the last unit that predicts each change
    groups: Ints  # (X,)
    changes_last: Ints  # (I,) columns of the inputs in the order of ``Association.R``

    @classmethod
    def of(cls, association: Association, scaler: StreamScaler) -> Self:
        """Return the wiring of an association whose inputs a scaler reads."""
        return cls(spans(association.U), scaler.groups, ChangeLayout.of(scaler).changes_last)


def association_shapes(inputs: int, units: int, changes: int) -> dict[str, tuple[int, ...]]:
    """Return the shape of each array of a checkpoint by name, in the order of ``Association``."""
    return {
        "V": (units, inputs),
        "U": (changes, units),
        "D": (changes, inputs),
        "W_S": (changes, units),
        "b_S": (changes,),
        "span_S": (2, changes),
        "remainder": (changes,),
        "R": (inputs, inputs),
        "Q": (changes, changes),
        "doubt": (3, changes),
    }


def without_leverage(inputs: int, changes: int) -> dict[str, Array]:
    """Return R, Q and ``leverage_scale`` by which g is 1 everywhere."""
    scale = np.zeros((3, changes), np.float32)
    scale[0] = 1.0
    return {
        "R": np.zeros((0, inputs), np.float32),
        "Q": np.zeros((changes, changes), np.float32),
        "leverage_scale": scale,
    }


class Change(NamedTuple):
    """One array for each array that predicts: the change of a batch, or a mask of the synapses that exist."""

    V: Array  # (M, I)
    U: Array  # (X, M)
    D: Array  # (X, I)


def synapses(layout: ChangeLayout) -> Change:
    """Return masks that are 1 where there is a synapse and 0 elsewhere."""
    groups = layout.groups
    unit_group = np.repeat(np.arange(groups.max() + 1), layout.units)  # (M,)
    V = np.ones((len(unit_group), layout.inputs), np.float32)
    V[:, layout.changes] = unit_group[:, None] != groups
    D = np.ones((len(groups), layout.inputs), np.float32)
    D[:, layout.changes] = groups[:, None] != groups
    U = (groups[:, None] == unit_group).astype(np.float32)
    return Change(V, U, D)


def spans(U: Array) -> Ints:
    """Return (X, 2): first and one past the last column of the synapses of each row of ``U`` (X, M)."""
    limits = np.zeros((len(U), 2), np.intp)
    for row, limit in zip(U, limits, strict=True):
        units = np.flatnonzero(row)
        if len(units):
            limit[:] = units[0], units[-1] + 1
    return limits


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


@inner_kernel
def complete_by_spans(f: Array, a: Array, U: Array, D: Array, spans: Ints) -> Array:
    """Return Δ̂ (B, X) as ``complete`` does; only synapses that exist are read."""
    out = outward(a, D)
    for i in range(U.shape[0]):
        for n in range(a.shape[0]):
            total = np.float32(0)
            for j in range(spans[i, 0], spans[i, 1]):
                total += f[n, j] * U[i, j]
            out[n, i] += total
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


@inner_kernel
def whiten(a: Array, R: Array, order: Ints) -> Array:
    """Return z (B, I) of inputs (B, I), whose columns are taken in an ``order``."""
    b = np.empty_like(a)
    z = np.empty_like(a)
    for n in range(a.shape[0]):  # numba takes seconds to compile an assignment to a slice
        for i in range(a.shape[1]):
            b[n, i] = a[n, order[i]]
    if a.shape[0] > MOST_IN_ORDER:
        np.dot(b, R.T, z)
        return z
    for i in range(a.shape[1]):  # no zeros of R are read
        for n in range(a.shape[0]):
            total = np.float32(0)
            for j in range(i + 1):
                total += R[i, j] * b[n, j]
            z[n, i] = total
    return z


@kernel
def leverage(a: Array, R: Array, Q: Array, groups: Ints, changes_last: Ints) -> Array:
    """Return l (B, X) of inputs (B, I); ``groups`` (X,) and ``changes_last`` (I,) as in ``Wiring``."""
    z = whiten(a, R, changes_last)
    changes = np.empty((a.shape[0], len(groups)), a.dtype)
    for n in range(a.shape[0]):
        for i in range(len(groups)):
            changes[n, i] = z[n, a.shape[1] - len(groups) + i]

    out = outward(changes, Q)
    left = np.empty(len(groups), a.dtype)  # of each group, at its number
    for n in range(a.shape[0]):
        total = np.float32(0)
        for i in range(a.shape[1]):
            total += z[n, i] * z[n, i]
        for i in range(len(groups)):
            left[i] = total
        for i in range(len(groups)):
            left[groups[i]] -= out[n, i] * out[n, i]
        for i in range(len(groups)):
            out[n, i] = max(left[groups[i]], np.float32(0))
    return out


@inner_kernel
def normalised_errors(
    rows: ScaledRows, association: Association, wiring: Wiring
) -> tuple[Array, Array]:
    """Return ε (B, X), 0 where a row is not whole, by the precision of rows, and f(h) (B, M)."""
    a = association
    f = hidden_units(rows.inputs, a.V)
    out = complete_by_spans(f, rows.inputs, a.U, a.D, wiring.spans)
    spread = log_variance(f, a.W_S, a.b_S, a.span_S)
    for n in range(out.shape[0]):
        for i in range(out.shape[1]):
            error = (rows.changes[n, i] - out[n, i]) / a.remainder[i]
            weight = rows.whole[n, 0] * rows.precision[n, i]
            out[n, i] = weight * error * np.exp(np.float32(-0.5) * spread[n, i])
    if a.R.shape[0]:
        far = leverage(rows.inputs, a.R, a.Q, wiring.groups, wiring.changes_last)
        scale = a.leverage_scale
        for n in range(out.shape[0]):
            for i in range(out.shape[1]):
                out[n, i] /= np.sqrt(scale[0, i] + scale[1, i] * min(far[n, i], scale[2, i]))
    return out, f
