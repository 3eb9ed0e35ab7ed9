"""What is predicted from what a network carries on, as ``recurrent`` does.

    μ_t = W_C m_{t-1}                                expected state; z_t is inferred from it (``energy``)
    [x̂_t, â_t] = W_F f(z_t) + W_D [m_{t-1}, a_t, 1]  prediction from a state; â has no synapse from the action itself

What is missing from a row is inferred from the rest of it.
"""

from __future__ import annotations

from abc import abstractmethod
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from asm_gym.memory.energy import (
    Array,
    Inference,
    activate,
    beside,
    infer,
    inner_kernel,
    kernel,
    outward,
)
from asm_gym.memory.temporal import Step, TemporalNetwork
from asm_gym.scaling import ScaledRows


class Readout(NamedTuple):
    """The synapses by which senses and action are predicted."""

    W_F: Array  # (S + A, H) from the state
    W_D: Array  # (S + A, I + A + 1) from what is carried on, action and a constant 1


def direct(m: Array, u: Array, W_D: Array) -> Array:
    """Return the prediction (B, S + A) past the state, from ``m`` (B, I) and action and 1 ``u`` (B, A + 1)."""
    return outward(np.hstack([m, u]), W_D)


@kernel
def sense(z: Array, W_F: Array) -> Array:
    """Return what the state ``z`` (B, H) adds to it (B, S + A)."""
    return outward(activate(z), W_F)


@inner_kernel
def fill_missing(
    sensed: Array, m: Array, mu: Array, rows: ScaledRows, readout: Readout, inference: Inference
) -> None:
    """Write what is inferred of missing senses into ``sensed`` (B, S + A + 1), from m (B, I) and μ (B, H)."""
    S = rows.senses.shape[1]
    past = outward(beside(m, rows.commands), readout.W_D)  # (B, S + A)
    left = np.empty_like(past)
    precision = np.empty_like(past)
    for n in range(past.shape[0]):
        for i in range(past.shape[1]):
            left[n, i] = sensed[n, i] - past[n, i]
            precision[n, i] = inference.sensory_precision
            if i < S:
                precision[n, i] *= rows.seen[n, i]

    state = sense(infer(mu, left, readout.W_F, precision, inference), readout.W_F)
    for n in range(past.shape[0]):
        for i in range(S):
            if rows.seen[n, i] == 0:
                sensed[n, i] = past[n, i] + state[n, i]


class CarriedNetwork(TemporalNetwork):
    """A network whose state follows from what is carried on; ``weights`` has W_C, W_F and W_D."""

    @property
    def hidden_size(self) -> int:
        return int(self.weights.W_C.shape[0])

    @property
    def motor(self) -> int:
        return int(self.weights.W_D.shape[1] - self.weights.W_C.shape[1] - 1)

    def at_rest(self, batch: int) -> NDArray[np.float32]:
        return np.zeros((batch, self.weights.W_C.shape[1]), np.float32)

    @abstractmethod
    def advance(self, m: Array, rows: Array) -> Array:
        """Return m_t (B, I) from m_{t-1} and the rows r_t (B, R)."""

    def follow(self, c: Array, u: Array, x: Array, seen: Array) -> Step:
        w = self.weights
        mu = outward(c, w.W_C)
        past = direct(c, u, w.W_D)
        action = u[:, :-1]
        precision = self.inference.sensory_precision * np.hstack([seen, np.ones_like(action)])
        z = infer(mu, np.hstack([x, action]) - past, w.W_F, precision, self.inference)
        inferred = past + sense(z, w.W_F)
        senses = np.where(seen > 0, x, inferred[:, : x.shape[1]])
        carried = self.advance(c, np.hstack([senses, u]))
        return Step(mu, past + sense(mu, w.W_F), z, carried, senses)

    def run_on(self, c: Array) -> Step:
        w = self.weights
        sensory = w.W_F.shape[0] - self.motor
        mu = outward(c, w.W_C)
        state = sense(mu, w.W_F)
        u = np.zeros((len(c), self.motor + 1), np.float32)
        u[:, -1] = 1.0
        # No synapse leads from an action to itself.
        u[:, :-1] = (direct(c, u, w.W_D) + state)[:, sensory:]
        expected = direct(c, u, w.W_D) + state
        senses = expected[:, :sensory]
        carried = self.advance(c, np.hstack([senses, u]))
        return Step(mu, expected, mu, carried, senses)
