"""The temporal predictive coding network of the papers: its state is carried on, and settles on every row.

    μ_t = W_H f(z_{t-1}) + W_U [a_t, 1]                              the state expected, once an action is commanded
    F = ½ Π_z ‖z - μ_t‖² + ½ Π_x ‖x_t - W_F f(z) - b_F‖²             z_t is where inference from μ_t on settles
    x̂_t = W_F f(μ_t) + b_F                                           the senses expected before they were read
    h_t = W_H f(z_{t-1}) + W_U [0, 1],   â_t = W_A f(h_t)            the action that belongs to the state

What is known of the past is in z alone, so that a row must be inferred before the next is expected: with few steps of
inference the state lags behind the senses, with many it knows them as far as Π_x and Π_z weigh them. ``Network`` has
traces in its place.

Source: Millidge et al. 2024 (PLOS Comput Biol) and Tang et al. 2023 (NeurIPS); the motor prediction is that of Mahajan
et al. 2025 (Neural Computation 38(1)).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from asm_gym.memory.energy import Array, Scalar, activate, kernel, outward
from asm_gym.memory.inference import infer
from asm_gym.memory.temporal import Step, TemporalNetwork


class SettlingWeights(NamedTuple):
    """The synapses. H hidden units, S senses, A motor; all float32."""

    W_H: Array  # (H, H) from the last state to the next
    W_U: Array  # (H, A + 1) from the commanded action and a constant 1 to the state
    W_F: Array  # (S, H) from the state to the senses
    b_F: Array  # noqa: N815 (S,)
    W_A: Array  # (A, H) from the state to the action


def settling_shapes(hidden: int, sensory: int, motor: int) -> dict[str, tuple[int, ...]]:
    """The shape of each array in ``SettlingWeights``, by name."""
    H, S, A = hidden, sensory, motor
    return {"W_H": (H, H), "W_U": (H, A + 1), "W_F": (S, H), "b_F": (S,), "W_A": (A, H)}


@kernel
def settle(
    z: Array,
    u: Array,
    x: Array,
    seen: Array,
    W_H: Array,
    W_U: Array,
    W_F: Array,
    b_F: Array,
    W_A: Array,
    pi_z: Scalar,
    pi_x: Scalar,
    curvature: Scalar,
    iterations: int,
) -> tuple[Array, Array]:
    """μ_t and z_t (B, H), in one call.

    Args:
        z, u, x, seen: (B, H), (B, A + 1), (B, S), (B, S) as in ``SettlingNetwork.follow``.
        W_A: not needed; so that all weights can be handed over as they are.
    """
    mu = outward(activate(z), W_H)
    mu += outward(u, W_U)
    return mu, infer(mu, x - b_F, W_F, pi_z, pi_x * seen, curvature, iterations)


class SettlingNetwork(TemporalNetwork):
    """The temporal network whose state is carried on, and association beside it.

    The arguments are those of ``TemporalNetwork``.
    """

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
        w = self.weights
        precision = self.sensory_precision * seen
        z = infer(mu, x - w.b_F, w.W_F, self.prior_precision, precision, self.curvature, self.iterations)
        return Step(mu, np.hstack([self._sense(mu), action]), z, z)

    def carry_on(self, c: Array, u: Array, x: Array, seen: Array) -> tuple[Array, Array]:
        mu, z = settle(c, u, x, seen, *self.weights, *self.inference)
        return activate(mu), z

    def run_on(self, c: Array) -> Step:
        u = np.zeros((len(c), self.motor + 1), np.float32)
        u[:, -1] = 1.0
        _, u[:, :-1] = self._expected(c, u)
        mu, action = self._expected(c, u)
        return Step(mu, np.hstack([self._sense(mu), action]), mu, mu)

    def _sense(self, z: Array) -> Array:
        """x̂ (B, S)."""
        found: Array = outward(activate(z), self.weights.W_F) + self.weights.b_F
        return found

    def _expected(self, z: Array, u: Array) -> tuple[Array, Array]:
        """μ_t (B, H) and â_t (B, A), which does not know the action."""
        w = self.weights
        carried = outward(activate(z), w.W_H)
        return carried + outward(u, w.W_U), outward(activate(carried + w.W_U[:, -1]), w.W_A)
