"""Scheduled sampling: learning to run on alone, so that a skill can be recalled when the senses are gone.

    after a random cue:    z_t ← μ_t, a_t ← â_t     with a probability that rises as learning goes on

Every synapse changes as in ``learning``; only what is handed on from step to step differs. Where the state carried is
always the inferred one, a memory learns to predict one step and is lost after a few without senses; where the commanded
action is always given, it need not know what comes next.

Sources: Tang et al. 2023 (NeurIPS) for offline recall; Bengio et al. 2015 (NeurIPS) for learning from own predictions.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from itertools import islice
from typing import NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from asm_gym.memory.energy import Array
from asm_gym.memory.inference import Weights, motor_prediction
from asm_gym.memory.learning import Learner, Schedule, Trajectory, cosine_decay, largest_rate, passes, shuffled

LONGEST_CUE = 30
"""An episode runs on alone after fewer steps than this."""


class Moment(NamedTuple):
    """One step of B streams of episodes."""

    senses: Array  # (B, S)
    commands: Array  # (B, A + 1)
    begins: NDArray[np.bool_]  # (B, 1) where an episode begins


def one_after_another(trajectories: Sequence[Trajectory], size: int, rng: np.random.Generator) -> Iterator[Moment]:
    """``size`` streams of episodes without end, each begun somewhere in an episode: all phases of all skills at once.

    Side by side from their first step on, episodes of one length would all be at one phase, and what is learned of it
    would push out what was learned of the last.
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


class Carried(NamedTuple):
    """What streams that are learned from carry on from step to step."""

    z: Array  # (B, H)
    alone: NDArray[np.bool_]  # (B, 1) z is the expected state
    steps: NDArray[np.intp]  # (B, 1) since the episode began
    cue: NDArray[np.intp]  # (B, 1) how many of them must be read

    @classmethod
    def at_rest(cls, batch: int, hidden: int) -> Self:
        """Before the first step; a stream that begins in mid-episode counts its steps from there."""
        none = np.zeros((batch, 1), np.intp)
        return cls(np.zeros((batch, hidden), np.float32), none > 0, none, none + LONGEST_CUE)


class ScheduledSampling:
    """Streams that a learner follows and runs on from, and where they are.

    Args:
        learner: whose synapses change.
        size: B, streams side by side.
    """

    def __init__(self, learner: Learner, size: int) -> None:
        self.learner = learner
        self.carried = Carried.at_rest(size, learner.weights.W_H.shape[0])

    def run(self, moments: Iterable[Moment], rate: float, free: float) -> float:
        """Learns from the moments that come next; the sum of all energies.

        Args:
            free: probability, in each step after a random cue, that a stream runs on alone: the state handed on is the
                expected one and not the inferred one, and so is the action that comes with the next.
        """
        learner, total = self.learner, 0.0
        for now in moments:
            last = self.carried
            z = np.where(now.begins, np.float32(0), last.z)
            steps = np.where(now.begins, 0, last.steps) + 1
            cue = np.where(now.begins, learner.rng.integers(1, LONGEST_CUE, steps.shape), last.cue)
            _, action = motor_prediction(z, learner.weights)
            taken = np.where(last.alone & ~now.begins, action, now.commands[:, :-1])
            step = learner.step(z, now.commands, now.senses, rate, np.hstack([taken, now.commands[:, -1:]]))
            total += step.energy
            alone = (steps >= cue) & (learner.rng.random(steps.shape) < free)
            self.carried = Carried(np.where(alone, step.expected, step.inferred), alone, steps, cue)
        return total


def learn_scheduled(
    weights: Weights,
    trajectories: Sequence[Trajectory],
    schedule: Schedule,
    rng: np.random.Generator,
    tick: Callable[[], None],
) -> NDArray[np.float64]:
    """Learns in place, as ``learning.learn`` does, but to run on alone; the mean energy of each epoch."""
    epochs, widest = passes(trajectories, schedule), largest_rate(weights, schedule)
    sampling = ScheduledSampling(Learner(weights, schedule, rng), schedule.batch_size)
    streams = one_after_another(trajectories, schedule.batch_size, rng)
    steps = -(-sum(len(t.senses) for t in trajectories) // schedule.batch_size)
    curve = np.zeros(epochs)
    for epoch in range(epochs):
        progress = epoch / epochs
        rate, free = cosine_decay(widest, progress), schedule.free_running_probability * progress
        curve[epoch] = sampling.run(islice(streams, steps), rate, free) / (steps * schedule.batch_size)
        tick()
    return curve
