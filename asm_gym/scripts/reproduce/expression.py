"""Expression of a skill from a cue, by the memory and by its rivals, behind one call.

express(streams, cue)      the first ``cue`` rows are read, and the rest is expected from memory alone
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from asm_gym.data.episode import Episode
from asm_gym.memory.dynamics import DYNAMICS, ITERATIONS, PRIOR_PRECISION, RECURRENT
from asm_gym.memory.learning import Schedule, Trajectory
from asm_gym.memory.recall import Recalled, follow, run_on, to_rows
from asm_gym.scaling import StreamScaler
from asm_gym.scripts.reproduce import backpropagation
from asm_gym.scripts.reproduce.backpropagation import Batch, Training, side_by_side

Rows = NDArray[np.floating[Any]]

PEN = slice(0, 2)  # columns of the pen's position
BATCH = 64  # rows of a batch of the memory
FREE = 0.6  # ``free_running_probability`` of ``NeuralASM`` for recall


def fit_reader(episodes: Sequence[Episode]) -> StreamScaler:
    """Return the scaler of these episodes."""
    return StreamScaler.fit(episodes[0].spec, [e.stream for e in episodes])


def trajectories(reader: StreamScaler, episodes: Sequence[Episode]) -> list[Trajectory]:
    """Return the episodes as a network reads them."""
    readings = [reader.read_episode(e.stream) for e in episodes]
    return [Trajectory(r.senses, r.commands, r.inputs) for r in readings]


def read(reader: StreamScaler, streams: Rows) -> Batch:
    """Return the senses and commands, standardised, of streams (T, B, D)."""
    return side_by_side([reader.read_episode(stream) for stream in streams.swapaxes(0, 1)])


@dataclass(frozen=True)
class LocalTraining:
    """Settings of ``ExpressionMemory.learned``."""

    # hidden units
    hidden: int = 64
    # batches of ``BATCH`` rows
    steps: int = 16000
    # learning rate
    rate: float = 3e-3
    # one of ``DYNAMICS``
    dynamics: str = RECURRENT
    # probability that a stream runs on alone in training, at the end
    free_running: float = FREE
    # noise on what recurrent units carry on in training
    noise: float = 0.0


def schedule_of(settings: LocalTraining, rows: int) -> Schedule:
    """Return the schedule of a network that learns from so many rows."""
    return Schedule(
        epochs=max(1, round(settings.steps * BATCH / rows)),
        batch_size=BATCH,
        learning_rate=settings.rate,
        iterations=ITERATIONS,
        prior_precision=PRIOR_PRECISION,
        sensory_precision=1.0,
        free_running_probability=settings.free_running,
        noise=settings.noise,
    )


@dataclass(frozen=True)
class Expresser(ABC):
    """A network that expresses skills, and how it reads rows."""

    reader: StreamScaler
    network: Any

    @abstractmethod
    def expect(self, batch: Batch, cue: int) -> Recalled:
        """Return the prediction of each row, from the rows before it and of these the first ``cue``."""

    def express(self, streams: Rows, cue: int) -> Rows:
        """Return the predictions (T, B, D) of streams (T, B, D), of which the first ``cue`` rows are read."""
        return to_rows(self.reader, self.expect(read(self.reader, streams), cue))


class ExpressionMemory(Expresser):
    """The temporal network without association."""

    @classmethod
    def learned(
        cls, episodes: Sequence[Episode], settings: LocalTraining, rng: np.random.Generator
    ) -> ExpressionMemory:
        """Learn from whole episodes without labels."""
        reader = fit_reader(episodes)
        schedule = schedule_of(settings, sum(map(len, episodes)))
        learn = DYNAMICS[settings.dynamics].learn
        taught = trajectories(reader, episodes)
        trained = learn(taught, settings.hidden, schedule, rng, lambda: None)
        return cls(reader, trained.network)

    def expect(self, batch: Batch, cue: int) -> Recalled:
        senses, commands = batch
        at_rest = self.network.at_rest(senses.shape[1])
        cued = follow(self.network, at_rest, senses[:cue], commands[:cue])
        if cue == len(senses):
            return cued
        alone = run_on(self.network, cued.carried, len(senses) - cue)
        return Recalled(
            senses=np.concatenate([cued.senses, alone.senses]),
            commands=np.concatenate([cued.commands, alone.commands]),
            carried=alone.carried,
        )


class Backpropagated(Expresser):
    """A GRU or an LSTM trained by backpropagation through time."""

    @classmethod
    def learned(
        cls, episodes: Sequence[Episode], settings: Training, rng: np.random.Generator
    ) -> Backpropagated:
        """Learn from whole episodes without labels."""
        reader = fit_reader(episodes)
        return cls(reader, backpropagation.train(trajectories(reader, episodes), settings, rng))

    def expect(self, batch: Batch, cue: int) -> Recalled:
        senses, commands = backpropagation.expected(self.network, batch, cue)
        return Recalled(senses, commands, carried=commands[-1])


def skills_of(episodes: Sequence[Episode]) -> NDArray[np.str_]:
    """Return the name of the skill in each episode (N,)."""
    return np.array([e.info["skill"] for e in episodes])


def mean_demonstrations(train: Sequence[Episode]) -> Rows:
    """Return the mean path (K, T, 2) of the pen in each skill, in order of name."""
    skills = skills_of(train)
    paths = np.stack([e.stream[:, PEN] for e in train])  # (N, T, 2)
    return np.stack([paths[skills == name].mean(axis=0) for name in np.unique(skills)])


def recalled(
    model: Expresser, tests: Sequence[Episode], means: Rows, cue: int
) -> tuple[float, float]:
    """Return how well a model recalls.

    Args:
        model: recalls.
        tests: episodes of one length T.
        means: (K, T, 2) mean paths of the skills, in order of name.
        cue: rows that are read; T for online recall.

    Returns:
        The pen's mean distance [cm] after the cue, and the share of recalls nearest to their skill.
    """
    streams = np.stack([e.stream for e in tests], axis=1)  # (T, B, D)
    first = cue
    if cue == len(streams):
        first = 1
    paths = model.express(streams, cue)[first:, :, PEN]
    error = np.linalg.norm(paths - streams[first:, :, PEN], axis=2).mean()

    to_means = paths[:, :, None] - means[:, first:].transpose(1, 0, 2)[:, None]  # (T, B, K, 2)
    nearest = np.linalg.norm(to_means, axis=3).mean(axis=0).argmin(axis=1)  # (B,)
    skills = skills_of(tests)
    return float(error), float(np.mean(np.unique(skills)[nearest] == skills))
