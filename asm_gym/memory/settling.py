"""The temporal predictive coding network of the papers: its state is carried on, and is inferred on every row.

    μ_t = W_H f(z_{t-1}) + W_U [a_t, 1]                              state expected for the commanded action
    F = ½ Π_z ‖z - μ_t‖² + ½ Π_x ‖x_t - W_F f(z) - b_F‖²             z_t is where inference from μ_t ends
    x̂_t = W_F f(μ_t) + b_F                                           senses expected before they are read
    h_t = W_H f(z_{t-1}) + W_U [0, 1],   â_t = W_A f(h_t)            action that belongs to the state

The past is in z alone, so each row must be inferred before the next is expected. With few inference steps the state
lags behind the senses.

Sources: Millidge et al. 2024 (PLOS Comput Biol) and Tang et al. 2023 (NeurIPS); Mahajan et al. 2025 (Neural
Computation 38(1)) for the motor prediction.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from asm_gym.memory.energy import Array, activate, outward
from asm_gym.memory.inference import infer
from asm_gym.memory.temporal import Step, TemporalNetwork


class SettlingWeights(NamedTuple):
    """The synapses of H hidden units, S senses and A motor; all float32."""

    W_H: Array  # (H, H) from the last state to the next
    W_U: Array  # (H, A + 1) from the commanded action and a constant 1 to the state
    W_F: Array  # (S, H) from the state to the senses
    b_F: Array  # noqa: N815 (S,)
    W_A: Array  # (A, H) from the state to the action


def settling_shapes(hidden: int, sensory: int, motor: int) -> dict[str, tuple[int, ...]]:
    """Return the shape of each array of ``SettlingWeights`` by name."""
    H, S, A = hidden, sensory, motor
    return {"W_H": (H, H), "W_U": (H, A + 1), "W_F": (S, H), "b_F": (S,), "W_A": (A, H)}


class SettlingNetwork(TemporalNetwork):
    """The network whose state is carried on; arguments as in ``TemporalNetwork``."""

    weights: SettlingWeights

    @property
    def hidden_size(self) -> int:
        return self.weights.W_H.shape[0]

    @property
    def motor(self) -> int:
        return self.weights.W_A.shape[0]

    def at_rest(self, batch: int) -> NDArray[np.float32]:
        return np.zeros((batch, self.hidden_size), np.float32)

    def predict(self, c: Array, u: Array) -> Array:
        mu, action = self._expected(c, u)
        return np.hstack([self._sense(mu), action])

    def follow(self, c: Array, u: Array, x: Array, seen: Array) -> Step:
        mu, action = self._expected(c, u)
        z = self._infer(mu, x, seen)
        return Step(mu, np.hstack([self._sense(mu), action]), z, z)

    def carry_on(self, c: Array, u: Array, x: Array, seen: Array) -> tuple[Array, Array]:
        mu = outward(activate(c), self.weights.W_H) + outward(u, self.weights.W_U)
        return activate(mu), self._infer(mu, x, seen)

    def run_on(self, c: Array) -> Step:
        u = np.zeros((len(c), self.motor + 1), np.float32)
        u[:, -1] = 1.0
        _, u[:, :-1] = self._expected(c, u)
        mu, action = self._expected(c, u)
        return Step(mu, np.hstack([self._sense(mu), action]), mu, mu)

    def _sense(self, z: Array) -> Array:
        """Return x̂ (B, S)."""
        found: Array = outward(activate(z), self.weights.W_F) + self.weights.b_F
        return found

    def _infer(self, mu: Array, x: Array, seen: Array) -> Array:
        """Return z_t (B, H)."""
        w, precision = self.weights, self.sensory_precision * seen
        z: Array = infer(mu, x - w.b_F, w.W_F, self.prior_precision, precision, self.curvature, self.iterations)
        return z

    def _expected(self, z: Array, u: Array) -> tuple[Array, Array]:
        """Return μ_t (B, H), and â_t (B, A), which does not depend on the action."""
        w = self.weights
        carried = outward(activate(z), w.W_H)
        return carried + outward(u, w.W_U), outward(activate(carried + w.W_U[:, -1]), w.W_A)
