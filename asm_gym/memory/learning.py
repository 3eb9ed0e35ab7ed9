"""Learning: every synapse changes by what its own two ends do, and by nothing else.

    ΔW_C ∝ Π_z ε_z c_{t-1}ᵀ    ΔW_F ∝ Π_x ε_x f(z_t)ᵀ    ΔW_D ∝ Π_x ε_x [c_{t-1}, a_t, 1]ᵀ
    ε_z = z_t - μ_t    ε_x = [x_t, a_t] - [x̂_t, â_t]

z_t is where inference settles, given the senses and the action. Each synapse scales its step by running moments of its
own change (the rule of Adam), so that stays local too. Nothing is propagated through time: the traces that are handed
from step to step have no synapses to be taught. With Π_z large against Π_x, ε_z is the error that backpropagation
would send to the state (Whittington and Bogacz 2017); it comes by the transpose of W_F, as inference itself does.

Source: Millidge et al. 2024 (PLOS Comput Biol); Kingma and Ba 2015 for the step size.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from asm_gym.memory.energy import Array, activate, kernel
from asm_gym.memory.inference import Weights, direct, direct_synapses, expect, infer, sense

UPDATES, RECALL_UPDATES = 10_000, 50_000
"""Steps of a batch that are learned from at most, without and with learning to run on alone, which takes longer: with
very many episodes fewer passes over them are enough."""

REFERENCE_WIDTH = 256
"""Hidden units up to which ``learning_rate`` is taken as it is; beyond them learning would diverge."""


class Trajectory(NamedTuple):
    """One episode as the network reads it; float32, standardised.

    ``senses`` and ``commands`` are those of the T steps of the temporal network; where rows come faster than these,
    N is larger.
    """

    senses: Array  # (T, X)
    commands: Array  # (T, A + 1), the last one a constant 1
    inputs: Array  # (N, I) of association


class Batch(NamedTuple):
    """Episodes side by side, the longest first: at step t the first ``active[t]`` are still running."""

    senses: Array  # (T, B, X)
    commands: Array  # (T, B, A + 1)
    active: NDArray[np.intp]  # (T,)


def side_by_side(trajectories: Sequence[Trajectory]) -> Batch:
    """Stacks episodes of different lengths along a new second axis."""
    ordered = sorted(trajectories, key=lambda t: -len(t.senses))
    lengths = np.array([len(t.senses) for t in ordered])
    senses, commands = (
        np.zeros((lengths[0], len(ordered), array.shape[1]), np.float32)
        for array in (ordered[0].senses, ordered[0].commands)
    )
    for n, trajectory in enumerate(ordered):
        senses[: lengths[n], n] = trajectory.senses
        commands[: lengths[n], n] = trajectory.commands
    return Batch(senses, commands, active=(lengths > np.arange(lengths[0])[:, None]).sum(axis=1))


def batches(trajectories: Sequence[Trajectory], size: int, rng: np.random.Generator) -> list[Batch]:
    """All episodes in batches of similar length, in random order."""
    shuffled = rng.permutation(len(trajectories))
    by_length = shuffled[np.argsort([len(trajectories[i].senses) for i in shuffled], kind="stable")]
    groups = [by_length[i : i + size] for i in range(0, len(by_length), size)]
    return [side_by_side([trajectories[i] for i in groups[g]]) for g in rng.permutation(len(groups))]


def shuffled(count: int, size: int, rng: np.random.Generator) -> Iterator[NDArray[np.intp]]:
    """Batches of indices without end, every one of ``count`` once before any comes again."""
    while True:
        order = rng.permutation(count)
        yield from (order[start : start + size] for start in range(0, count, size))


@kernel
def coincidence(post: Array, pre: Array) -> Array:
    """Mean over the batch of ``post`` (B, P) times ``pre`` (B, Q), for every pair of units: (P, Q)."""
    out = np.empty((post.shape[1], pre.shape[1]), post.dtype)
    np.dot(post.T, pre, out)
    out /= np.float32(post.shape[0])
    return out


@kernel
def adapt(W: Array, mean: Array, square: Array, change: Array, rate: float, count: int) -> None:
    """Moves ``W`` along ``change`` in place; all four have one shape. ``count``: updates so far, this one included."""
    w, m, s, c = W.reshape(-1), mean.reshape(-1), square.reshape(-1), change.reshape(-1)
    m_scale = np.float32(rate / (1.0 - 0.9**count))
    s_scale = np.float32(1.0 / (1.0 - 0.999**count))
    for k in range(w.size):
        m[k] = np.float32(0.9) * m[k] + np.float32(0.1) * c[k]
        s[k] = np.float32(0.999) * s[k] + np.float32(0.001) * c[k] * c[k]
        w[k] += m_scale * m[k] / (np.sqrt(s_scale * s[k]) + np.float32(1e-8))


class Synapse:
    """One weight array and the running moments that set its steps."""

    def __init__(self, W: Array) -> None:
        self.W = W
        self.mean, self.square, self.count = np.zeros_like(W), np.zeros_like(W), 0

    def learn(self, change: Array, rate: float) -> None:
        """One step of about ``rate`` a synapse in the direction of ``change``, which has the shape of ``W``."""
        if self.W.size:
            self.count += 1
            adapt(self.W, self.mean, self.square, change, rate, self.count)


def cosine_decay(rate: float, progress: float) -> float:
    """``rate`` at progress 0, zero at progress 1."""
    return 0.5 * rate * (1.0 + float(np.cos(np.pi * progress)))


@kernel
def power_iteration(W: Array, v: Array) -> tuple[float, Array]:
    """One step towards ‖W‖² (spectral) and its right singular vector ``v`` (H,), which is returned with length 1."""
    v = np.dot(np.dot(W, v), W)
    norm = np.sqrt(np.sum(v * v))
    return norm, v / (norm + np.float32(1e-12))


class HebbianChange(NamedTuple):
    """What one control step asks of each weight array (the sum of local products, averaged over the batch)."""

    W_C: Array
    W_F: Array
    W_D: Array


def hebbian_change(
    c: Array, u: Array, mu: Array, z: Array, error: Array, pi_z: float, exists: Array | None = None
) -> HebbianChange:
    """The local learning rules.

    Args:
        c: (B, I) the traces before.
        u: (B, A + 1) the action, and a constant 1.
        mu, z: (B, H) the expected state, and the inferred one.
        error: (B, S + A) Π_x ε_x at ``z``.
        pi_z: Π_z.
        exists: ``direct_synapses`` of W_D, for whoever asks often.
    """
    motor = u.shape[1] - 1
    exists = direct_synapses(error.shape[1] - motor, motor) if exists is None else exists
    return HebbianChange(
        W_C=coincidence(np.float32(pi_z) * (z - mu), c),
        W_F=coincidence(error, activate(z)),
        W_D=coincidence(error, np.hstack([c, u])) * exists,
    )


class Schedule(NamedTuple):
    """How to learn; the same names as the hyperparameters of ``NeuralASM``, which explains them."""

    epochs: int
    batch_size: int
    learning_rate: float
    iterations: int
    prior_precision: float
    sensory_precision: float
    free_running_probability: float


class LearningStep(NamedTuple):
    """What a control step of learning came to."""

    expected: Array  # (B, S + A) x̂_t and â_t, before anything was read
    energy: float  # the sum over the batch


class Learner:
    """Weights in the making: the synapses, their running moments, and the curvature that inference needs."""

    def __init__(self, weights: Weights, schedule: Schedule, rng: np.random.Generator) -> None:
        self.weights, self.schedule, self.rng = weights, schedule, rng
        self.synapses = {name: Synapse(getattr(weights, name)) for name in HebbianChange._fields}
        motor = weights.W_D.shape[1] - weights.W_C.shape[1] - 1
        self._direct = direct_synapses(len(weights.W_D) - motor, motor)
        self._direction = rng.standard_normal(weights.W_F.shape[1]).astype(np.float32)
        for _ in range(20):
            self._norm, self._direction = power_iteration(weights.W_F, self._direction)

    def step(self, c: Array, u: Array, x: Array, rate: float, taken: Array | None = None) -> LearningStep:
        """One control step of a batch.

        Args:
            c: (B, I) the traces before.
            u: (B, A + 1) the action as commanded, and a constant 1.
            x: (B, S) what is sensed.
            rate: of the synapses.
            taken: (B, A + 1) what is taken for the action in predicting the senses; ``u`` where None.
        """
        w, pi_z, pi_x = self.weights, self.schedule.prior_precision, self.schedule.sensory_precision
        taken = u if taken is None else taken
        past = direct(c, taken, w.W_D)
        left = np.hstack([x, u[:, :-1]]) - past  # (B, S + A)
        precision = np.full_like(left, pi_x)
        mu = expect(c, w.W_C)
        z = infer(mu, left, w.W_F, pi_z, precision, pi_z + pi_x * self._norm, self.schedule.iterations)
        error = np.float32(pi_x) * (left - sense(z, w.W_F))
        change = hebbian_change(c, taken, mu, z, error, pi_z, self._direct)
        total = 0.5 * (pi_z * float(np.sum((z - mu) ** 2)) + float(np.sum(error**2)) / pi_x)
        expected = past + sense(mu, w.W_F)
        for name, synapse in self.synapses.items():
            synapse.learn(getattr(change, name), rate)
        # W_F moves little in a step, so one iteration keeps the norm up to date.
        self._norm, self._direction = power_iteration(w.W_F, self._direction)
        return LearningStep(expected, total)


def passes(trajectories: Sequence[Trajectory], schedule: Schedule) -> int:
    """How often all episodes are learned from."""
    updates = sum(len(t.senses) for t in trajectories) / schedule.batch_size
    most = RECALL_UPDATES if schedule.free_running_probability > 0 else UPDATES
    return max(1, min(schedule.epochs, round(most / updates)))


def largest_rate(hidden: int, schedule: Schedule) -> float:
    """The learning rate to begin with, of H hidden units."""
    return schedule.learning_rate * min(1.0, REFERENCE_WIDTH / hidden)
