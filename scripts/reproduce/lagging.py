"""The network that settles where its units cannot jump: inference begins at the state of the row before.

    z_t    from z_{t-1} on, so many steps down F;  μ_t = W_H f(z_{t-1}) + W_U [a_t, 1] as ever
    alone  the senses are free, so that F is ½ Π_z ‖z - μ_t‖², and what is expressed is W_F f(z_t) + b_F

This package begins at μ_t, and so has at once what neurons take time to get to. With inference until nothing moves the
two are the same.

Source: the authors' script for Fig 3 of Millidge et al. 2024 (PLOS Comput Biol), which begins at the last state.
"""

from __future__ import annotations

from typing import Self

import numpy as np

from asm_gym.memory.energy import Array, activate
from asm_gym.memory.inference import infer_from
from asm_gym.memory.settling import SettlingNetwork
from asm_gym.memory.temporal import Step


class LaggingNetwork(SettlingNetwork):
    """The arguments are those of ``TemporalNetwork``."""

    @classmethod
    def of(cls, network: SettlingNetwork) -> Self:
        """The same synapses."""
        how = network.iterations, float(network.prior_precision), float(network.sensory_precision)
        return cls(network.weights, network.association, *how)

    def follow(self, c: Array, u: Array, x: Array, seen: Array) -> Step:
        mu, action = self._expected(c, u)
        z = self._settled(c, mu, x, self.sensory_precision * seen)
        return Step(mu, np.hstack([self._sense(mu), action]), z, z)

    def carry_on(self, c: Array, u: Array, x: Array, seen: Array) -> tuple[Array, Array]:
        step = self.follow(c, u, x, seen)
        return activate(step.mu), step.z

    def run_on(self, c: Array) -> Step:
        alone = super().run_on(c)
        S = self.weights.W_F.shape[0]
        free = np.zeros((len(c), S), np.float32)
        z = self._settled(c, alone.mu, free, free)
        return Step(alone.mu, np.hstack([self._sense(z), alone.expected[:, S:]]), z, z)

    def _settled(self, c: Array, mu: Array, x: Array, precision: Array) -> Array:
        w = self.weights
        found: Array = infer_from(
            c, mu, x - w.b_F, w.W_F, self.prior_precision, precision, self.curvature, self.iterations
        )
        return found
