"""Learning of the network by traces: every synapse changes by what its own two ends do.

    ΔW_C ∝ Π_z ε_z c_{t-1}ᵀ    ΔW_F ∝ Π_x ε_x f(z_t)ᵀ    ΔW_D ∝ Π_x ε_x [c_{t-1}, a_t, 1]ᵀ
    ε_z = z_t - μ_t    ε_x = [x_t, a_t] - [x̂_t, â_t]

z_t is where inference ends, given the senses and the action. Nothing is propagated through time: the traces have no
synapses that would need an error. For Π_z large against Π_x, ε_z is the error that backpropagation would send to the
state (Whittington and Bogacz 2017); it comes by the transpose of W_F, as inference does.

Source: Millidge et al. 2024 (PLOS Comput Biol).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from asm_gym.memory.energy import Array, activate
from asm_gym.memory.inference import Weights, direct, direct_synapses, expect, infer, sense, weight_shapes
from asm_gym.memory.learning import Learner, Schedule, Tick, Trajectory, coincidence
from asm_gym.memory.network import Network
from asm_gym.memory.practice import Moment, practise
from asm_gym.memory.temporal import Trained, unassociated
from asm_gym.memory.traces import DECAYS, advance, at_rest, fit_gains


class HebbianChange(NamedTuple):
    """The change of each weight array: local products, averaged over a batch."""

    W_C: Array
    W_F: Array
    W_D: Array


def initial_weights(hidden: int, sensory: int, motor: int, rng: np.random.Generator) -> Weights:
    """Return random weights of about unit gain into the state and of gain 0.1 out of it, and no direct ones."""
    weights = {n: np.zeros(shape, np.float32) for n, shape in weight_shapes(hidden, sensory, motor).items()}
    for name, gain in (("W_C", 1.0), ("W_F", 0.1)):
        W = weights[name]
        W[:] = gain * rng.standard_normal(W.shape) / np.sqrt(W.shape[1])
    weights["gains"][:] = np.float32(1) - DECAYS
    return Weights(**weights)


def hebbian_change(
    c: Array, u: Array, mu: Array, z: Array, error: Array, pi_z: float, exists: Array | None = None
) -> HebbianChange:
    """Apply the local learning rules.

    Args:
        c: (B, I) the traces before.
        u: (B, A + 1) the action, and a constant 1.
        mu, z: (B, H) the expected state, and the inferred one.
        error: (B, S + A) Π_x ε_x at ``z``.
        pi_z: Π_z.
        exists: ``direct_synapses`` of W_D, computed where None.
    """
    motor = u.shape[1] - 1
    exists = direct_synapses(error.shape[1] - motor, motor) if exists is None else exists
    return HebbianChange(
        W_C=coincidence(np.float32(pi_z) * (z - mu), c),
        W_F=coincidence(error, activate(z)),
        W_D=coincidence(error, np.hstack([c, u])) * exists,
    )


class TracesLearner(Learner):
    """The network by traces as it learns."""

    weights: Weights
    early = 0

    def __init__(self, weights: Weights, schedule: Schedule, rng: np.random.Generator) -> None:
        super().__init__(weights, HebbianChange._fields, schedule, rng)
        motor = weights.W_D.shape[1] - weights.W_C.shape[1] - 1
        self._direct = direct_synapses(len(weights.W_D) - motor, motor)

    def at_rest(self, size: int) -> Array:
        return at_rest(size, len(self.weights.W_F) + 1)

    def practise(
        self, state: Array, now: Moment, own: NDArray[np.bool_], alone: NDArray[np.bool_], rate: float
    ) -> tuple[Array, float]:
        taken, S = now.commands, now.senses.shape[1]
        if own.any():
            w = self.weights
            action = (direct(state, taken, w.W_D) + sense(expect(state, w.W_C), w.W_F))[:, S:]
            taken = np.hstack([np.where(own, action, taken[:, :-1]), taken[:, -1:]])
        expected, energy = self.step(state, now.commands, now.senses, rate, taken)
        senses = np.where(alone, expected[:, :S], now.senses)
        return advance(state, np.hstack([senses, taken]), self.weights.gains), energy

    def step(self, c: Array, u: Array, x: Array, rate: float, taken: Array | None = None) -> tuple[Array, float]:
        """Learn from one row; return [x̂_t, â_t] (B, S + A) as expected before it, and the energy of the batch.

        Args:
            c: (B, I) the traces before.
            u: (B, A + 1) the action as commanded, and a constant 1.
            x: (B, S) what is sensed.
            rate: of the synapses.
            taken: (B, A + 1) the action that the prediction of the senses uses; ``u`` where None.
        """
        w, pi_z, pi_x = self.weights, self.schedule.prior_precision, self.schedule.sensory_precision
        taken = u if taken is None else taken
        past = direct(c, taken, w.W_D)
        left = np.hstack([x, u[:, :-1]]) - past  # (B, S + A)
        precision = np.full_like(left, pi_x)
        mu = expect(c, w.W_C)
        z = infer(mu, left, w.W_F, pi_z, precision, pi_z + pi_x * self.norm, self.schedule.iterations)
        error = np.float32(pi_x) * (left - sense(z, w.W_F))
        change = hebbian_change(c, taken, mu, z, error, pi_z, self._direct)
        energy = 0.5 * (pi_z * float(np.sum((z - mu) ** 2)) + float(np.sum(error**2)) / pi_x)
        expected = past + sense(mu, w.W_F)
        self.learn(change, rate)
        return expected, energy


def learn_traces(
    trajectories: Sequence[Trajectory],
    hidden: int,
    schedule: Schedule,
    rng: np.random.Generator,
    tick: Tick,
    gain: float = 1.0,
) -> Trained:
    """Learn the synapses through time; see ``temporal.Learn``.

    Args:
        gain: factor of the initial weights onto the state.
    """
    sensory, commands = trajectories[0].senses.shape[1], trajectories[0].commands.shape[1]
    weights = initial_weights(hidden, sensory, commands - 1, rng)
    weights.gains[:] = fit_gains([np.hstack([t.senses, t.commands]) for t in trajectories])
    weights.W_C[:] *= np.float32(gain)
    energy = practise(TracesLearner(weights, schedule, rng), hidden, trajectories, schedule, rng, tick)
    how = schedule.iterations, schedule.prior_precision, schedule.sensory_precision
    return Trained(Network(weights, unassociated(), *how), energy)
