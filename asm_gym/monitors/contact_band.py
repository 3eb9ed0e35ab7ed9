"""The spinal reflex: what the arm should feel in the coming control step, sent down for every physics substep.

    x̂_i ± w_i,   x̂ = M [c, a, 1]        external torques and forces at the wrist, from the memory's traces and the
                                        command, before anything of the step is sensed
    w_i = 5 σ_i + q_i Q^(1/κ_i) exp(min(max(S_i [c, a, 1], l_i), h_i))

M and S are ridge regressions: of the middle of what substeps felt, and of the logarithm of how far the farthest within
a fifth of a second lay from x̂, in episodes that M has not seen; l and h are how far S went there. A grasp is expected,
and so inside, where the same force in free motion is not. σ is the sensor's noise, q and κ say how far each number goes
at its worst (``detection.tails``). Q is conformal: a fresh nominal episode leaves the band, in any number of any
substep, with a probability of at most the rate.

The first rows of an episode are not judged: the memory knows nothing yet to expect from.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from asm_gym.checkpoint import read_checkpoint, write_checkpoint
from asm_gym.detection.conformal import Promise, conformal_episodes, conformal_threshold
from asm_gym.detection.tails import worst_case
from asm_gym.files import written_whole
from asm_gym.memory.network import Network
from asm_gym.memory.state import MemoryState
from asm_gym.memory.traces import advance
from asm_gym.monitors.neural_asm import NeuralASM
from asm_gym.scaling import FARTHEST
from asm_gym.spec import StreamSpec

KIND = "spinal_band"
UNJUDGED = 2
"""Control steps at the beginning of an episode for which there is no band."""

PENALTY = 0.1
"""Of the regressions, in units of the variance of a standardised input."""

EXTREME = 0.005
"""Share of steps beyond l, and beyond h."""

AROUND_S = 0.2
"""What may be felt so long before or after is expected at a time too: a hand seldom meets things to the step [s]."""

ONE = np.ones(1)

NOISY = 5.0
"""Standard deviations of a sensor's own noise for which a band has room: what substeps felt may be known without it."""

FAINTEST = 1e-2
"""Smallest deviation [N m], [N] where its logarithm is taken."""

FELT = "external_torque", "wrist_force"
"""Ends of the names of the channels that a band is for."""


class FeltEpisode(NamedTuple):
    """A nominal episode, as the stream tells it and as the arm felt it."""

    stream: NDArray[np.floating[Any]]  # (T, D)
    felt: NDArray[np.floating[Any]]  # (T, K, N) in each substep of each control step, see ``RobosuiteEnv.felt``


class Band(NamedTuple):
    """What is expected in each substep of a control step [N m], [N]."""

    low: NDArray[np.float64]  # (N,)
    high: NDArray[np.float64]  # (N,)

    def times(self, felt: NDArray[np.floating[Any]]) -> NDArray[np.float64]:
        """(N,) how many half-widths from the middle the farthest of ``felt`` (K, N) is; above 1 is outside."""
        middle, half = (self.high + self.low) / 2, (self.high - self.low) / 2
        farthest = np.max(np.abs(felt - middle), axis=0) / half
        return np.where(np.isfinite(farthest), farthest, np.inf)


