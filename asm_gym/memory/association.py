"""Association: what each group of senses should do, given what was sensed before and what the others sense now.

    a_t = [v_{t-1}, Δ_t, Δ_{t-1}, u_t, 1]          values before, changes now and before, the action as commanded
    h_t = V a_t                                    units of group g have no synapse from its own Δ_t
    Δ̂_t = D a_t + U f(h_t)                         what predicts g has synapses from units of g alone
    log σ²_t = W_S f(h_t) + b_S, within span_S     how large an error is to be expected, in s: see ``precision``
    D: in closed form, see ``linear``              s: the spread of what it leaves, r_t = (Δ_t - D a_t)/s
    ε_t = ψ((r_t - U f(h_t)/s)/σ),  ψ(ε) = min(max(ε, -1), 1)
    ΔU ∝ ε_t f(h_t)ᵀ    ΔV ∝ ε_h a_tᵀ,  ε_h = f'(h_t) ⊙ Uᵀ ε_t

A joint that moves and a hand that does not, a torque commanded and none measured: each group is completed from the
rest, so that what a body cannot do is an error, in whatever skill. What is linear is solved at once; the hidden units
learn what is left of it from all rows, and are believed as far as rows that they have not learned bear them out. Such
rows are found by cross-fitting: ``crossfit`` has what units that learned two thirds of the episodes expect of the other
third. W_S is learned on the errors of those. From very few rows neither the one nor the other is known: D then reads
the past and the command alone, and U and W_S are 0.

The rule equals the gradient of a Huber loss, and Uᵀ is the transpose of the weights that predict (weight transport):
this is backpropagation through one layer, at one moment, and only ΔU is local. Nor is D, from the inverse of what all
inputs have in common. ``feedback`` has other ways for the errors to come back, and what they find is measured.

Sources: Whittington and Bogacz 2017 (Neural Computation 29(5)) for learning by prediction errors; Salvatori et al. 2021
(NeurIPS) for association by predictive coding; Besag 1975 for judging parts given the rest; Huber 1964 for ψ.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from asm_gym.memory.crossfit import SMALLEST_SPREAD, THIRDS, crossfit, thirds, trust
from asm_gym.memory.energy import Array, activate, kernel, outward
from asm_gym.memory.learning import Synapse, coincidence, cosine_decay, shuffled
from asm_gym.memory.linear import learn_from_past, learn_linear
from asm_gym.memory.precision import PRECISION_EPOCHS, learn_precision, log_variance, unbounded, usual_span

UPDATES, PASSES = 6000, 40
"""Batches learned from at most, and passes over the steps at most: with more, few steps would be learned by heart."""

BATCH = 256
RATE = 5e-3
WARM_UP = 0.1
"""Share of the updates in which the step size rises to ``RATE``; it falls along a cosine after."""

TICKS = 20
"""How often the learning of hidden units tells of its progress."""

ALL_TICKS = (THIRDS + 1) * TICKS + PRECISION_EPOCHS
"""How often all of it does."""

ROWS_PER_INPUT = 12
"""With fewer rows than that for each input, what one sense tells of another is not known well enough to judge by."""

TRACKING = np.float32(0.01)
"""Weight of the newest batch in the running spread σ of each error."""


class Association(NamedTuple):
    """The synapses. I inputs, M hidden units, X changes; all float32, 0 where there is no synapse."""

    V: Array  # (M, I)
    U: Array  # (X, M)
    D: Array  # (X, I)
    W_S: Array  # (X, M)
    b_S: Array  # noqa: N815 (X,)
    span_S: Array  # noqa: N815 (2, X) what log σ² stays within
    remainder: Array  # (X,) s, the spread that the linear part leaves; 1 in memories that learned both parts at once


def association_shapes(inputs: int, units: int, changes: int) -> dict[str, tuple[int, ...]]:
    """The shape of each array in ``Association``, by name."""
    M, X = units, changes
    precision = {"W_S": (X, M), "b_S": (X,), "span_S": (2, X)}
    return {"V": (M, inputs), "U": (X, M), "D": (X, inputs), **precision, "remainder": (X,)}


class Change(NamedTuple):
    """What a batch asks of each array that predicts; or, of 0 and 1, which of its synapses exist."""

    V: Array  # (M, I)
    U: Array  # (X, M)
    D: Array  # (X, I)


def synapses(groups: NDArray[np.intp], changes: slice, inputs: int, size: int) -> Change:
    """1 where there is a synapse, 0 elsewhere.

    Args:
        groups: (X,) the group of each change, counted from 0.
        changes: where the X changes stand among the inputs.
        size: hidden units of a group.
    """
    unit_group = np.repeat(np.arange(groups.max() + 1), size)  # (M,)
    V, D = np.ones((len(unit_group), inputs), np.float32), np.ones((len(groups), inputs), np.float32)
    V[:, changes] = unit_group[:, None] != groups
    D[:, changes] = groups[:, None] != groups
    return Change(V, (groups[:, None] == unit_group).astype(np.float32), D)


def spans(U: Array) -> NDArray[np.intp]:
    """(X, 2) where the synapses of each row of ``U`` (X, M) begin and end: those from its own group alone."""
    if not U.size:
        return np.zeros((len(U), 2), np.intp)
    exists = U != 0
    begins, ends = exists.argmax(axis=1), U.shape[1] - exists[:, ::-1].argmax(axis=1)
    return np.where(exists.any(axis=1)[:, None], np.stack([begins, ends], axis=1), 0).astype(np.intp)


def existing(association: Association) -> Change:
    """1 where a memory has a synapse, 0 elsewhere."""
    return Change(*((W != 0).astype(np.float32) for W in (association.V, association.U, association.D)))


class Feedback:
    """How the hidden units learn what they did wrong: here by the transposed weights; and the linear part."""

    def linear(
        self, a: Array, groups: NDArray[np.intp], changes: slice, exists: Array, rng: np.random.Generator
    ) -> Array:
        """D (X, I) from many rows (N, I): in closed form; ``exists`` is 1 where it has a synapse."""
        return learn_linear(a, groups, changes)

    def begin(self, exists: Array, rng: np.random.Generator) -> None:
        """Before the first batch; ``exists`` is 1 where U (X, M) has a synapse."""

    def back(self, U: Array) -> Array:
        """(X, M) by which errors come back."""
        return U

    def change(self, a: Array, left: Array, spread: Array, V: Array, U: Array, D: Array) -> tuple[Change, Array]:
        """As ``association_change``."""
        return association_change(a, left, spread, V, U, D, back=self.back(U))

    def learn(self, U: Array, change: Array, rate: float) -> None:
        """After a batch, in which U (X, M) was changed along ``change``."""


@kernel
def hidden_units(a: Array, V: Array) -> Array:
    """f(h) (B, M) for inputs ``a`` (B, I)."""
    return activate(outward(a, V))


@kernel
def complete(f: Array, a: Array, U: Array, D: Array) -> Array:
    """Δ̂ (B, X) from hidden units ``f`` (B, M) and inputs ``a`` (B, I)."""
    out = outward(f, U)
    out += outward(a, D)
    return out


@kernel
def inward(pulled: Array, f: Array, back: Array) -> Array:
    """f'(h) ⊙ Bᵀ ε (B, M): the errors (B, X) that come back to the hidden units ``f`` (B, M) by ``back`` (X, M)."""
    out: Array = np.dot(pulled, back)
    for n in range(out.shape[0]):
        for j in range(out.shape[1]):
            out[n, j] *= np.float32(1) - f[n, j] * f[n, j]
    return out


