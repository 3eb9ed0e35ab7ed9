"""Learning rules, and the passes over episodes by which a temporal network learns.

    ΔW ∝ ⟨post preᵀ⟩ over a batch,     step: rate · m / √s       m, s: running mean and mean square of ΔW (Adam)

The step size of a synapse uses that synapse's own history only, so it is local too. Episodes are passed over in many
parallel streams. After a random cue, and with a probability that rises during learning, a stream runs on alone for a
row: the action is the memory's own and its state follows from its own prediction.

Sources: Kingma and Ba 2015 (ICLR) for the step size; Tang et al. 2023 (NeurIPS) for offline recall; Bengio et al. 2015
(NeurIPS) for learning from own predictions.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Iterator, Sequence
from itertools import islice
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from asm_gym.memory.energy import Array, Inference, kernel

Tick = Callable[[], None]
"""Reports progress."""

LONGEST_CUE = 30  # a stream reads fewer rows than this before it may run on alone
UPDATES = 10_000  # largest number of batches
RECALL_UPDATES = (
    50_000  # the same of a network that learns to run on alone, by itself or against noise
)
# hidden units up to which ``learning_rate`` is used as it is; it is scaled down beyond
REFERENCE_WIDTH = 256


class Trajectory(NamedTuple):
    """One episode as the memory reads it; float32, standardised. Above the control rate association has N > T rows."""

    senses: Array  # (T, S)
    commands: Array  # (T, A + 1), the last one a constant 1
    inputs: Array  # (N, I) of association


class Schedule(NamedTuple):
    """Hyperparameters of the temporal network; ``NeuralASM`` explains them."""

    epochs: int
    batch_size: int
    learning_rate: float
    iterations: int
    prior_precision: float
    sensory_precision: float
    free_running_probability: float
    noise: float = 0.0  # standard deviation of that on what recurrent units carry on


def shuffled(count: int, size: int, rng: np.random.Generator) -> Iterator[NDArray[np.intp]]:
    """Yield batches of indices without end, each of ``count`` once before any comes again."""
    while True:
        order = rng.permutation(count)
        for start in range(0, count, size):
            yield order[start : start + size]


def cosine_decay(rate: float, progress: float) -> float:
    """Return ``rate`` at progress 0, falling to zero at progress 1."""
    return 0.5 * rate * (1.0 + float(np.cos(np.pi * progress)))


@kernel
def coincidence(post: Array, pre: Array) -> Array:
    """Return the mean over the batch of ``post`` (B, P) times ``pre`` (B, Q): (P, Q)."""
    out = np.empty((post.shape[1], pre.shape[1]), post.dtype)
    np.dot(post.T, pre, out)
    out /= np.float32(post.shape[0])
    return out


@kernel
def adapt(W: Array, mean: Array, square: Array, change: Array, rate: float, count: int) -> None:
    """Move ``W`` along ``change`` in place; all four are (N,). ``count``: updates so far, this one included."""
    m_scale = np.float32(rate / (1.0 - 0.9**count))
    s_scale = np.float32(1.0 / (1.0 - 0.999**count))
    for k in range(len(W)):
        mean[k] = np.float32(0.9) * mean[k] + np.float32(0.1) * change[k]
        square[k] = np.float32(0.999) * square[k] + np.float32(0.001) * change[k] * change[k]
        W[k] += m_scale * mean[k] / (np.sqrt(s_scale * square[k]) + np.float32(1e-8))


class Synapse:
    """One weight array with the running moments that set its steps."""

    def __init__(self, W: Array) -> None:
        self.W = W
        self.mean = np.zeros(W.size, W.dtype)
        self.square = np.zeros(W.size, W.dtype)
        self.count = 0

    def learn(self, change: Array, rate: float) -> None:
        """Take a step of about ``rate`` a synapse along ``change``, which has the shape of ``W``."""
        if self.W.size:
            self.count += 1
            adapt(self.W.reshape(-1), self.mean, self.square, change.reshape(-1), rate, self.count)


@kernel
def power_iteration(W: Array, v: Array) -> tuple[float, Array]:
    """Take a step towards ‖W‖² (spectral) and its right singular vector ``v`` (H,); return both, ‖v‖ = 1."""
    # numba takes half as long where the results exist already
    through = np.empty(W.shape[0], v.dtype)
    back = np.empty(v.shape, v.dtype)
    np.dot(W, v, through)
    np.dot(through, W, back)
    norm = np.sqrt(np.sum(back * back))
    return norm, back / (norm + np.float32(1e-12))


class Moment(NamedTuple):
    """One row of B streams."""

    senses: Array  # (B, S)
    commands: Array  # (B, A + 1)
    begins: NDArray[np.bool_]  # (B, 1) whether an episode begins


class Turn(NamedTuple):
    """One row of B streams to learn from, and which of them run on alone."""

    senses: Array  # (B, S)
    commands: Array  # (B, A + 1)
    own: NDArray[np.bool_]  # (B, 1) streams that take their own action
    alone: NDArray[np.bool_]  # (B, 1) streams whose next state follows from the prediction
    begins: NDArray[np.bool_]  # (B, 1) whether an episode begins

    def commands_with(self, action: Array) -> Array:
        """Return the commands (B, A + 1) that are taken where ``action`` (B, A) is the streams' own."""
        taken = np.where(self.own, action, self.commands[:, :-1])
        return np.hstack([taken, self.commands[:, -1:]])


