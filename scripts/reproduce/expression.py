"""Whatever expresses a skill from a cue, behind one call: the memory, and its rivals.

express(streams, cue)      rows of which the first ``cue`` are read, and the rest expected from memory alone
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from asm_gym.episode import Episode
from asm_gym.memory.dynamics import DYNAMICS, TRACES
from asm_gym.memory.learning import Schedule, Trajectory
from asm_gym.memory.network import Network, initial_weights
from asm_gym.memory.recall import Recalled, follow, run_on, to_rows
from asm_gym.memory.scheduled_sampling import learn
from asm_gym.memory.temporal import TemporalNetwork, unassociated
from asm_gym.memory.traces import fit_gains
from asm_gym.scaling import StreamScaler
from asm_gym.scripts.reproduce import recurrent

Rows = NDArray[np.float64]

FREE = 0.6
"""``free_running_probability`` of ``NeuralASM``: how much of what follows a cue is learned from alone."""


class Expresser(Protocol):
    """Knows skills."""

    def express(self, streams: Rows, cue: int) -> Rows:
        """What was expected of each row of B streams (T, B, D), knowing those before it up to the ``cue``-th."""
        ...


def read(reader: StreamScaler, streams: Rows) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """StreamScaler (T, B, S) and commands (T, B, A + 1) of streams (T, B, D)."""
    readings = [reader.read_episode(streams[:, n]) for n in range(streams.shape[1])]
    return np.stack([r.senses for r in readings], axis=1), np.stack([r.commands for r in readings], axis=1)


def trajectories(reader: StreamScaler, episodes: Sequence[Episode]) -> list[Trajectory]:
    """Episodes as a network reads them."""
    readings = [reader.read_episode(e.stream) for e in episodes]
    return [Trajectory(r.senses, r.commands, r.inputs) for r in readings]


@dataclass(frozen=True)
class ExpressionMemory:
    """The temporal predictive coding network alone: nothing is judged here, so there is no association."""

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
        """From whole episodes, no labels.

        Args:
            steps: in which its synapses change, with 64 episodes side by side.
            gain: of traces' synapses onto the state before it learns; large ones make units that tell beginnings apart.
            dynamics: one of ``DYNAMICS``, with its usual inference.
        """
        reader, how, size = StreamScaler.fit(episodes[0].spec, [e.stream for e in episodes]), DYNAMICS[dynamics], 64
        epochs = max(1, round(steps * size / sum(len(e) for e in episodes)))
        schedule = Schedule(epochs, size, rate, how.iterations, how.prior_precision, 1.0, FREE)
        taught = trajectories(reader, episodes)
        if dynamics != TRACES:
            return cls(reader, how.learn(taught, hidden, schedule, rng, lambda: None).network)
        weights = initial_weights(hidden, reader.size, len(reader.spec.motor), rng)
        weights.gains[:] = fit_gains([np.hstack([t.senses, t.commands]) for t in taught])
        weights.W_C[:] *= np.float32(gain)
        learn(weights, taught, schedule, rng, lambda: None)
        return cls(reader, Network(weights, unassociated(), how.iterations, how.prior_precision, 1.0))

    def express(self, streams: Rows, cue: int) -> Rows:
        senses, commands = read(self.reader, streams[:cue])
        cued = follow(self.network, self.network.at_rest(streams.shape[1]), senses, commands)
        rows = to_rows(self.reader, cued)
        if cue == len(streams):
            return rows
        return np.concatenate([rows, to_rows(self.reader, run_on(self.network, cued.traces, len(streams) - cue))])

    def glimpse(self, streams: Rows, seen: NDArray[np.bool_]) -> Rows:
        """What was expected of each row of B streams (T, B, D) of which only those ``seen`` (T,) are sensed."""
        senses, commands = read(self.reader, streams)
        senses[~seen] = np.nan
        return to_rows(self.reader, follow(self.network, self.network.at_rest(streams.shape[1]), senses, commands))


@dataclass(frozen=True)
class Backpropagated:
    """A recurrent network trained by backpropagation through time."""

    reader: StreamScaler
    network: Any

    @classmethod
    def learned(
        cls,
        episodes: Sequence[Episode],
        cell: str,
        hidden: int,
        rng: np.random.Generator,
        updates: int,
        noise: float = 0.3,
        rate: float = 1e-2,
        truncated: bool = False,
    ) -> Backpropagated:
        """From whole episodes; the other arguments are those of ``recurrent.train``."""
        reader = StreamScaler.fit(episodes[0].spec, [e.stream for e in episodes])
        learned = trajectories(reader, episodes)
        return cls(reader, recurrent.train(learned, cell, hidden, updates, rng, noise, rate, truncated=truncated))

    def express(self, streams: Rows, cue: int) -> Rows:
        senses, commands = recurrent.expected(self.network, *read(self.reader, streams), cue)
        return to_rows(self.reader, Recalled(senses, commands, commands, commands[-1]))

    def glimpse(self, streams: Rows, seen: NDArray[np.bool_]) -> Rows:
        """As ``ExpressionMemory.glimpse``."""
        senses, commands = read(self.reader, streams)
        made, told = recurrent.glimpsed(self.network, senses, commands, seen), commands[:, :, :-1]
        return to_rows(self.reader, Recalled(made, told, told, told[-1]))


@dataclass(frozen=True)
class Hopfield:
    """A modern continuous Hopfield network over windows of rows; it keeps every window it has seen.

        ξ = Σ_i softmax_i(-½ β ‖q - k_i‖²) v_i      q the last rows, k_i those of a window, v_i the row that followed

    The distance is the scaled dot product for keys whose lengths differ. Source: Ramsauer et al. 2021 (ICLR).
    """

    reader: StreamScaler
    keys: NDArray[np.float64]  # (N, window · D)
    values: NDArray[np.float64]  # (N, D)
    window: int
    beta: float

    @classmethod
    def learned(cls, episodes: Sequence[Episode], window: int = 5, beta: float = 100.0) -> Hopfield:
        """Every window of ``window`` rows, with what followed it; the first windows reach back before the episode."""
        reader = StreamScaler.fit(episodes[0].spec, [e.stream for e in episodes])
        keys, values = [], []
        for e in episodes:
            rows = (e.stream - reader.mean) / reader.spread
            padded = np.concatenate([np.zeros((window, rows.shape[1])), rows])
            keys += [padded[t : t + window].ravel() for t in range(1, len(rows))]
            values += list(rows[1:])
        return cls(reader, np.array(keys), np.array(values), window, beta)

    @cached_property
    def _lengths(self) -> NDArray[np.float64]:
        """‖k_i‖² (N,)."""
        squared: NDArray[np.float64] = np.einsum("ij,ij->i", self.keys, self.keys)
        return squared

    def retrieve(self, query: NDArray[np.float64]) -> NDArray[np.float64]:
        """What follows windows (B, window · D): (B, D)."""
        size = self.values.shape[1]  # as a mean over channels, β means the same for any stream
        distance = np.sum(query**2, 1)[:, None] + self._lengths - 2 * query @ self.keys.T
        drive = -0.5 * self.beta * distance / size
        share = np.exp(drive - drive.max(axis=1, keepdims=True))
        found: NDArray[np.float64] = share @ self.values / share.sum(axis=1, keepdims=True)
        return found

    def express(self, streams: Rows, cue: int) -> Rows:
        rows = (streams - self.reader.mean) / self.reader.spread  # (T, B, D)
        past = np.zeros((self.window, *rows.shape[1:]))
        made = np.zeros_like(rows)
        for t in range(len(rows)):
            made[t] = self.retrieve(past.transpose(1, 0, 2).reshape(rows.shape[1], -1)) if t else 0.0
            past = np.concatenate([past[1:], rows[t][None] if t < cue else made[t][None]])
        return np.asarray(self.reader.mean + self.reader.spread * made)


def mean_demonstrations(train: Sequence[Episode], dims: int) -> NDArray[np.float64]:
    """(K, T, P) of the skills, in order of name."""
    names = sorted({str(e.info["skill"]) for e in train})
    return np.stack([np.mean([e.stream[:, :dims] for e in train if e.info["skill"] == n], axis=0) for n in names])


def recalled(model: Expresser, tests: Sequence[Episode], means: NDArray[np.float64], cue: int) -> tuple[float, float]:
    """Mean distance [cm] after the cue, and the share of recalls that are nearest to the right skill.

    Args:
        tests: of one length.
        means: (K, T, P) mean demonstration of each skill, in order of name.
        cue: the whole length for online recall.
    """
    streams = np.stack([e.stream for e in tests], axis=1).astype(np.float64)  # (T, B, D)
    dims, names = means.shape[2], sorted({str(e.info["skill"]) for e in tests})
    first = cue if cue < len(streams) else 1
    hand = model.express(streams, cue)[first:, :, :dims]  # (T', B, P)
    error = np.linalg.norm(hand - streams[first:, :, :dims], axis=2).mean()
    apart = np.linalg.norm(hand[:, :, None] - means[:, first:].transpose(1, 0, 2)[:, None], axis=3).mean(axis=0)
    right = [names[k] == e.info["skill"] for k, e in zip(apart.argmin(axis=1), tests, strict=True)]
    return float(error), float(np.mean(right))


GLIMPSED = 10
"""Rows that are sensed before senses come and go."""


def between_glimpses(
    model: ExpressionMemory | Backpropagated, tests: Sequence[Episode], dims: int, every: int
) -> float:
    """Mean distance [cm] of what is expected of rows that are not sensed, where one in ``every`` is.

    Commands are known throughout.
    """
    streams = np.stack([e.stream for e in tests], axis=1).astype(np.float64)  # (T, B, D)
    row = np.arange(len(streams))
    seen = (row < GLIMPSED) | (row % every == 0)
    apart = model.glimpse(streams, seen)[:, :, :dims] - streams[:, :, :dims]
    return float(np.linalg.norm(apart[~seen], axis=2).mean())
