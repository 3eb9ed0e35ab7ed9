"""Practice: pass over episodes in many parallel streams, and run on without the senses for part of them.

After a random cue, and with a probability that rises during learning, a stream runs on alone for a row: the action is
the memory's own and its state follows from its own prediction. Without this a memory learns to predict one row, and is
lost a few rows after the senses are gone.

Sources: Tang et al. 2023 (NeurIPS) for offline recall; Bengio et al. 2015 (NeurIPS) for learning from own predictions.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from itertools import islice
from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from asm_gym.memory.energy import Array
from asm_gym.memory.learning import Schedule, Tick, Trajectory, cosine_decay, shuffled

LONGEST_CUE = 30
"""A stream reads fewer rows than this before it may run on alone."""

UPDATES, RECALL_UPDATES = 10_000, 50_000
"""Largest number of batches without and with running on alone."""

REFERENCE_WIDTH = 256
"""Hidden units up to which ``learning_rate`` is used as it is; it is scaled down beyond."""


class Moment(NamedTuple):
    """One row of B streams."""

    senses: Array  # (B, S)
    commands: Array  # (B, A + 1)
    begins: NDArray[np.bool_]  # (B, 1) whether an episode begins


def one_after_another(trajectories: Sequence[Trajectory], size: int, rng: np.random.Generator) -> Iterator[Moment]:
    """Yield rows of ``size`` endless streams of episodes, each begun at a random row.

    Streams at different phases keep one phase of all skills from displacing what was learned of the others.
    """
    senses, commands = (np.concatenate([t[k] for t in trajectories]) for k in range(2))
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
            episode[n], step[n] = next(order)[0], 0


class Practises(Protocol):
    """A learner that practises."""

    early: int
    """1 if running alone is drawn for the row to come, 0 if for the row itself."""

    def at_rest(self, size: int) -> Array:
        """Return the state (B, Z) before an episode."""

    def practise(
        self, state: Array, now: Moment, own: NDArray[np.bool_], alone: NDArray[np.bool_], rate: float
    ) -> tuple[Array, float]:
        """Learn from one row; return the next state (B, Z) and the energy summed over the batch.

        Args:
            state: (B, Z).
            now: the row.
            own: (B, 1) streams that take their own action.
            alone: (B, 1) streams whose next state follows from what was predicted.
            rate: of the synapses.
        """


class Practice:
    """Streams that a learner follows.

    Args:
        learner: changes its synapses.
        size: B.
        rng: draws cues and which streams run on alone.

    Attributes:
        state: (B, Z) what is carried from row to row.
        steps: (B, 1) rows since the episode began, or since the stream began.
        cue: (B, 1) rows that must be read first.
    """

    def __init__(self, learner: Practises, size: int, rng: np.random.Generator) -> None:
        self.learner, self.rng = learner, rng
        self.state = learner.at_rest(size)
        self.steps = np.zeros((size, 1), np.intp)
        self.cue = np.full((size, 1), LONGEST_CUE)
        self._alone = np.zeros((size, 1), np.bool_)

    def run(self, moments: Iterable[Moment], rate: float, free: float) -> float:
        """Learn from the moments; return the sum of all energies.

        Args:
            free: probability of running on alone in a row after the cue.
        """
        total, early = 0.0, self.learner.early
        for now in moments:
            state = np.where(now.begins, np.float32(0), self.state)
            self.steps = np.where(now.begins, 0, self.steps) + 1
            self.cue = np.where(now.begins, self.rng.integers(1, LONGEST_CUE, self.cue.shape), self.cue)
            before = self._alone & ~now.begins
            self._alone = (self.steps + early > self.cue) & (self.rng.random(self.cue.shape) < free)
            own = before if early else self._alone
            self.state, energy = self.learner.practise(state, now, own, self._alone, rate)
            total += energy
        return total


def practise(
    learner: Practises,
    hidden: int,
    trajectories: Sequence[Trajectory],
    schedule: Schedule,
    rng: np.random.Generator,
    tick: Tick,
) -> NDArray[np.float64]:
    """Pass over the episodes with a decaying rate, more and more alone; return the mean energy of each pass.

    Args:
        learner: changes its synapses.
        hidden: H, its hidden units.
        tick: called after each pass.
    """
    streams = Practice(learner, schedule.batch_size, rng)
    epochs, widest = passes(trajectories, schedule), schedule.learning_rate * min(1.0, REFERENCE_WIDTH / hidden)
    moments = one_after_another(trajectories, schedule.batch_size, rng)
    steps = -(-sum(len(t.senses) for t in trajectories) // schedule.batch_size)
    curve = np.zeros(epochs)
    for epoch in range(epochs):
        progress = epoch / epochs
        free = schedule.free_running_probability * min(1.0, 2 * progress)
        energy = streams.run(islice(moments, steps), cosine_decay(widest, progress), free)
        curve[epoch] = energy / (steps * schedule.batch_size)
        tick()
    return curve


def passes(trajectories: Sequence[Trajectory], schedule: Schedule) -> int:
    """Return the number of passes over all episodes: ``epochs``, fewer with very many episodes."""
    updates = sum(len(t.senses) for t in trajectories) / schedule.batch_size
    most = RECALL_UPDATES if schedule.free_running_probability > 0 else UPDATES
    return max(1, min(schedule.epochs, round(most / updates)))
