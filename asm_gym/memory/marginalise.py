"""A memory of fewer senses: the senses that are left stand in for those that are missing.

    C = E[a aᵀ]                                  second moments of the inputs a of association in nominal episodes
    a ≈ T a',   T = C_·k (C_kk + λ I)⁻¹          a': the inputs that are left, k their places in a; T a'_k = a'_k
    W a ≈ (W T) a'                               a synapse from a missing sense moves to those that predict it
    s'² = s² + diag(Q C Qᵀ) / σ̄²                 Q = W - W T at k: the unknown rest widens the expected error
    E' = (s E s + Q C Qᵀ / σ̄²) / (s' s')         and enters the covariance of the errors, which are whitened anew

T is exact for Gaussian inputs: for the linear part by the law of total expectation, for hidden units to first order.
T of a group of senses leaves out its own changes, as its synapses do. No recorded row is needed.

Source: Anderson 2003 (An Introduction to Multivariate Statistical Analysis, ch. 2) for conditionals of a Gaussian.
"""

from __future__ import annotations

from collections.abc import Hashable, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from asm_gym.memory.association import Association, hidden_units
from asm_gym.memory.energy import Array
from asm_gym.memory.inference import Weights
from asm_gym.memory.linear import gram
from asm_gym.memory.precision import log_variance
from asm_gym.memory.settling import SettlingWeights
from asm_gym.memory.traces import DECAYS
from asm_gym.scaling import StreamScaler

Floats = NDArray[np.float64]
Columns = NDArray[np.intp]

PENALTY = 1e-4
"""λ, in units of the variance of a standardised input."""

MOST_INPUTS = 2048
"""C of these takes 16 MiB in a file; a memory of more inputs keeps none."""

ONE = ("one", 0)
"""Name of the constant input."""


def moments(inputs: Array) -> NDArray[np.float32]:
    """Return C (I, I) of rows (N, I)."""
    exact = np.asarray(inputs, np.float64)
    return (gram(exact) / len(exact)).astype(np.float32)


def association_inputs(senses: StreamScaler, columns: Columns | None = None) -> list[Hashable]:
    """Return the name of each input of association: a kind, and a column of the stream.

    Args:
        senses: how rows are read.
        columns: (D,) number under which each column of the stream goes; its own by default.
    """
    every, spec = range(senses.spec.size), senses.spec
    kinds = ("before", every), ("change", spec.sensory), ("slow", senses.slow), ("command", spec.motor)
    return _named(kinds, np.arange(spec.size) if columns is None else columns)


def traced_inputs(senses: StreamScaler, columns: Columns | None = None) -> list[Hashable]:
    """Return the same for a row of traces, by the inputs of the row after it, which C knows."""
    spec = senses.spec
    kinds = ("before", spec.sensory), ("slow", senses.slow), ("before", spec.motor)
    return _named(kinds, np.arange(spec.size) if columns is None else columns)


def _named(kinds: Sequence[tuple[str, Sequence[int] | Columns | range]], columns: Columns) -> list[Hashable]:
    return [*((kind, int(columns[i])) for kind, own in kinds for i in own), ONE]


def stand_in(C: Floats, old: Sequence[Hashable], new: Sequence[Hashable], without: frozenset[Hashable]) -> Floats:
    """Return T (N, N'): each of N old inputs as a sum of N' new ones; 0 for new ones in ``without`` or unknown."""
    at = {name: n for n, name in enumerate(old)}
    pairs = [(at[name], n) for n, name in enumerate(new) if name in at and name not in without]
    kept, place = np.array(pairs, np.intp).T
    T = np.zeros((len(old), len(new)))
    common = C[np.ix_(kept, kept)] + PENALTY * np.eye(len(kept))
    T[:, place] = np.linalg.solve(common, C[kept]).T
    T[kept] = 0.0
    T[kept, place] = 1.0
    return T


class Kept(NamedTuple):
    """The smaller association, and how its errors change.

    Attributes:
        association: of the senses that are left.
        left: (X',) which errors are left.
        widened: (X', X') Q C Qᵀ / σ̄² s².
        narrower: (X',) s/s'.
    """

    association: Association
    left: NDArray[np.intp]
    widened: Floats
    narrower: Floats