@kernel
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
) -> tuple[Array, Array]:
    """(Δ - Δ̂)/(s σ) (B, X) for inputs (B, I) and changes (B, X); 0 where ``whole`` (B, 1) is. And f(h) (B, M).

    Args:
        spans: (X, 2) of ``U``, outside of which nothing is read.
    """
    f = hidden_units(inputs, V)
    out = outward(inputs, D)
    if inputs.shape[0] > 1:
        out += outward(f, U)
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
    return out, f


def association_change(
    a: Array,
    delta: Array,
    spread: Array,
    V: Array,
    U: Array,
    D: Array,
    bound: float = 1.0,
    back: Array | None = None,
) -> tuple[Change, Array]:
    """What each synapse changes by for inputs (B, I) and changes (B, X), as if all existed; and the errors (B, X).

    Args:
        D: (X, I), or (X, 0) where nothing is linear.
        back: (X, M) by which errors come back to the hidden units; ``U`` where None.
    """
    f = hidden_units(a, V)
    error = delta - (complete(f, a, U, D) if D.size else outward(f, U))
    pulled = np.clip(error / spread, np.float32(-bound), np.float32(bound))
    upstream = inward(pulled, f, U if back is None else back)  # (B, M) ε_h
    return Change(coincidence(upstream, a), coincidence(pulled, f), coincidence(pulled, a) if D.size else D), error


