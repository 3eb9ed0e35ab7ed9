"""The temporal network of memories that were saved before there were traces: they go on watching and recalling.

    μ_t = W_H f(z_{t-1}) + W_U u_t,   x̂_t = W_F f(μ_t) + b_F,   â_t = W_A f(h_t),  h_t = W_H f(z_{t-1}) + W_U[0, 1]

Its state itself is carried on, in the place of the traces of ``Network``; nothing learns it any more.

Source: Millidge et al. 2024 (PLOS Comput Biol); Tang et al. 2023 (NeurIPS).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from asm_gym.memory.association import Association, spans
from asm_gym.memory.energy import Array, activate, outward
from asm_gym.memory.inference import infer
from asm_gym.memory.network import Network, Step


class RecurrentWeights(NamedTuple):
    """The synapses. H hidden units, S senses, A motor; all float32."""

    W_H: Array  # (H, H)
    W_U: Array  # (H, A + 1)
    W_F: Array  # (S, H)
    b_F: Array  # noqa: N815 (S,)
    W_A: Array  # (A, H)


def recurrent_shapes(hidden: int, sensory: int, motor: int) -> dict[str, tuple[int, ...]]:
    """The shape of each array in ``RecurrentWeights``, by name."""
    H, S, A = hidden, sensory, motor
    return {"W_H": (H, H), "W_U": (H, A + 1), "W_F": (S, H), "b_F": (S,), "W_A": (A, H)}


class RecurrentNetwork(Network):
    """``Network``, with a state in place of traces. The arguments are those of ``Network``."""

    def __init__(
        self,
        weights: RecurrentWeights,
        association: Association,
        iterations: int,
        prior_precision: float,
        sensory_precision: float,
    ) -> None:
        self.recurrent, self.iterations = weights, iterations
        self.association, self.spans = association, spans(association.U)
        self.prior_precision, self.sensory_precision = np.float32(prior_precision), np.float32(sensory_precision)
        norm = float(np.linalg.norm(weights.W_F.astype(np.float64), 2))
        self.curvature = np.float32(prior_precision + sensory_precision * norm**2)

    @property
    def hidden_size(self) -> int:
        return self.recurrent.W_H.shape[0]

    @property
    def motor(self) -> int:
        return self.recurrent.W_A.shape[0]

    def at_rest(self, batch: int) -> NDArray[np.float32]:
        return np.zeros((batch, self.hidden_size), np.float32)

    def follow(self, c: Array, u: Array, x: Array, seen: Array) -> Step:
        mu, action = self._expected(c, u)
        w = self.recurrent
        precision = self.sensory_precision * seen
        z = infer(mu, x - w.b_F, w.W_F, self.prior_precision, precision, self.curvature, self.iterations)
        return Step(mu, np.hstack([outward(activate(mu), w.W_F) + w.b_F, action]), z, z)

    def carry_on(self, c: Array, u: Array, x: Array, seen: Array) -> tuple[Array, Array]:
        step = self.follow(c, u, x, seen)
        return activate(step.mu), step.traces

    def run_on(self, c: Array) -> Step:
        u = np.zeros((len(c), self.motor + 1), np.float32)
        u[:, -1] = 1.0
        _, u[:, :-1] = self._expected(c, u)
        mu, action = self._expected(c, u)
        return Step(mu, np.hstack([outward(activate(mu), self.recurrent.W_F) + self.recurrent.b_F, action]), mu, mu)

    def _expected(self, z: Array, u: Array) -> tuple[Array, Array]:
        """μ_t (B, H) and â_t (B, A), which does not know the action."""
        w = self.recurrent
        carried = outward(activate(z), w.W_H)
        return carried + outward(u, w.W_U), outward(activate(carried + w.W_U[:, -1]), w.W_A)
