"""What rivals share: checks, calibration, scoring of whole episodes, checkpoints."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from pathlib import Path
from typing import Any, ClassVar, Self

import numpy as np
from numpy.typing import NDArray

from asm_gym.detection import conformal_episodes, conformal_threshold
from asm_gym.episodes import Episode
from asm_gym.memory.checkpoint import read_checkpoint, write_checkpoint
from asm_gym.monitors.base import State, Surprise
from asm_gym.stream import StreamSpec

SCORED_AT_ONCE = 64
"""Episodes scored side by side."""


class CalibratedMonitor(ABC):
    """A monitor whose threshold is conformal on the maximum of nominal episodes.

    Args:
        spec: the stream it watches.
        seed: of whatever learning draws.
    """

    kind: ClassVar[str]
    """Its name, in checkpoints and in ``make_monitor``."""

    def __init__(self, spec: StreamSpec, seed: int = 0) -> None:
        self.spec = spec
        self.seed = int(seed)
        self.threshold_: float | None = None
        self.learned_: dict[str, NDArray[np.float64]] = {}
        """What ``fit`` has found, by name."""

    @abstractmethod
    def learn(self, streams: Sequence[NDArray[np.float64]]) -> dict[str, NDArray[np.float64]]:
        """What is to be known of nominal streams, (T, D) each."""

    @abstractmethod
    def initial_state(self, batch: int = 1) -> State:
        """The state before the first row of ``batch`` streams."""

    @abstractmethod
    def shares(self, state: State, rows: NDArray[np.float64]) -> tuple[State, NDArray[np.float64]]:
        """The next rows (B, D), all finite: the new state, and each number's share of the surprise (B, D)."""

    @property
    def threshold(self) -> float:
        if self.threshold_ is None:
            raise RuntimeError(
                f"this {type(self).__name__} has no threshold yet: call calibrate(nominal_episodes) first"
            )
        return self.threshold_

    def fit(self, episodes: Sequence[Episode]) -> Self:
        """Learns from whole nominal episodes of this spec.

        Raises:
            ValueError: none, one of another spec, or one with a number that is not finite.
        """
        self._check(episodes)
        self.learned_ = self.learn([np.asarray(e.stream, np.float64) for e in episodes])
        self.threshold_ = None
        return self

    def calibrate(self, episodes: Sequence[Episode], false_alarm_rate: float = 0.01) -> Self:
        """Sets the threshold from nominal episodes that ``fit`` has not seen; P(any alarm in one) <= the rate."""
        self._fitted()
        conformal_episodes(false_alarm_rate)
        self._check(episodes)
        maxima = np.array([s.value.max() for s in self.score_episodes(episodes)])
        self.threshold_ = conformal_threshold(maxima, false_alarm_rate)
        return self

    def observe(self, state: State, stream: NDArray[np.floating[Any]]) -> tuple[State, Surprise]:
        """The next row (B, D) of each stream; one with a number that is not finite is infinitely surprising there."""
        self._fitted()
        rows = np.asarray(stream, np.float64)
        self.spec.check_row(rows)
        finite = np.isfinite(rows)
        state, attribution = self.shares(state, np.where(finite, rows, 0.0))
        broken = ~finite.all(axis=1)
        attribution[broken] = np.where(finite[broken], 0.0, np.inf)
        return state, Surprise(attribution.sum(axis=1), attribution)

    def score(self, episode: Episode) -> Surprise:
        """The surprise of each step of an episode: value (T,), attribution (T, D)."""
        return self.score_episodes([episode])[0]

    def score_episodes(self, episodes: Sequence[Episode]) -> list[Surprise]:
        """``score`` for many episodes, which are run side by side."""
        for episode in episodes:
            self.spec.require(episode.spec, "the episode")
        scores: list[Surprise] = []
        for start in range(0, len(episodes), SCORED_AT_ONCE):
            group = [e.stream for e in episodes[start : start + SCORED_AT_ONCE]]
            state, steps = self.initial_state(len(group)), []
            for t in range(max(map(len, group))):
                # Those that have ended repeat their last row, and are cut off below.
                state, surprise = self.observe(state, np.stack([s[min(t, len(s) - 1)] for s in group]))
                steps.append(surprise)
            for n, stream in enumerate(group):
                mine = steps[: len(stream)]
                scores.append(
                    Surprise(np.array([s.value[n] for s in mine]), np.array([s.attribution[n] for s in mine]))
                )
        return scores

    def save(self, path: str | Path) -> None:
        """Writes everything learned to one file: arrays and JSON."""
        self._fitted()
        header = {"spec": self.spec.to_json(), "seed": self.seed, "threshold": self.threshold_}
        header["shapes"] = {name: list(array.shape) for name, array in self.learned_.items()}
        write_checkpoint(path, self.kind, header, self.learned_)

    @classmethod
    def load(cls, path: str | Path) -> Self:
        """Reads what ``save`` wrote.

        Raises:
            FileNotFoundError: there is no such file.
            ValueError: the file is damaged, from a newer version, or something else.
        """
        saved = read_checkpoint(path, cls.kind)
        try:
            monitor = cls(StreamSpec.from_json(saved.header["spec"]), seed=saved.header["seed"])
            monitor.threshold_ = saved.header["threshold"]
            shapes = saved.header["shapes"]
        except (KeyError, TypeError) as error:
            raise ValueError(f"{path} is damaged: {error}") from error
        monitor.learned_ = {name: saved.array(name, *shape) for name, shape in shapes.items()}
        return monitor

    def _fitted(self) -> None:
        if not self.learned_:
            raise RuntimeError(f"this {type(self).__name__} has learned nothing yet: call fit(episodes) first")

    def _check(self, episodes: Sequence[Episode]) -> None:
        if len(episodes) == 0:
            raise ValueError("at least one episode is needed, got none")
        for n, episode in enumerate(episodes):
            self.spec.require(episode.spec, f"episode {n}")
            bad = np.argwhere(~np.isfinite(episode.stream))
            if len(bad):
                step, column = bad[0]
                raise ValueError(f"episode {n}, step {step}, {self.spec.labels[column]} must be finite")


def columns(spec: StreamSpec, suffix: str) -> NDArray[np.intp]:
    """Where the channels whose name ends in ``suffix`` stand in a row; one for each arm.

    Raises:
        ValueError: there is none.
    """
    found = [i for name, s in spec.slices.items() if name.endswith(suffix) for i in range(spec.size)[s]]
    if not found:
        raise ValueError(f"this stream has no {suffix}; it has: {', '.join(spec.slices)}")
    return np.array(found, dtype=np.intp)