def learn_association(
    a: Array,
    delta: Array,
    groups: NDArray[np.intp],
    changes: slice,
    size: int,
    rng: np.random.Generator,
    tick: Callable[[], None] = lambda: None,
    updates: int = UPDATES,
    passes: int = PASSES,
    feedback: Feedback | None = None,
    lengths: Sequence[int] = (),
    apart: int | None = None,
) -> Association:
    """What is linear in closed form; what remains by the hidden units, in random order; how sure it is last.

    Args:
        a: (N, I) inputs of whole episodes, one after another, the last input a constant 1.
        delta: (N, X) changes, standardised.
        groups, changes, size: as in ``synapses``.
        tick: called ``ALL_TICKS`` times on the way.
        updates, passes: over batches and over the rows that are learned from, at most.
        feedback: how errors come back to the hidden units; by the transposed weights where None.
        lengths: how many rows each episode has; where none are told, thirds are of rows that follow each other.
        apart: how many rows there would be if none overlapped, as changes over several rows do; N where None.
    """
    few, feedback = (apart or len(a)) < ROWS_PER_INPUT * a.shape[1], feedback or Feedback()
    exists = synapses(groups, changes, a.shape[1], size)
    D = learn_from_past(a, changes) if few else feedback.linear(a, groups, changes, exists.D, rng)
    left = delta - outward(a, D)
    remainder = np.maximum(np.sqrt(np.mean(left**2, axis=0)), SMALLEST_SPREAD)  # (X,)
    if few:
        for _ in range(ALL_TICKS):
            tick()
        return _linear_alone(D, remainder, _random(exists.V, rng))
    left /= remainder

    def learned(rows: NDArray[np.bool_] | slice) -> tuple[Array, Array]:
        return _learn_hidden(a[rows], left[rows], exists, rng, tick, updates, passes, feedback)

    def expect(learned_from: NDArray[np.bool_], asked: NDArray[np.bool_]) -> Array:
        V, U = learned(learned_from)
        return outward(hidden_units(a[asked], V), U)

    # How far units go wrong in rows that they have learned says too little of how far they will.
    expected = crossfit(expect, thirds(len(a), lengths, rng), left.shape[1])
    V, U = learned(slice(None))
    share = trust(left, expected)
    U *= share[:, None]
    W_S, b_S = np.zeros_like(U), np.zeros(len(U), np.float32)
    f = hidden_units(a, V)
    learn_precision(f, left - share * expected, W_S, b_S, rng, tick)
    return Association(V, U * remainder[:, None], D, W_S, b_S, usual_span(f, W_S, b_S), remainder)


def _linear_alone(D: Array, remainder: Array, V: Array) -> Association:
    """With units that nothing is expected from: names may be read from them."""
    nothing = np.zeros((len(D), len(V)), np.float32)
    return Association(V, nothing, D, nothing.copy(), np.zeros_like(remainder), unbounded(len(D)), remainder)


def _random(exists: Array, rng: np.random.Generator) -> Array:
    """V (M, I) before anything is learned, 0 where there is no synapse."""
    V: Array = rng.standard_normal(exists.shape).astype(np.float32) / np.float32(np.sqrt(exists.shape[1])) * exists
    return V


def _learn_hidden(
    a: Array,
    left: Array,
    exists: Change,
    rng: np.random.Generator,
    tick: Callable[[], None],
    updates: int,
    passes: int,
    feedback: Feedback,
) -> tuple[Array, Array]:
    """V and U from N rows (N, I) and what the linear part leaves of them (N, X), standardised."""
    updates = max(TICKS, min(updates, passes * len(a) // BATCH))
    V = _random(exists.V, rng)
    U, nothing = np.zeros_like(exists.U), exists.D[:, :0]
    into, out_of = Synapse(V), Synapse(U)
    spread = np.ones(left.shape[1], np.float32)
    feedback.begin(exists.U, rng)
    for n, chosen in zip(range(updates), shuffled(len(a), BATCH, rng), strict=False):
        change, error = feedback.change(a[chosen], left[chosen], spread, V, U, nothing)
        rate, outward_change = _rate(n / updates), change.U * exists.U
        into.learn(change.V * exists.V, rate)
        out_of.learn(outward_change, rate)
        feedback.learn(U, outward_change, rate)
        now = np.sqrt(np.mean(np.minimum(error**2, 9 * spread**2), axis=0))
        spread += TRACKING * (np.maximum(now, SMALLEST_SPREAD) - spread)
        if (n + 1) * TICKS // updates > n * TICKS // updates:
            tick()
    return V, U


def _rate(progress: float) -> float:
    if progress < WARM_UP:
        return RATE * progress / WARM_UP
    return cosine_decay(RATE, (progress - WARM_UP) / (1.0 - WARM_UP))
