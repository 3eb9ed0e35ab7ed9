"""The temporal network by traces: the past is carried as traces of what was sensed and done, see ``traces``.

    μ_t = W_C c_{t-1} → z_t = argmin F → c_t         equations in ``inference``
    F = ½ Π_z ‖z - μ‖² + ½ Π_x ‖[x, a] - [x̂, â](z)‖²

Association stands beside it. Both read the same rows and share no state, so ∂F/∂z has no term of association.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from asm_gym.memory.energy import Array
from asm_gym.memory.inference import Weights, carry, direct, expect, infer, sense
from asm_gym.memory.temporal import Step, TemporalNetwork
from asm_gym.memory.traces import advance, at_rest


class Network(TemporalNetwork):
    """The temporal network by traces; arguments as in ``TemporalNetwork``."""

    weights: Weights

    @property
    def hidden_size(self) -> int:
        return self.weights.W_C.shape[0]

    @property
    def motor(self) -> int:
        w = self.weights
        return w.W_D.shape[1] - w.W_C.shape[1] - 1

    def at_rest(self, batch: int) -> NDArray[np.float32]:
        return at_rest(batch, self.weights.W_F.shape[0] + 1)

    def predict(self, c: Array, u: Array) -> Array:
        w = self.weights
        found: Array = direct(c, u, w.W_D) + sense(expect(c, w.W_C), w.W_F)
        return found

    def follow(self, c: Array, u: Array, x: Array, seen: Array) -> Step:
        w = self.weights
        mu, past = expect(c, w.W_C), direct(c, u, w.W_D)
        precision = self.sensory_precision * np.hstack([seen, np.ones_like(u[:, :-1])])
        left = np.hstack([x, u[:, :-1]]) - past
        z = infer(mu, left, w.W_F, self.prior_precision, precision, self.curvature, self.iterations)
        whole = np.where(seen > 0, x, (past + sense(z, w.W_F))[:, : x.shape[1]])
        return Step(mu, past + sense(mu, w.W_F), z, advance(c, np.hstack([whole, u]), w.gains))

    def carry_on(self, c: Array, u: Array, x: Array, seen: Array) -> tuple[Array, Array]:
        expected, traces = carry(c, u, x, seen, *self.weights, *self.inference, True)
        return expected, traces

    def run_on(self, c: Array) -> Step:
        w = self.weights
        S, A = w.W_F.shape[0] - self.motor, self.motor
        mu = expect(c, w.W_C)
        state = sense(mu, w.W_F)
        u = np.zeros((len(c), A + 1), np.float32)
        u[:, -1] = 1.0
        u[:, :A] = (direct(c, u, w.W_D) + state)[:, S:]  # no synapse leads from an action to itself
        expected = direct(c, u, w.W_D) + state
        return Step(mu, expected, mu, advance(c, np.hstack([expected[:, :S], u]), w.gains))
