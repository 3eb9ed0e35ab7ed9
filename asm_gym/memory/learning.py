"""Learning: every synapse changes by what its own two ends do, and by nothing else.

    ΔW_H ∝ Π_z ε_z f(z_{t-1})ᵀ    ΔW_U ∝ Π_z ε_z u_tᵀ    ΔW_F ∝ Π_x ε_x f(z_t)ᵀ    ΔW_A ∝ ε_a f(h_t)ᵀ
    ε_z = z_t - μ_t    ε_x = x_t - x̂_t    ε_a = a_t - W_A f(h_t),  h_t = μ_t without the part of the action

Each synapse scales its step by running moments of its own change (the rule of Adam), so that stays local too. Nothing
is propagated through time: the state is handed from step to step, the errors are not.

Source: Millidge et al. 2024 (PLOS Comput Biol); Kingma and Ba 2015 for the step size.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from asm_gym.memory.energy import Array, activate, energy, kernel
from asm_gym.memory.inference import Weights, expect, infer, sense

UPDATES = 50_000
"""Steps of a batch that are learned from at most: with very many episodes fewer passes over them are enough."""

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


class Change(NamedTuple):
    """What one control step asks of each weight array (the sum of local products, averaged over the batch)."""

    W_H: Array
    W_U: Array
    W_F: Array
    b_F: Array  # noqa: N815
    W_A: Array


def hebbian_change(
    weights: Weights,
    before: Array,
    mu: Array,
    after: Array,
    u: Array,
    x: Array,
    pi_z: float,
    pi_x: float,
    drive: Array | None = None,
) -> Change:
    """The local learning rules, for states ``before`` and ``after`` (B, H) and the expected ``mu`` (B, H).

    ``drive`` (B, A + 1) is what ``mu`` was expected by, where that was not the commanded ``u``.
    """
    A = u.shape[1] - 1
    drive = u if drive is None else drive
    error_z = pi_z * (after - mu)  # (B, H)
    error_x = pi_x * (x - sense(after, weights.W_F, weights.b_F))  # (B, X)
    # The motor prediction must not see the action it predicts, only the constant that came with it.
    expected = activate(mu - drive[:, :A] @ weights.W_U[:, :A].T)  # (B, H)
    error_a = u[:, :A] - expected @ weights.W_A.T  # (B, A)
    return Change(
        W_H=coincidence(error_z, activate(before)),
        W_U=coincidence(error_z, drive),
        W_F=coincidence(error_x, activate(after)),
        b_F=error_x.mean(axis=0),
        W_A=coincidence(np.ascontiguousarray(error_a), expected),
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


class Step(NamedTuple):
    """What a control step of learning came to."""

    expected: Array  # (B, H) μ_t
    inferred: Array  # (B, H) z_t
    energy: float  # the sum over the batch


class Learner:
    """Weights in the making: the synapses, their running moments, and the curvature that inference needs."""

    def __init__(self, weights: Weights, schedule: Schedule, rng: np.random.Generator) -> None:
        self.weights, self.schedule, self.rng = weights, schedule, rng
        self.synapses = {name: Synapse(getattr(weights, name)) for name in Change._fields}
        self._direction = rng.standard_normal(weights.W_F.shape[1]).astype(np.float32)
        for _ in range(20):
            self._norm, self._direction = power_iteration(weights.W_F, self._direction)

    def step(self, before: Array, u: Array, x: Array, rate: float, drive: Array | None = None) -> Step:
        """One control step of a batch.

        Args:
            before: (B, H) z_{t-1}.
            u: (B, A + 1) the action as commanded, and a constant 1.
            x: (B, S) what is sensed.
            rate: of the synapses.
            drive: (B, A + 1) what is taken for the action; ``u`` where None.
        """
        w, pi_z, pi_x = self.weights, self.schedule.prior_precision, self.schedule.sensory_precision
        precision = np.full_like(x, pi_x)
        drive = u if drive is None else drive
        mu = expect(before, drive, w.W_H, w.W_U)
        curvature = pi_z + pi_x * self._norm
        after = infer(mu, x, w.W_F, w.b_F, pi_z, precision, curvature, self.schedule.iterations)
        change = hebbian_change(w, before, mu, after, u, x, pi_z, pi_x, drive)
        total = float(energy(after, mu, x, w.W_F, w.b_F, pi_z, precision).sum())
        for name, synapse in self.synapses.items():
            synapse.learn(getattr(change, name), rate)
        # W_F moves little in a step, so one iteration keeps the norm up to date.
        self._norm, self._direction = power_iteration(w.W_F, self._direction)
        return Step(mu, after, total)

    def run(self, batch: Batch, rate: float) -> float:
        """Learns through a batch of episodes, handing the inferred state on; the sum of all energies."""
        z = np.zeros((batch.senses.shape[1], self.weights.W_H.shape[0]), np.float32)
        total = 0.0
        for x, u, n in zip(batch.senses, batch.commands, batch.active, strict=True):
            step = self.step(z[:n], u[:n], x[:n], rate)
            total += step.energy
            z = step.inferred
        return total


def passes(trajectories: Sequence[Trajectory], schedule: Schedule) -> int:
    """How often all episodes are learned from."""
    updates = sum(len(t.senses) for t in trajectories) / schedule.batch_size
    return max(1, min(schedule.epochs, round(UPDATES / updates)))


def largest_rate(weights: Weights, schedule: Schedule) -> float:
    """The learning rate to begin with."""
    return schedule.learning_rate * min(1.0, REFERENCE_WIDTH / weights.W_H.shape[0])


def learn(
    weights: Weights,
    trajectories: Sequence[Trajectory],
    schedule: Schedule,
    rng: np.random.Generator,
    tick: Callable[[], None],
) -> NDArray[np.float64]:
    """Learns in place; the mean energy of each epoch. Calls ``tick`` after each, of which many data need fewer."""
    learner = Learner(weights, schedule, rng)
    widest = largest_rate(weights, schedule)
    steps = sum(len(t.senses) for t in trajectories)
    epochs = passes(trajectories, schedule)
    curve = np.zeros(epochs)
    for epoch in range(epochs):
        progress = epoch / epochs
        rate = cosine_decay(widest, progress)
        for batch in batches(trajectories, schedule.batch_size, rng):
            curve[epoch] += learner.run(batch, rate) / steps
        tick()
    return curve
