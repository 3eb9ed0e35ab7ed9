"""Learning of the network that settles: every synapse changes by what its own two ends do, and by nothing else.

    F_t = ½ Π_z ‖z_t - μ_t‖² + ½ Π_x ‖x_t - W_F f(z_t) - b_F‖² + ½ ‖a_t - W_A f(h_t)‖²      see ``settling``
    ΔW_H ∝ (Π_z ε_z + ε_h) f(z_{t-1})ᵀ    ΔW_U ∝ Π_z ε_z [a_t, 1]ᵀ + ε_h [0, 1]ᵀ    ε_h = f'(h_t) ⊙ W_Aᵀ ε_a
    ΔW_F ∝ Π_x ε_x f(z_t)ᵀ    ΔW_A ∝ ε_a f(h_t)ᵀ

Each is -∂F_t/∂W at the settled state. Nothing goes back through time: a step teaches what the step before handed it,
and nothing further back. So W_H begins near the identity, by which a unit carries on what it was, and the step before
hands on what was long before it. After a random cue a stream may run on alone, as in ``scheduled_sampling``: what is
handed on is then μ_t, and the action its own.

Sources: Millidge et al. 2024 (PLOS Comput Biol); Kingma and Ba 2015 for the step size; Bengio et al. 2015 (NeurIPS) for
learning from own predictions; Le et al. 2015 (arXiv 1504.00941) for beginning at the identity.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from typing import NamedTuple

import numpy as np

from asm_gym.memory.energy import Array, activate, outward
from asm_gym.memory.inference import infer
from asm_gym.memory.learning import Schedule, Synapse, Trajectory, coincidence, power_iteration
from asm_gym.memory.scheduled_sampling import LONGEST_CUE, Moment, practise
from asm_gym.memory.settling import SettlingNetwork, SettlingWeights, settling_shapes
from asm_gym.memory.temporal import Trained, unassociated

LEAST, FAINT = 0.9, 0.1
"""What units begin with of their own last state, from this to the whole; and the gain from all the others."""


def initial_settling_weights(
    hidden: int, sensory: int, motor: int, rng: np.random.Generator, least: float = LEAST
) -> SettlingWeights:
    """Random weights of about unit gain, but from state to state, where each unit sustains itself; no biases.

    Args:
        hidden, sensory, motor: H, S, A.
        rng: what draws them.
        least: what of its own last state a unit has at least.
    """
    weights = {n: np.zeros(shape, np.float32) for n, shape in settling_shapes(hidden, sensory, motor).items()}
    for name in ("W_H", "W_U", "W_F", "W_A"):
        W = weights[name]
        W[:] = rng.standard_normal(W.shape) / np.sqrt(W.shape[1])
    weights["W_H"][:] = FAINT * weights["W_H"] + np.diag(np.linspace(least, 1.0, hidden, dtype=np.float32))
    return SettlingWeights(**weights)


def settling_change(
    before: Array, u: Array, h: Array, errors: tuple[Array, Array, Array], z: Array, W_A: Array
) -> SettlingWeights:
    """What one control step asks of each array: the sum of local products, averaged over the batch.

    Args:
        before, z: (B, H) the state carried so far, and the one inferred.
        u: (B, A + 1) what was taken for the action, and a constant 1.
        h: (B, H) what the motor prediction was read from.
        errors: Π_z ε_z (B, H), Π_x ε_x (B, S) at ``z``, and ε_a (B, A).
        W_A: (A, H), by whose transpose ε_a comes back to h.
    """
    state, senses, action = errors
    f = activate(h)
    motor = (np.float32(1) - f * f) * (action @ W_A)  # (B, H) ε_h
    W_U = coincidence(state, u)
    W_U[:, -1] += motor.mean(axis=0)
    return SettlingWeights(
        W_H=coincidence(state + motor, activate(before)),
        W_U=W_U,
        W_F=coincidence(senses, activate(z)),
        b_F=senses.mean(axis=0),
        W_A=coincidence(action, f),
    )


class SettledStep(NamedTuple):
    """What a control step of learning came to."""

    mu: Array  # (B, H)
    z: Array  # (B, H)
    energy: float  # F, the sum over the batch


class SettlingLearner:
    """Weights in the making: the synapses, their running moments, and the curvature that inference needs."""

    def __init__(self, weights: SettlingWeights, schedule: Schedule, rng: np.random.Generator) -> None:
        self.weights, self.schedule, self.rng = weights, schedule, rng
        self.synapses = {name: Synapse(W) for name, W in weights._asdict().items()}
        self._direction = rng.standard_normal(weights.W_F.shape[1]).astype(np.float32)
        for _ in range(20):
            self._norm, self._direction = power_iteration(weights.W_F, self._direction)

    def action(self, before: Array) -> Array:
        """â_t (B, A) after the state (B, H)."""
        w = self.weights
        found: Array = outward(activate(outward(activate(before), w.W_H) + w.W_U[:, -1]), w.W_A)
        return found

    def step(self, before: Array, u: Array, x: Array, rate: float, taken: Array | None = None) -> SettledStep:
        """One control step of a batch.

        Args:
            before: (B, H) z_{t-1}.
            u: (B, A + 1) the action as commanded, and a constant 1.
            x: (B, S) what is sensed.
            rate: of the synapses.
            taken: (B, A + 1) what is taken for the action; ``u`` where None.
        """
        w, how = self.weights, self.schedule
        pi_z, pi_x = np.float32(how.prior_precision), np.float32(how.sensory_precision)
        taken = u if taken is None else taken
        carried = outward(activate(before), w.W_H)
        mu, h = carried + outward(taken, w.W_U), carried + w.W_U[:, -1]
        left, curvature = x - w.b_F, np.float32(pi_z + pi_x * self._norm)
        z = infer(mu, left, w.W_F, pi_z, np.full_like(x, pi_x), curvature, how.iterations)
        state, senses = z - mu, left - outward(activate(z), w.W_F)
        action = np.ascontiguousarray(u[:, :-1]) - outward(activate(h), w.W_A)
        total = 0.5 * float(pi_z * np.sum(state**2) + pi_x * np.sum(senses**2) + np.sum(action**2))
        change = settling_change(before, taken, h, (pi_z * state, pi_x * senses, action), z, w.W_A)
        for name, synapse in self.synapses.items():
            synapse.learn(getattr(change, name), rate)
        # W_F moves little in a step, so one iteration keeps the norm up to date.
        self._norm, self._direction = power_iteration(w.W_F, self._direction)
        return SettledStep(mu, z, total)


class SettlingStreams:
    """Streams that a learner follows and runs on from, and where they are.

    Args:
        learner: whose synapses change.
        size: B, streams side by side.

    Attributes:
        z: (B, H) what is carried on.
        alone: (B, 1) whether it is the expected state.
        steps: (B, 1) since the episode began; a stream that begins in mid-episode counts from there.
        cue: (B, 1) how many of them must be read.
    """

    def __init__(self, learner: SettlingLearner, size: int) -> None:
        self.learner = learner
        self.z: Array = np.zeros((size, learner.weights.W_H.shape[0]), np.float32)
        self.alone = np.zeros((size, 1), np.bool_)
        self.steps = np.zeros((size, 1), np.intp)
        self.cue = np.full((size, 1), LONGEST_CUE)

    def run(self, moments: Iterable[Moment], rate: float, free: float) -> float:
        """Learns from the moments that come next; the sum of all energies.

        Args:
            free: probability, in each step after a random cue, that a stream runs on alone: the state handed on is the
                expected one and not the inferred one, and so is the action that comes with the next.
        """
        learner, total = self.learner, 0.0
        for now in moments:
            z = np.where(now.begins, np.float32(0), self.z)
            self.steps = np.where(now.begins, 0, self.steps) + 1
            self.cue = np.where(now.begins, learner.rng.integers(1, LONGEST_CUE, self.cue.shape), self.cue)
            own, taken = self.alone & ~now.begins, now.commands
            if own.any():
                taken = np.hstack([np.where(own, learner.action(z), taken[:, :-1]), taken[:, -1:]])
            step = learner.step(z, now.commands, now.senses, rate, taken)
            self.alone = (self.steps >= self.cue) & (learner.rng.random(self.cue.shape) < free)
            self.z = np.where(self.alone, step.mu, step.z)
            total += step.energy
        return total


def learn_settling(
    trajectories: Sequence[Trajectory],
    hidden: int,
    schedule: Schedule,
    rng: np.random.Generator,
    tick: Callable[[], None],
) -> Trained:
    """Learns the synapses through time; see ``temporal.Learn``."""
    sensory, commands = trajectories[0].senses.shape[1], trajectories[0].commands.shape[1]
    # What runs on alone must keep what it was shown; over hundreds of rows that are read, what keeps everything drifts.
    least = 1.0 if schedule.free_running_probability > 0 else LEAST
    weights = initial_settling_weights(hidden, sensory, commands - 1, rng, least)
    streams = SettlingStreams(SettlingLearner(weights, schedule, rng), schedule.batch_size)
    energy = practise(streams, hidden, trajectories, schedule, rng, tick)
    how = schedule.iterations, schedule.prior_precision, schedule.sensory_precision
    return Trained(SettlingNetwork(weights, unassociated(), *how), energy)