def fewer_changes(memory: Association, C: Array, old: StreamScaler, new: StreamScaler, columns: Columns) -> Kept:
    """Return association of the senses that are left.

    Args:
        memory: of the ``old`` senses.
        C: (I, I) of ``moments``.
        old, new: how rows were and are read.
        columns: (D',) place of each number of the new stream in the old one; -1 for unknown commands.
    """
    exact = np.asarray(C, np.float64)
    before, after = association_inputs(old), association_inputs(new, columns)
    sensory = list(old.spec.sensory)
    left = np.array([sensory.index(columns[i]) for i in new.spec.sensory], np.intp)  # (X',) which changes
    at_mean = hidden_units(exact[-1:].astype(np.float32), memory.V)  # (1, M)
    variance = log_variance(at_mean, memory.W_S, memory.b_S, memory.span_S)[0]  # (X,)
    spread = memory.remainder * np.exp(0.5 * variance)  # (X,) s σ̄
    through = memory.D + (memory.U * (1.0 - at_mean**2)) @ memory.V  # (X, I) Δ̂ to first order
    groups = int(old.groups.max()) + 1
    unit_group = np.repeat(np.arange(groups), len(memory.V) // groups)
    known = np.array([before.index(name) if name in before else -1 for name in after])
    V, D = np.zeros((len(memory.V), len(after))), np.zeros((len(left), len(after)))
    Q = through[left].astype(np.float64)
    for g in range(groups):
        own = frozenset(("change", sensory[i]) for i in np.flatnonzero(old.groups == g))
        T = stand_in(exact, before, after, own)
        units, rows = unit_group == g, np.flatnonzero(old.groups[left] == g)
        V[units], D[rows] = memory.V[units] @ T, memory.D[left[rows]] @ T
        Q[np.ix_(rows, known[known >= 0])] -= (through[left[rows]] @ T)[:, known >= 0]
    widened = (Q @ exact @ Q.T) / np.outer(spread[left], spread[left])
    narrower = 1.0 / np.sqrt(1.0 + np.diag(widened))
    remainder = memory.remainder[left] / narrower
    precision = memory.W_S[left], memory.b_S[left], memory.span_S[:, left]
    association = Association(V, memory.U[left], D, *precision, remainder)
    return Kept(Association(*(np.asarray(a, np.float32) for a in association)), left, widened, narrower)


def fewer_traces(memory: Weights, C: Array, old: StreamScaler, new: StreamScaler, columns: Columns) -> Weights:
    """Return the synapses by traces of the senses that are left; arguments as in ``fewer_changes``."""
    exact = np.asarray(C, np.float64)
    everything, before, after = association_inputs(old), traced_inputs(old), traced_inputs(new, columns)
    places = [everything.index(name) for name in before]
    T = stand_in(exact[np.ix_(places, places)], before, after, frozenset())  # (R, R') of a row
    A = len(old.spec.motor)
    commands, commanded = before[len(before) - 1 - A :], after[len(after) - 1 - len(new.spec.motor) :]
    now = [everything.index(name) for name in commands]
    U = stand_in(exact[np.ix_(now, now)], commands, commanded, frozenset())  # (A + 1, A' + 1) of the command alone
    at = {name: n for n, name in enumerate(before[:-1])}
    left = [at.get(name, -1) for name in after[:-1]]  # which predictions
    traces = len(DECAYS) * len(before)
    every = np.kron(np.eye(len(DECAYS)), T)
    direct = np.hstack([memory.W_D[:, :traces] @ every, memory.W_D[:, traces:] @ U])
    known = np.array(left) >= 0
    W_F, W_D = (np.where(known[:, None], W[left], 0.0) for W in (memory.W_F, direct))
    found = memory.W_C @ every, W_F, W_D, memory.gains
    return Weights(*(np.ascontiguousarray(a, np.float32) for a in found))


def fewer_settled(memory: SettlingWeights, old: StreamScaler, new: StreamScaler, columns: Columns) -> SettlingWeights:
    """Return the synapses of a settling network of the senses that are left; arguments as in ``fewer_changes``.

    A missing sense has no precision and no term in the energy, so nothing needs to stand in for it. An unknown command
    is at its mean.
    """
    before, after = traced_inputs(old), traced_inputs(new, columns)
    S, A = len(after) - 1 - len(new.spec.motor), len(old.spec.motor)
    at = {name: n for n, name in enumerate(before)}
    senses = [at[name] for name in after[:S]]
    taken = np.array([at.get(name, -1) for name in after[S:]]) - (len(before) - 1 - A)  # the constant 1 is the last
    known, place = taken >= 0, np.maximum(taken, 0)
    W_U = np.where(known, memory.W_U[:, place], 0.0)
    W_A = np.where(known[:-1, None], memory.W_A[place[:-1]], 0.0)
    found = memory.W_H, W_U, memory.W_F[senses], memory.b_F[senses], W_A
    return SettlingWeights(*(np.ascontiguousarray(a, np.float32) for a in found))
