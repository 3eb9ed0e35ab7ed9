"""Expression of a skill from a cue, by the memory and by its rivals, behind one call.

express(streams, cue)      the first ``cue`` rows are read, and the rest is expected from memory alone
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from asm_gym.data.episode import Episode
from asm_gym.memory.dynamics import DYNAMICS, TRACES
from asm_gym.memory.learning import Schedule, Trajectory
from asm_gym.memory.recall import Recalled, follow, run_on, to_rows
from asm_gym.memory.temporal import TemporalNetwork
from asm_gym.memory.traces import learn_traces
from asm_gym.scaling import StreamScaler
from asm_gym.scripts.reproduce import recurrent
from asm_gym.scripts.reproduce.recurrent import Batch

Rows = NDArray[np.float64]

PEN = slice(0, 2)  # columns of the pen's position
FREE = 0.6  # ``free_running_probability`` of ``NeuralASM`` for recall


def trajectories(reader: StreamScaler, episodes: Sequence[Episode]) -> list[Trajectory]:
    """Return the episodes as a network reads them."""
    readings = [reader.read_episode(e.stream) for e in episodes]
    return [Trajectory(r.senses, r.commands, r.inputs) for r in readings]


def read(reader: StreamScaler, streams: Rows) -> Batch:
    """Return the senses and commands, standardised, of streams (T, B, D)."""
    readings = [reader.read_episode(streams[:, n]) for n in range(streams.shape[1])]
    return Batch(
        *(np.stack([getattr(r, name) for r in readings], axis=1) for name in Batch._fields)
    )


@dataclass(frozen=True)
class ExpressionMemory:
    """The temporal network without association."""

    reader: StreamScaler
    network: TemporalNetwork

    @classmethod
    def learned(
        cls,
        episodes: Sequence[Episode],
        hidden: int,
        rng: np.random.Generator,
        steps: int,
        rate: float = 3e-3,
        gain: float = 1.0,
        dynamics: str = TRACES,
    ) -> ExpressionMemory:
        """Learn from whole episodes without labels, in ``steps`` batches of 64 rows.

        ``gain`` is of the initial synapses from traces to the state, ``dynamics`` one of ``DYNAMICS``.
        """
        reader, how, size = (
            StreamScaler.fit(episodes[0].spec, [e.stream for e in episodes]),
            DYNAMICS[dynamics],
            64,
        )
        epochs = max(1, round(steps * size / sum(len(e) for e in episodes)))
        schedule = Schedule(epochs, size, rate, how.iterations, how.prior_precision, 1.0, FREE)
        asked = trajectories(reader, episodes), hidden, schedule, rng, lambda: None
        trained = learn_traces(*asked, gain) if dynamics == TRACES else how.learn(*asked)
        return cls(reader, trained.network)

    def express(self, streams: Rows, cue: int) -> Rows:
        """Return the prediction (T, B, D) of each row of B streams (T, B, D), from rows before it up to ``cue``."""
        cued = follow(
            self.network, self.network.at_rest(streams.shape[1]), *read(self.reader, streams[:cue])
        )
        rows = to_rows(self.reader, cued)
        if cue == len(streams):
            return rows
        return np.concatenate(
            [rows, to_rows(self.reader, run_on(self.network, cued.traces, len(streams) - cue))]
        )


@dataclass(frozen=True)
class Backpropagated:
    """A GRU trained by backpropagation through time."""

    reader: StreamScaler
    network: recurrent.Recurrent

    @classmethod
    def learned(
        cls,
        episodes: Sequence[Episode],
        hidden: int,
        rng: np.random.Generator,
        updates: int,
        **how: Any,
    ) -> Backpropagated:
        """Learn from whole episodes; the arguments are those of ``recurrent.train``."""
        reader = StreamScaler.fit(episodes[0].spec, [e.stream for e in episodes])
        return cls(
            reader, recurrent.train(trajectories(reader, episodes), hidden, updates, rng, **how)
        )

    def express(self, streams: Rows, cue: int) -> Rows:
        senses, commands = recurrent.expected(self.network, *read(self.reader, streams), cue)
        return to_rows(self.reader, Recalled(senses, commands, commands[-1]))


Expresser = ExpressionMemory | Backpropagated


def mean_demonstrations(train: Sequence[Episode]) -> Rows:
    """Return the mean path (K, T, 2) of the hand in each skill, in order of name."""
    names = sorted({str(e.info["skill"]) for e in train})
    return np.stack(
        [np.mean([e.stream[:, PEN] for e in train if e.info["skill"] == n], axis=0) for n in names]
    )


def recalled(
    model: Expresser, tests: Sequence[Episode], means: Rows, cue: int
) -> tuple[float, float]:
    """Return the pen's mean distance [cm] after the cue, and the share of recalls that are nearest to the right skill.

    ``tests`` are of one length, which as ``cue`` is online recall; ``means`` (K, T, 2) are paths in order of name.
    """
    streams = np.stack([e.stream for e in tests], axis=1).astype(np.float64)  # (T, B, D)
    first = cue if cue < len(streams) else 1
    paths, truth = (rows[first:, :, PEN] for rows in (model.express(streams, cue), streams))
    error = np.linalg.norm(paths - truth, axis=2).mean()
    distance = np.linalg.norm(
        paths[:, :, None] - means[:, first:].transpose(1, 0, 2)[:, None], axis=3
    ).mean(axis=0)
    names = sorted({str(e.info["skill"]) for e in tests})
    right = [
        names[k] == e.info["skill"] for k, e in zip(distance.argmin(axis=1), tests, strict=True)
    ]
    return float(error), float(np.mean(right))