class Learner(ABC):
    """A temporal network that learns: its weights, their running moments, and the norm that inference needs.

    Args:
        weights: the synapses through time, a NamedTuple with an array ``W_F`` (N, H); changed in place.
        schedule: how to learn.
        rng: draws the first direction of the power iteration.
    """

    learned: tuple[str, ...]  # names of the weights that are learned
    early: bool  # whether running alone is drawn for the row to come, not for the row itself

    def __init__(self, weights: Any, schedule: Schedule, rng: np.random.Generator) -> None:
        self.weights = weights
        self.schedule = schedule
        self.synapses = {name: Synapse(getattr(weights, name)) for name in self.learned}
        self._direction = rng.standard_normal(weights.W_F.shape[1]).astype(weights.W_F.dtype)
        for _ in range(20):
            self._follow_norm()

    def _follow_norm(self) -> None:
        self.norm, self._direction = power_iteration(self.weights.W_F, self._direction)

    @property
    def inference(self) -> Inference:
        """How to infer the state by the weights as they are."""
        pi_z = np.float32(self.schedule.prior_precision)
        pi_x = np.float32(self.schedule.sensory_precision)
        curvature = np.float32(pi_z + pi_x * self.norm)
        return Inference(pi_z, pi_x, curvature, self.schedule.iterations)

    def learn(self, change: Any, rate: float) -> None:
        """Move every synapse along its array in ``change``."""
        for name, synapse in self.synapses.items():
            synapse.learn(getattr(change, name), rate)
        # W_F moves little in a step, so one iteration keeps the norm up to date.
        self._follow_norm()

    @abstractmethod
    def at_rest(self, size: int) -> Array:
        """Return the state (B, Z) before an episode."""

    @abstractmethod
    def practise(self, state: Array, turn: Turn, rate: float) -> tuple[Array, float]:
        """Learn from one row; return the next state (B, Z) and the energy summed over the batch."""


def one_after_another(
    trajectories: Sequence[Trajectory], size: int, rng: np.random.Generator
) -> Iterator[Moment]:
    """Yield rows of ``size`` endless streams of episodes, each begun at a random row."""
    senses = np.concatenate([t.senses for t in trajectories])
    commands = np.concatenate([t.commands for t in trajectories])
    length = np.array([len(t.senses) for t in trajectories])
    start = np.cumsum(length) - length
    order = shuffled(len(trajectories), 1, rng)
    episode = np.array([next(order)[0] for _ in range(size)])
    step = rng.integers(length[episode])
    while True:
        row = start[episode] + step
        yield Moment(senses[row], commands[row], (step == 0)[:, None])
        step = step + 1
        for n in np.flatnonzero(step == length[episode]):
            episode[n] = next(order)[0]
            step[n] = 0


class Practice:
    """``size`` streams that a learner follows; ``rng`` draws their cues and which run on alone."""

    def __init__(self, learner: Learner, size: int, rng: np.random.Generator) -> None:
        self.learner = learner
        self.rng = rng
        self.state = learner.at_rest(size)
        self.cue = np.full((size, 1), LONGEST_CUE)
        # rows since the episode began, or since the stream began
        self._steps = np.zeros((size, 1), np.intp)
        self._alone = np.zeros((size, 1), np.bool_)

    def run(self, moments: Iterable[Moment], rate: float, free: float) -> float:
        """Learn from the moments, alone after the cue with probability ``free``; return the sum of all energies."""
        total = 0.0
        for now in moments:
            state = np.where(now.begins, np.float32(0), self.state)
            self._steps = np.where(now.begins, 0, self._steps) + 1
            cue = self.rng.integers(1, LONGEST_CUE, self.cue.shape)
            self.cue = np.where(now.begins, cue, self.cue)

            own = self._alone & ~now.begins
            cue_ends = self._steps + self.learner.early > self.cue
            self._alone = cue_ends & (self.rng.random(self.cue.shape) < free)
            if not self.learner.early:
                own = self._alone
            turn = Turn(now.senses, now.commands, own, self._alone, now.begins)
            self.state, energy = self.learner.practise(state, turn, rate)
            total += energy
        return total


def practise(
    learner: Learner, trajectories: Sequence[Trajectory], rng: np.random.Generator, tick: Tick
) -> NDArray[np.float64]:
    """Pass over the episodes with a decaying rate, more and more alone; return the mean energy of each pass."""
    schedule = learner.schedule
    hidden = learner.weights.W_F.shape[1]
    highest_rate = schedule.learning_rate * min(1.0, REFERENCE_WIDTH / hidden)
    streams = Practice(learner, schedule.batch_size, rng)
    moments = one_after_another(trajectories, schedule.batch_size, rng)
    steps = -(-row_count(trajectories) // schedule.batch_size)
    curve = np.zeros(passes(trajectories, schedule))
    for epoch in range(len(curve)):
        progress = epoch / len(curve)
        rate = cosine_decay(highest_rate, progress)
        free = schedule.free_running_probability * min(1.0, 2 * progress)
        energy = streams.run(islice(moments, steps), rate, free)
        curve[epoch] = energy / (steps * schedule.batch_size)
        tick()
    return curve


def row_count(trajectories: Sequence[Trajectory]) -> int:
    """Return the number of rows of all episodes."""
    return sum(len(t.senses) for t in trajectories)


def passes(trajectories: Sequence[Trajectory], schedule: Schedule) -> int:
    """Return the number of passes over all episodes: ``epochs``, fewer with very many episodes."""
    updates = row_count(trajectories) / schedule.batch_size
    most = UPDATES
    if schedule.free_running_probability > 0 or schedule.noise > 0:
        most = RECALL_UPDATES
    return max(1, min(schedule.epochs, round(most / updates)))
