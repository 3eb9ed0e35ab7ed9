"""Learning of association: the linear part in closed form, the hidden units from its errors, the precision last.

    r_t = (Δ_t - D a_t) / s                        what the linear part leaves
    ε_t = ψ((r_t - U f(h_t)) / σ),  ψ(ε) = min(max(ε, -1), 1)
    ΔU ∝ ε_t f(h_t)ᵀ
    ΔV ∝ ε_h a_tᵀ,   ε_h = f'(h_t) ⊙ Bᵀ ε_t

How errors come back to the hidden units is one of three ways:

    transported    B = U, the transpose of the weights that predict: the gradient of a Huber loss
    learned        B changes as U does and both decay, so that B approaches U; each change of V, U and B is local
    local          learned, and D too by a local rule (``linear.learn_by_delta``) in place of the closed form

The predictions of the hidden units are scaled by how well they do on episodes that they have not learned, and the
precision is learned on the errors of those (``crossfit``). From very few rows neither is known: then D reads the past
and the command only, and U and W_S are 0.

Sources: Huber 1964 for ψ; Kolen and Pollack 1994 and Akrout et al. 2019 (NeurIPS) for learned feedback.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

from asm_gym.memory.association import Association, Change, complete, hidden_units, synapses
from asm_gym.memory.crossfit import SMALLEST_SPREAD, THIRDS, crossfit, thirds, trust
from asm_gym.memory.energy import Array, kernel, outward
from asm_gym.memory.learning import Synapse, coincidence, cosine_decay, shuffled
from asm_gym.memory.linear import learn_by_delta, learn_from_past, learn_linear
from asm_gym.memory.precision import PRECISION_EPOCHS, learn_precision, unbounded, usual_span

UPDATES, PASSES = 6000, 40
"""Largest number of batches, and of passes over the rows."""

BATCH = 256
RATE = 5e-3
WARM_UP = 0.1
"""Share of the updates in which the step size rises to ``RATE``; after that it falls along a cosine."""

TICKS = 20
"""Progress reports of one learning of the hidden units."""

ALL_TICKS = (THIRDS + 1) * TICKS + PRECISION_EPOCHS
"""Progress reports of ``learn_association``."""

ROWS_PER_INPUT = 12
"""With fewer rows for each input, the senses are not predicted from each other."""

TRACKING = np.float32(0.01)
"""Weight of the newest batch in the running spread σ of each error."""

FEEDBACK_GAIN = 1e-3
"""Initial gain of learned feedback."""

DECAY = 0.3
"""Share of its step size by which a synapse of U or B decays."""


class Feedback:
    """Errors come back by the transpose of the weights that predict."""

    def linear(
        self, a: Array, groups: NDArray[np.intp], changes: slice, exists: Array, rng: np.random.Generator
    ) -> Array:
        """Return D (X, I) from inputs (N, I); ``exists`` (X, I) is 1 where it has a synapse."""
        return learn_linear(a, groups, changes)

    def begin(self, exists: Array, rng: np.random.Generator) -> None:
        """Start anew; ``exists`` (X, M) is 1 where U has a synapse."""

    def back(self, U: Array) -> Array:
        """Return B (X, M)."""
        return U

    def learn(self, U: Array, change: Array, rate: float) -> None:
        """Follow a step in which U (X, M) was moved along ``change``."""


class LearnedFeedback(Feedback):
    """Errors come back by weights of their own, which learn what the weights that predict learn."""

    B: Array  # (X, M)

    def begin(self, exists: Array, rng: np.random.Generator) -> None:
        each = np.maximum(exists.sum(axis=1, keepdims=True), 1.0)
        self.B = (FEEDBACK_GAIN * rng.standard_normal(exists.shape) / np.sqrt(each)).astype(np.float32) * exists
        self._synapse = Synapse(self.B)

    def back(self, U: Array) -> Array:
        return self.B

    def learn(self, U: Array, change: Array, rate: float) -> None:
        self._synapse.learn(change, rate)
        for W in (U, self.B):
            W *= np.float32(1.0 - DECAY * rate)


class LocalFeedback(LearnedFeedback):
    """Learned feedback, with the linear part by the delta rule."""

    def linear(
        self, a: Array, groups: NDArray[np.intp], changes: slice, exists: Array, rng: np.random.Generator
    ) -> Array:
        return learn_by_delta(a, changes, exists, rng)


TRANSPORTED, LEARNED, LOCAL = "transported", "learned", "local"
FEEDBACK: dict[str, Callable[[], Feedback]] = {
    TRANSPORTED: Feedback,
    LEARNED: LearnedFeedback,
    LOCAL: LocalFeedback,
}


@kernel
def inward(pulled: Array, f: Array, back: Array) -> Array:
    """Return f'(h) ⊙ Bᵀ ε (B, M) for errors (B, X), hidden units ``f`` (B, M) and feedback ``back`` (X, M)."""
    out: Array = np.dot(pulled, back)
    for n in range(out.shape[0]):
        for j in range(out.shape[1]):
            out[n, j] *= np.float32(1) - f[n, j] * f[n, j]
    return out


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
    """Return the change of each synapse, as if all existed, and the errors (B, X).

    Args:
        a: (B, I) inputs.
        delta: (B, X) changes.
        spread: (X,) σ.
        V, U: (M, I) and (X, M).
        D: (X, I), or (X, 0) without a linear part.
        bound: of ψ.
        back: (X, M) feedback weights; ``U`` where None.
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
    independent: int | None = None,
) -> Association:
    """Learn the linear part, then the hidden units, then the precision.

    Args:
        a: (N, I) inputs of whole episodes, concatenated; the last input is a constant 1.
        delta: (N, X) changes, standardised.
        groups, changes, size: as in ``synapses``.
        rng: draws initial weights and the order of the rows.
        tick: called ``ALL_TICKS`` times.
        updates, passes: largest number of batches, and of passes over the rows.
        feedback: one of ``FEEDBACK``; transported where None.
        lengths: rows of each episode; without them cross-fitting cuts the rows into three consecutive parts.
        independent: number of rows if overlapping changes are counted once; N where None.
    """
    few, feedback = (independent or len(a)) < ROWS_PER_INPUT * a.shape[1], feedback or Feedback()
    exists = synapses(groups, changes, a.shape[1], size)
    D = learn_from_past(a, changes) if few else feedback.linear(a, groups, changes, exists.D, rng)
    left = delta - outward(a, D)
    remainder = np.maximum(np.sqrt(np.mean(left**2, axis=0)), SMALLEST_SPREAD)  # (X,)
    if few:
        for _ in range(ALL_TICKS):
            tick()
        none = np.zeros_like(exists.U)
        precision = none.copy(), np.zeros_like(remainder), unbounded(len(D))
        return Association(_random(exists.V, rng), none, D, *precision, remainder)
    left /= remainder

    def learned(rows: NDArray[np.bool_] | slice) -> tuple[Array, Array]:
        return _learn_hidden(a[rows], left[rows], exists, rng, tick, updates, passes, feedback)

    def expect(learned_from: NDArray[np.bool_], asked: NDArray[np.bool_]) -> Array:
        V, U = learned(learned_from)
        return outward(hidden_units(a[asked], V), U)

    # Errors on rows that were learned are smaller than those to come.
    expected = crossfit(expect, thirds(len(a), lengths, rng), left.shape[1])
    V, U = learned(slice(None))
    share = trust(left, expected)
    U *= share[:, None]
    W_S, b_S = np.zeros_like(U), np.zeros(len(U), np.float32)
    f = hidden_units(a, V)
    learn_precision(f, left - share * expected, W_S, b_S, rng, tick)
    return Association(V, U * remainder[:, None], D, W_S, b_S, usual_span(f, W_S, b_S), remainder)


def _random(exists: Array, rng: np.random.Generator) -> Array:
    """Return initial V (M, I)."""
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
    """Return V and U learned from inputs (N, I) and what the linear part leaves (N, X), standardised."""
    updates = max(TICKS, min(updates, passes * len(a) // BATCH))
    V = _random(exists.V, rng)
    U, no_linear = np.zeros_like(exists.U), exists.D[:, :0]
    into, out_of = Synapse(V), Synapse(U)
    spread = np.ones(left.shape[1], np.float32)
    feedback.begin(exists.U, rng)
    for n, rows in zip(range(updates), shuffled(len(a), BATCH, rng), strict=False):
        change, error = association_change(a[rows], left[rows], spread, V, U, no_linear, back=feedback.back(U))
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