class SentDown(NamedTuple):
    """What is needed of a calibrated band once a control step, laid out to be read once."""

    learned: dict[str, NDArray[np.float64]]  # what it was made of
    scale: float  # Q
    both: NDArray[np.float64]  # (2 N, I) M, then S
    least: NDArray[np.float64]  # (N,) l
    most: NDArray[np.float64]  # (N,) h
    wide: NDArray[np.float64]  # (N,) q Q^(1/κ)
    noise: NDArray[np.float64]  # (N,) 5 σ

    def at(self, x: NDArray[np.floating[Any]]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """x̂ and w (N,) [N m], [N], from [c, a, 1] (I,)."""
        found, N = self.both @ x, len(self.wide)
        levels = np.minimum(np.maximum(found[N:], self.least), self.most)
        return found[:N], self.wide * np.exp(levels) + self.noise


class ContactBand:
    """A band on external torques and forces at the wrist, from a memory.

    Args:
        memory: fitted, whose rows come once a control step.

    Raises:
        ValueError: the memory expects no external torque or no force at the wrist, its rows come faster than that a
            change is taken from one to the next, or it was saved before there were traces.
    """

    def __init__(self, memory: NeuralASM) -> None:
        spec, model = memory.spec, memory.model
        if type(memory.network_) is not Network:
            raise ValueError("a band needs a fitted memory that was not saved by an older asm-gym: fit it anew")
        if model.lag != 1:
            raise ValueError(
                f"a band is sent down once a control step, and this memory has {1 / spec.dt:g} rows a second"
            )
        found = tuple(c.name for c in spec.channels if c.name.endswith(FELT))
        if not all(any(name.endswith(end) for name in found) for end in FELT):
            raise ValueError(
                f"a band needs a memory that expects {' and '.join(FELT)}, and this one knows "
                f"{', '.join(c.name for c in spec.channels)}"
            )
        self.memory, self.spec, self.names = memory, spec, found
        columns = np.concatenate([np.arange(spec.size)[spec.slices[name]] for name in found])
        self.columns = columns
        """(N,) where they stand in the stream."""
        self.labels = tuple(spec.labels[c] for c in columns)
        """Of the N numbers."""
        self.units = tuple(c.unit for c in spec.channels for _ in range(c.size) if c.name in found)
        self._noise = NOISY * spec.noise[columns]
        self._of_motor = model.senses_.mean[spec.motor], model.senses_.spread[spec.motor]
        self.learned_: dict[str, NDArray[np.float64]] = {}
        self.scale_: float | None = None
        """Q; None before ``calibrate``."""
        self.maxima_: NDArray[np.float64] | None = None
        self._sent: SentDown | None = None

    def fit(self, episodes: Sequence[FeltEpisode]) -> Self:
        """Learns what is usually felt, and how far off that is, from nominal episodes.

        Raises:
            ValueError: fewer than four episodes, or one that is too short or laid out otherwise.
        """
        if len(episodes) < 4:
            raise ValueError(f"a band is fitted on four nominal episodes at least, got {len(episodes)}")
        read = [self._read(n, e) for n, e in enumerate(episodes)]
        middle = _ridge(read[::2], [(felt.max(axis=1) + felt.min(axis=1)) / 2 for _, felt in read[::2]])
        off = [_deviation(x @ middle.T, felt) for x, felt in read[1::2]]
        around = round(AROUND_S / self.spec.dt)
        spread = _ridge(read[1::2], [np.log(np.maximum(_largest_around(d, around), FAINTEST)) for d in off])
        levels = [x @ spread.T for x, _ in read[1::2]]
        span = np.quantile(np.concatenate(levels), (EXTREME, 1.0 - EXTREME), axis=0).T  # (N, 2)
        maxima = [(d / np.exp(np.clip(v, *span.T))).max(axis=0) for d, v in zip(off, levels, strict=True)]
        ceiling, tail = worst_case(np.array(maxima))
        self.learned_ = {"middle": middle, "spread": spread, "span": span, "ceiling": ceiling, "tail": tail}
        self.scale_ = self.maxima_ = None
        return self

    def calibrate(self, episodes: Sequence[FeltEpisode], false_alarm_rate: float = 0.01) -> Self:
        """Sets Q by nominal episodes that ``fit`` has not seen; P(the band is left in an episode) <= the rate.

        Raises:
            ValueError: too few episodes for this rate, or bad ones.
            RuntimeError: it is not fitted.
        """
        if not self.learned_:
            raise RuntimeError("this band has learned nothing yet: call fit(episodes) first")
        conformal_episodes(false_alarm_rate)
        maxima = []
        for n, episode in enumerate(episodes):
            x, felt = self._read(n, episode)
            middle, half = self._at(x, 1.0)
            beyond = np.maximum(_deviation(middle, felt) - self._noise, 0.0) / (half - self._noise)
            maxima.append(float(np.max(beyond ** self.learned_["tail"])))
        self.scale_, self.maxima_ = conformal_threshold(np.array(maxima), false_alarm_rate), np.array(maxima)
        return self

    @property
    def promise(self) -> Promise:
        """Which share of nominal episodes stays within. Raises RuntimeError before ``calibrate``."""
        scale = self._calibrated()
        assert self.maxima_ is not None
        return Promise.of(self.maxima_, scale)

    def expect(self, state: MemoryState, action: NDArray[np.floating[Any]]) -> Band | None:
        """The band of the coming control step; None where nothing can be expected yet.

        Args:
            state: of the memory's model, of one stream, after the last row.
            action: (A,) that is about to be commanded, as the stream will say it.

        Raises:
            RuntimeError: it is not calibrated.
        """
        scale = self._calibrated()
        if state.steps[0] < UNJUDGED:
            return None
        mean, spread = self._of_motor
        command = np.minimum(np.maximum((np.asarray(action, np.float64) - mean) / spread, -FARTHEST), FARTHEST)
        middle, half = self._sent_down(scale).at(np.concatenate([state.traces[0], command, ONE]))
        return Band(middle - half, middle + half)

    def felt_in(self, row: NDArray[np.floating[Any]]) -> NDArray[np.float64]:
        """(1, N) what a row (D,) tells of what was felt in its step: the means."""
        return np.asarray(row, np.float64)[None, self.columns]

    def save(self, path: str | Path) -> None:
        """Writes it to a file; the memory is not in it. Raises RuntimeError before ``calibrate``."""
        scale = self._calibrated()
        assert self.maxima_ is not None
        arrays = {**self.learned_, "maxima": self.maxima_}
        header = {"spec": self.spec.to_json(), "scale": scale, "labels": list(self.labels)}
        write_checkpoint(path, KIND, header, arrays)

    @classmethod
    def load(cls, path: str | Path, memory: NeuralASM) -> Self:
        """Reads what ``save`` wrote, for the memory that it was made with.

        Raises:
            FileNotFoundError: there is no such file.
            ValueError: it is damaged, or of another stream.
        """
        saved, band = read_checkpoint(path, KIND), cls(memory)
        try:
            spec, scale = StreamSpec.from_json(saved.header["spec"]), float(saved.header["scale"])
        except (KeyError, TypeError) as error:
            raise ValueError(f"{path} is damaged: {error}") from error
        memory.spec.require(spec, "the band")
        N, inputs = len(band.labels), memory.model.network.at_rest(1).shape[1] + len(memory.spec.motor) + 1
        shapes = {**dict.fromkeys(("middle", "spread"), (N, inputs)), "span": (N, 2), "ceiling": (N,), "tail": (N,)}
        band.learned_ = {name: saved.array(name, *shape) for name, shape in shapes.items()}
        band.scale_, band.maxima_ = scale, saved.array("maxima", len(saved.arrays.get("maxima", ())))
        return band

    def export(self, path: str | Path) -> dict[str, Any]:
        """Writes JSON with collision thresholds for a real controller: half-widths at their least and most.

        They are distances from what the memory expects. A controller that takes one number a joint, from 0, should be
        given the most, and add what is expected of the task.

        Raises:
            RuntimeError: it is not calibrated.
        """
        scaled = self.learned_["ceiling"] * self._calibrated() ** (1 / self.learned_["tail"])
        least, most = (scaled * np.exp(end) + self._noise for end in self.learned_["span"].T)
        said = {
            "unit": list(self.units),
            "number": list(self.labels),
            "least": least.tolist(),
            "most": most.tolist(),
            "promise": self.promise._asdict(),
            "control_hz": 1 / self.spec.dt,
            "source": self.spec.source,
        }
        with written_whole(Path(path)) as file:
            file.write(json.dumps(said, indent=1).encode())
        return said

    def _calibrated(self) -> float:
        if self.scale_ is None:
            raise RuntimeError("this band was never calibrated: call fit(episodes) and calibrate(others) first")
        return self.scale_

    def _sent_down(self, scale: float) -> SentDown:
        of, sent = self.learned_, self._sent
        if sent is None or sent.learned is not of or sent.scale != scale:
            wide = of["ceiling"] * scale ** (1.0 / of["tail"])
            both = np.concatenate([of["middle"], of["spread"]])
            least, most = of["span"].T.copy()
            sent = self._sent = SentDown(of, scale, both, least, most, wide, self._noise)
        return sent

    def _at(self, x: NDArray[np.floating[Any]], scale: float) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """x̂ and w (…, N) [N m], [N], from [c, a, 1] (…, I)."""
        of = self.learned_
        levels = np.clip(x @ of["spread"].T, *of["span"].T)
        return x @ of["middle"].T, of["ceiling"] * scale ** (1.0 / of["tail"]) * np.exp(levels) + self._noise

    def _read(self, n: int, episode: FeltEpisode) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """[c, a, 1] (T', I) before each step of an episode, and what was felt in it (T', K, N)."""
        stream, felt = episode
        shape = len(stream), felt.shape[1] if felt.ndim == 3 else 0, len(self.labels)
        if stream.ndim != 2 or stream.shape[1] != self.spec.size or felt.shape != shape or len(stream) <= UNJUDGED:
            raise ValueError(
                f"episode {n} should have a stream (T, {self.spec.size}) of more than {UNJUDGED} rows, and what was "
                f"felt (T, substeps, {len(self.labels)}), got {stream.shape} and {felt.shape}"
            )
        if not (np.isfinite(stream).all() and np.isfinite(felt).all()):
            raise ValueError(f"episode {n} has numbers that are not finite")
        reading, network = self.memory.senses_.read_episode(stream), self.memory.model.network
        c, rows = network.at_rest(1), []
        for x, u in zip(reading.senses, reading.commands, strict=True):
            rows.append(np.concatenate([c[0], u]))
            c = advance(c, np.concatenate([x, u])[None], network.weights.gains)
        return np.array(rows[UNJUDGED:], np.float64), np.asarray(felt[UNJUDGED:], np.float64)


def _deviation(middle: NDArray[np.float64], felt: NDArray[np.float64]) -> NDArray[np.float64]:
    """(T, N) how far the farthest substep of ``felt`` (T, K, N) lies from the middle (T, N)."""
    farthest: NDArray[np.float64] = np.abs(felt - middle[:, None]).max(axis=1)
    return farthest


def _largest_around(deviation: NDArray[np.float64], steps: int) -> NDArray[np.float64]:
    """(T, N) the largest of so many steps before and after each."""
    largest = deviation.copy()
    for k in range(1, min(steps, len(deviation) - 1) + 1):
        np.maximum(largest[k:], deviation[:-k], out=largest[k:])
        np.maximum(largest[:-k], deviation[k:], out=largest[:-k])
    return largest


def _ridge(
    read: Sequence[tuple[NDArray[np.float64], Any]], wanted: Sequence[NDArray[np.float64]]
) -> NDArray[np.float64]:
    """(N, I) what makes the most of inputs (T, I) of each episode, whose last is a constant 1, for what is wanted."""
    x, y = np.concatenate([x for x, _ in read]), np.concatenate(wanted)
    penalty = np.full(x.shape[1], PENALTY)
    penalty[-1] = 0.0
    found: NDArray[np.float64] = np.linalg.solve(x.T @ x / len(x) + np.diag(penalty), x.T @ y / len(x)).T
    return found
