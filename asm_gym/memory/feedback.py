"""Other ways for the errors of association to come back to its hidden units than by the transposed weights.

    h_t = V a_t    ε_t = ψ((r_t - U f(h_t))/σ)    ΔU ∝ ε_t f(h_t)ᵀ    ΔV ∝ ε_h a_tᵀ       as in ``association``
    transported     ε_h = f'(h_t) ⊙ Uᵀ ε_t                                               the gradient
    random          ε_h = f'(h_t) ⊙ Bᵀ ε_t                     B is drawn once and stays
    learned         ε_h = f'(h_t) ⊙ Bᵀ ε_t                     ΔB = ΔU, and both decay: so B comes to U
    local           as learned, and ΔD ∝ (Δ_t - D a_t) a_tᵀ    the delta rule, where D has a closed form else
    settled         ε_h = Π_h (h* - V a_t)                     h* = argmin ½ Π_h ‖h - V a_t‖² + Σ σ ρ((r_t - U f(h))/σ)

ΔB is the product of what its own two ends hold, as ΔU is, so that with learned feedback every change of V, U and B is
local. Settling sends the error back while it settles, by Uᵀ, or by a B that is learned.

Sources: Lillicrap et al. 2016 (Nature Communications 7) for random feedback; Kolen and Pollack 1994 and Akrout et al.
2019 (NeurIPS) for learned feedback; Whittington and Bogacz 2017 for settling.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from asm_gym.memory.association import Change, Feedback
from asm_gym.memory.energy import Array, activate, outward
from asm_gym.memory.learning import Synapse, coincidence, power_iteration
from asm_gym.memory.linear import learn_by_delta

FAINTNESS, FAINTEST = 0.1, 1e-3
"""Gain of the weights that errors come back by, before anything is learned, where they stay and where they learn. U
begins at 0: from 0.1, the first errors that come back are of no use to V, whose steps are as large as later ones."""

DECAY = 0.3
"""Share of its step by which a synapse of U or B decays towards 0."""

PRIOR_PRECISION = 30.0
"""Π_h, as firm as that of the temporal network's state."""

ITERATIONS = 5
"""Steps of settling."""


class Random(Feedback):
    """Errors come back by weights of their own, which stay as they are."""

    gain = FAINTNESS
    B: Array  # (X, M)

    def begin(self, exists: Array, rng: np.random.Generator) -> None:
        each = np.maximum(exists.sum(axis=1, keepdims=True), 1.0)
        self.B = (self.gain * rng.standard_normal(exists.shape) / np.sqrt(each)).astype(np.float32) * exists

    def back(self, U: Array) -> Array:
        return self.B


class Learned(Random):
    """Errors come back by weights of their own, which learn what the weights that predict learn."""

    gain = FAINTEST

    def begin(self, exists: Array, rng: np.random.Generator) -> None:
        super().begin(exists, rng)
        self._synapse = Synapse(self.B)

    def learn(self, U: Array, change: Array, rate: float) -> None:
        self._synapse.learn(change, rate)
        for W in (U, self.B):
            W *= np.float32(1.0 - DECAY * rate)


class Local(Learned):
    """All of association by local rules: the linear part by the delta rule, in place of the inverse."""

    def linear(
        self, a: Array, groups: NDArray[np.intp], changes: slice, exists: Array, rng: np.random.Generator
    ) -> Array:
        return learn_by_delta(a, changes, exists, rng)


class Settled(Feedback):
    """The units settle where the energy is least, and learn to be there at once.

    Args:
        by: how errors come back while they settle.
        prior_precision: Π_h.
        iterations: steps of settling.
    """

    def __init__(self, by: Feedback, prior_precision: float = PRIOR_PRECISION, iterations: int = ITERATIONS) -> None:
        self.by, self.prior_precision, self.iterations = by, np.float32(prior_precision), iterations

    def begin(self, exists: Array, rng: np.random.Generator) -> None:
        self._direction = rng.standard_normal(exists.shape[1]).astype(np.float32)
        self.by.begin(exists, rng)

    def learn(self, U: Array, change: Array, rate: float) -> None:
        self.by.learn(U, change, rate)

    def change(self, a: Array, left: Array, spread: Array, V: Array, U: Array, D: Array) -> tuple[Change, Array]:
        drive, back, one = outward(a, V), self.by.back(U), np.float32(1)
        left = left - outward(a, D) if D.size else left
        norm, self._direction = power_iteration(U / np.sqrt(spread)[:, None], self._direction)
        stride = one / (self.prior_precision + np.float32(norm))
        h, f = drive, activate(drive)
        error = left - outward(f, U)
        pulled = np.clip(error / spread, -one, one)
        for _ in range(self.iterations):
            h = h - stride * (self.prior_precision * (h - drive) - (one - f * f) * (pulled @ back))
            f = activate(h)
            pulled = np.clip((left - outward(f, U)) / spread, -one, one)
        pushed = self.prior_precision * (h - drive)  # (B, M) ε_h
        return Change(coincidence(pushed, a), coincidence(pulled, f), np.zeros_like(D)), error


TRANSPORTED, LEARNED = "transported", "learned"
FEEDBACK: dict[str, Callable[[], Feedback]] = {
    TRANSPORTED: Feedback,
    LEARNED: Learned,
    "local": Local,
    "random": Random,
    "settled": lambda: Settled(Feedback()),
    "settled_learned": lambda: Settled(Learned()),
}
"""Each way by name: makes one that has learned nothing yet."""
