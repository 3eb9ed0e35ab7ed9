"""The Neural Associative Skill Memory as a monitor: it learns what skills feel like, and says when one feels wrong.

row → standardise → memory: predict, compare, infer → ε_t/σ_t → whiten → accumulate → value, attribution
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple, Self

import numpy as np
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

from asm_gym.detection import (
    Evidence,
    accumulate,
    bounded,
    conformal_episodes,
    conformal_threshold,
    no_evidence,
    shares,
    whitening,
)
from asm_gym.episodes import Episode
from asm_gym.memory.checkpoint import read_checkpoint, write_checkpoint
from asm_gym.memory.inference import Weights, weight_shapes
from asm_gym.memory.learning import Schedule, Trajectory
from asm_gym.memory.network import Network, train
from asm_gym.memory.senses import Senses
from asm_gym.monitors.base import Surprise
from asm_gym.stream import StreamSpec

KIND = "neural_asm"

HYPERPARAMETERS = (*Schedule._fields, "hidden_size", "gain", "bound", "shrinkage", "seed")

SCORED_AT_ONCE = 64
"""Episodes scored side by side; with more the arrays no longer fit the cache."""


class NeuralASMState(NamedTuple):
    """What is carried from step to step, one row a stream; a value, never changed in place."""

    hidden: NDArray[np.float32]  # (B, H) the inferred state z
    evidence: Evidence
    before: NDArray[np.float64]  # (B, D) the row seen last


class NeuralASM:
    """A temporal predictive coding network over the stream, learned by local rules, with a calibrated threshold.

    Args:
        spec: the stream it watches.
        hidden_size: H, hidden units.
        iterations: inference steps per control step.
        learning_rate: largest change of a synapse in one step, decaying to 0 along a cosine; scaled by 256 / H where H
            is larger, so that a unit's input does not change more for having more synapses.
        epochs: passes over the training episodes.
        batch_size: episodes learned from side by side.
        prior_precision: Π_z, trust in what was expected.
        sensory_precision: Π_x, trust in what is sensed.
        carry_prior: probability, reached linearly by the end of training, that the state carried on while learning is
            the expected one rather than the inferred one. Above 0 the memory learns to run on without senses (recall).
        gain: a in (0, 1], weight of the newest step in the accumulated evidence.
        bound: ν > 0, how many times the nominal surprise one step can add at most, so that a knock that is soon over
            counts less than what stays.
        shrinkage: λ in [0, 1] of the whitening, towards no correlation between channels.
        seed: of the initial weights and of the order of the episodes.

    Attributes:
            network_: the memory with its weights.
        energy_: (epochs,) mean energy of a step.
        whitening_: (X, X).
        threshold_: what surprise must exceed for an alarm; None before ``calibrate``.
    """

    def __init__(
        self,
        spec: StreamSpec,
        hidden_size: int = 256,
        iterations: int = 20,
        learning_rate: float = 3e-3,
        epochs: int = 40,
        batch_size: int = 32,
        prior_precision: float = 1.0,
        sensory_precision: float = 1.0,
        carry_prior: float = 0.0,
        gain: float = 0.2,
        bound: float = 50.0,
        shrinkage: float = 1e-3,
        seed: int = 0,
    ) -> None:
        counts = {"hidden_size": hidden_size, "iterations": iterations, "epochs": epochs, "batch_size": batch_size}
        for name, count in counts.items():
            _require(name, count, isinstance(count, (int, np.integer)) and count >= 1, "a whole number of at least 1")
        _require("seed", seed, isinstance(seed, (int, np.integer)) and seed >= 0, "a whole number of at least 0")
        precisions = {"prior_precision": prior_precision, "sensory_precision": sensory_precision}
        for name, number in {"learning_rate": learning_rate, "bound": bound, **precisions}.items():
            _require(name, number, 0.0 < number < math.inf, "positive and finite")
        for name, share in {"carry_prior": carry_prior, "shrinkage": shrinkage}.items():
            _require(name, share, 0.0 <= share <= 1.0, "in [0, 1]")
        _require("gain", gain, 0.0 < gain <= 1.0, "in (0, 1]")
        self.spec = spec
        # Plain Python numbers, for a checkpoint holds them as JSON.
        self.hidden_size, self.iterations, self.seed = int(hidden_size), int(iterations), int(seed)
        self.epochs, self.batch_size, self.learning_rate = int(epochs), int(batch_size), float(learning_rate)
        self.prior_precision, self.sensory_precision = float(prior_precision), float(sensory_precision)
        self.carry_prior, self.gain = float(carry_prior), float(gain)
        self.bound, self.shrinkage = float(bound), float(shrinkage)
        self.network_: Network | None = None
        self.threshold_: float | None = None

    def get_params(self) -> dict[str, int | float]:
        """The hyperparameters by name."""
        return {name: getattr(self, name) for name in HYPERPARAMETERS}

    @property
    def threshold(self) -> float:
        if self.threshold_ is None:
            raise RuntimeError("this NeuralASM has no threshold yet: call calibrate(nominal_episodes) first")
        return self.threshold_

    def fit(self, episodes: Sequence[Episode], progress: Callable[[int, int], object] | None = None) -> Self:
        """Learns from whole nominal episodes of any number of skills; no labels.

        Args:
            episodes: of this spec, each at least 2 steps long.
            progress: called as ``progress(done, total)`` after each pass over the data.
        """
        self._check(episodes)
        self.senses_ = Senses.fit(self.spec, [e.stream for e in episodes])
        # Before the first row nothing has moved.
        readings = [self.senses_.read(e.stream, np.vstack([e.stream[:1], e.stream[:-1]])) for e in episodes]
        trajectories = [Trajectory(r.senses, r.commands) for r in readings]
        schedule = Schedule(*(getattr(self, name) for name in Schedule._fields))
        rng = np.random.default_rng(self.seed)
        # One thread: products this small are slowed down by several, and ruined by several that share a core.
        with threadpool_limits(1):
            trained = train(trajectories, self.hidden_size, schedule, rng, progress)
        self.network_, self.energy_ = trained.network, trained.energy
        self.whitening_ = whitening(trained.normalised_errors[:, self.senses_.judged], self.shrinkage)
        self.threshold_ = None
        return self

    def calibrate(self, episodes: Sequence[Episode], false_alarm_rate: float = 0.01) -> Self:
        """Sets the threshold from nominal episodes that ``fit`` has not seen.

        Args:
            episodes: at least ``conformal_episodes(false_alarm_rate)`` of them.
            false_alarm_rate: P(any alarm in a nominal episode), at most.
        """
        self._fitted()
        conformal_episodes(false_alarm_rate)  # refuses a bad rate before the work begins
        self._check(episodes)
        maxima = np.array([surprise.value.max() for surprise in self.score_episodes(episodes)])
        self.threshold_ = conformal_threshold(maxima, false_alarm_rate)
        return self

    def initial_state(self, batch: int = 1) -> NeuralASMState:
        """The state before the first row of ``batch`` streams."""
        if batch < 1:
            raise ValueError(f"batch must be at least 1, got {batch}")
        hidden = np.zeros((batch, self._fitted().hidden_size), np.float32)
        unknown = np.zeros((batch, self.spec.size))
        return NeuralASMState(hidden, no_evidence(batch, len(self.spec.sensory)), unknown)

    def observe(self, state: NeuralASMState, stream: NDArray[np.floating[Any]]) -> tuple[NeuralASMState, Surprise]:
        """The next row of each stream: the new state, and how surprising the row was.

        A number that is not finite makes the value and its own attribution infinite. The memory takes it for unseen,
        so that later rows can be judged again.

        Args:
            state: as handed back last; it is not changed.
            stream: (B, D) one row a stream.
        """
        network = self._fitted()
        stream = np.asarray(stream, np.float64)
        self.spec.check_row(stream)
        if stream.shape != (len(state.hidden), self.spec.size):
            raise ValueError(f"stream must have the shape {(len(state.hidden), self.spec.size)}, got {stream.shape}")
        before = np.where(state.evidence.steps[:, None] == 0, stream, state.before)
        reading = self.senses_.read(stream, before)
        step = network.step(state.hidden, reading.commands, reading.senses, reading.seen)
        normalised = (step.error * np.exp(-0.5 * step.log_variance)).astype(np.float64)[
            :, self.senses_.judged
        ]  # (B, X)
        evidence = accumulate(state.evidence, bounded(normalised @ self.whitening_, self.bound), self.gain)
        attribution = np.zeros(stream.shape)  # (B, D), 0 for the commanded action
        attribution[:, self.spec.sensory] = shares(evidence, self.gain)
        broken = ~reading.finite.all(axis=1)
        if broken.any():
            attribution[broken] = np.where(reading.finite[broken], 0.0, np.inf)
        return NeuralASMState(step.hidden, evidence, stream), Surprise(attribution.sum(axis=1), attribution)

    def score(self, episode: Episode) -> Surprise:
        """The surprise of each step of an episode: value (T,), attribution (T, D)."""
        return self.score_episodes([episode])[0]

    def score_episodes(self, episodes: Sequence[Episode]) -> list[Surprise]:
        """``score`` for many episodes, which are run side by side."""
        for episode in episodes:
            self.spec.require(episode.spec, "the episode")
        with threadpool_limits(1):
            return self._score(episodes)

    def _score(self, episodes: Sequence[Episode]) -> list[Surprise]:
        scores: list[Surprise | None] = [None] * len(episodes)
        order = sorted(range(len(episodes)), key=lambda i: -len(episodes[i]))
        for start in range(0, len(order), SCORED_AT_ONCE):
            group = order[start : start + SCORED_AT_ONCE]
            steps = list(self._run([episodes[i].stream for i in group]))
            for n, i in enumerate(group):
                mine = steps[: len(episodes[i])]
                value, attribution = (np.array([s[k][n] for s in mine]) for k in range(2))
                scores[i] = Surprise(value, attribution.reshape(-1, self.spec.size))
        return [s for s in scores if s is not None]

    def _run(self, streams: Sequence[NDArray[np.float32]]) -> Iterator[Surprise]:
        """Observes streams side by side, the longest first; those that have ended are left out."""
        state = self.initial_state(len(streams))
        for t in range(len(streams[0])):
            rows = np.stack([s[t] for s in streams if t < len(s)])  # (n, D)
            n = len(rows)
            running = Evidence(state.evidence.vector[:n], state.evidence.steps[:n])
            state, surprise = self.observe(NeuralASMState(state.hidden[:n], running, state.before[:n]), rows)
            yield surprise

    def save(self, path: str | Path) -> None:
        """Writes everything learned to one file: arrays and JSON."""
        weights = self._fitted().weights._asdict()
        header = {"spec": self.spec.to_json(), "hyperparameters": self.get_params(), "threshold": self.threshold_}
        learned = {
            "mean": self.senses_.mean,
            "spread": self.senses_.spread,
            "change": self.senses_.change,
            "energy": self.energy_,
            "whitening": self.whitening_,
        }
        write_checkpoint(path, KIND, header, {**learned, **weights})

    @classmethod
    def load(cls, path: str | Path) -> Self:
        """Reads what ``save`` wrote.

        Raises:
            FileNotFoundError: there is no such file.
            ValueError: the file is damaged, from a newer version, or something else.
        """
        saved = read_checkpoint(path, KIND)
        try:
            spec = StreamSpec.from_json(saved.header["spec"])
            asm = cls(spec, **saved.header["hyperparameters"])
            asm.threshold_ = saved.header["threshold"]
        except (KeyError, TypeError) as error:
            raise ValueError(f"{path} is damaged: {error}") from error
        D, X = spec.size, len(spec.sensory)
        asm.senses_ = Senses(spec, saved.array("mean", D), saved.array("spread", D), saved.array("change", D))
        asm.energy_, asm.whitening_ = saved.array("energy", asm.epochs), saved.array("whitening", X, X)
        shapes = weight_shapes(asm.hidden_size, asm.senses_.size, len(spec.motor))
        weights = Weights(**{n: np.ascontiguousarray(saved.array(n, *s), np.float32) for n, s in shapes.items()})
        asm.network_ = Network(weights, asm.iterations, asm.prior_precision, asm.sensory_precision)
        return asm

    def _fitted(self) -> Network:
        if self.network_ is None:
            raise RuntimeError("this NeuralASM has learned nothing yet: call fit(episodes) first")
        return self.network_

    def _check(self, episodes: Sequence[Episode]) -> None:
        """Refuses episodes that cannot be learned from."""
        if len(episodes) == 0:
            raise ValueError("at least one episode is needed, got none")
        for n, episode in enumerate(episodes):
            self.spec.require(episode.spec, f"episode {n}")
            if len(episode) < 2:
                raise ValueError(f"episode {n} must be at least 2 steps long, got {len(episode)}")
            bad = np.argwhere(~np.isfinite(episode.stream))
            if len(bad):
                step, column = bad[0]
                label, value = self.spec.labels[column], episode.stream[step, column]
                raise ValueError(f"episode {n}, step {step}, {label} must be finite, got {value}")


def _require(name: str, value: float, fulfilled: bool, what: str) -> None:
    if not fulfilled:
        raise ValueError(f"{name} must be {what}, got {value}")
