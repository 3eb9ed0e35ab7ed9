"""Learning from streams of episodes, also to run on alone, so that a skill can be recalled when the senses are gone.

    after a random cue:    r_t ← [x̂_t, â_t, 1]     with a probability that rises as learning goes on

Every synapse changes as in ``learning``; only what the traces take up differs. Where they take up what was read at all
times, a memory learns to predict one step and is lost after a few without senses; where the commanded action is always
given, it need not know what comes next.

Sources: Tang et al. 2023 (NeurIPS) for offline recall; Bengio et al. 2015 (NeurIPS) for learning from own predictions.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from itertools import islice
from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from asm_gym.memory.energy import Array
from asm_gym.memory.inference import Weights, direct, expect, sense
from asm_gym.memory.learning import Learner, Schedule, Trajectory, cosine_decay, largest_rate, passes, shuffled
from asm_gym.memory.traces import advance, at_rest

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


class ScheduledSampling:
    """Streams that a learner follows and runs on from, and where they are.

    Args:
        learner: whose synapses change.
        size: B, streams side by side.

    Attributes:
        traces: (B, I).
        steps: (B, 1) since the episode began; a stream that begins in mid-episode counts from there.
        cue: (B, 1) how many of them must be read.
    """

    def __init__(self, learner: Learner, size: int) -> None:
        self.learner = learner
        sensory = learner.weights.W_F.shape[0]
        self.traces: Array = at_rest(size, sensory + 1)
        self.steps = np.zeros((size, 1), np.intp)
        self.cue = np.full((size, 1), LONGEST_CUE)

    def run(self, moments: Iterable[Moment], rate: float, free: float) -> float:
        """Learns from the moments that come next; the sum of all energies.

        Args:
            free: probability, in each step after a random cue, that a stream runs on alone: the action taken is its
                own, and what the traces take up is what was expected.
        """
        learner, w, total = self.learner, self.learner.weights, 0.0
        for now in moments:
            c = np.where(now.begins, np.float32(0), self.traces)
            self.steps = np.where(now.begins, 0, self.steps) + 1
            self.cue = np.where(now.begins, learner.rng.integers(1, LONGEST_CUE, self.cue.shape), self.cue)
            alone = (self.steps > self.cue) & (learner.rng.random(self.cue.shape) < free)
            taken = now.commands
            if alone.any():
                S = now.senses.shape[1]
                action = (direct(c, now.commands, w.W_D) + sense(expect(c, w.W_C), w.W_F))[:, S:]
                taken = np.hstack([np.where(alone, action, now.commands[:, :-1]), now.commands[:, -1:]])
            step = learner.step(c, now.commands, now.senses, rate, taken)
            senses = np.where(alone, step.expected[:, : now.senses.shape[1]], now.senses)
            self.traces = advance(c, np.hstack([senses, taken]), w.gains)
            total += step.energy
        return total


class Streams(Protocol):
    """Streams of episodes that something learns from."""

    def run(self, moments: Iterable[Moment], rate: float, free: float) -> float:
        """Learns from the moments that come next, as ``ScheduledSampling`` does; the sum of all energies."""


def learn(
    weights: Weights,
    trajectories: Sequence[Trajectory],
    schedule: Schedule,
    rng: np.random.Generator,
    tick: Callable[[], None],
) -> NDArray[np.float64]:
    """Learns in place; the mean energy of each epoch. Calls ``tick`` after each, of which many data need fewer."""
    streams = ScheduledSampling(Learner(weights, schedule, rng), schedule.batch_size)
    return practise(streams, weights.W_C.shape[0], trajectories, schedule, rng, tick)


def practise(
    streams: Streams,
    hidden: int,
    trajectories: Sequence[Trajectory],
    schedule: Schedule,
    rng: np.random.Generator,
    tick: Callable[[], None],
) -> NDArray[np.float64]:
    """Passes over the episodes, at a rate that decays and more and more alone; the mean energy of each.

    Args:
        hidden: H, of what learns.
        tick: called after each.
    """
    epochs, widest = passes(trajectories, schedule), largest_rate(hidden, schedule)
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
