"""What monitors share: checks, calibration, scoring of whole episodes, checkpoints."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, ClassVar, Self

import numpy as np
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

from asm_gym.checkpoint import read_checkpoint, write_checkpoint
from asm_gym.detection.detector import conformal_episodes, conformal_threshold
from asm_gym.episodes import Episode
from asm_gym.monitors.base import State, Surprise
from asm_gym.stream import StreamSpec

Progress = Callable[[int, int], object]
"""Called as ``progress(done, total)``."""

WILD = 1e6
"""How many times the range of its channel a number may be away from the median."""

SCORED_AT_ONCE = 64
"""Episodes scored side by side; with more the arrays no longer fit the cache."""


class CalibratedMonitor(ABC):
    """A monitor whose threshold is conformal on the maximum of nominal episodes.

    Args:
        spec: the stream it watches.
        seed: of whatever learning draws.

    Attributes:
        learned_: what ``fit`` has found, by name; empty before.
        threshold_: what surprise must exceed for an alarm; None before ``calibrate``.
        skills_: names of skills, where it was told any.
    """

    kind: ClassVar[str]
    """Its name, in checkpoints and in ``make_monitor``."""

    hyperparameters: ClassVar[tuple[str, ...]] = ("seed",)
    """Arguments of ``__init__`` beside the spec, kept under their own names."""

    shortest: int = 1
    """Steps that an episode must have to be learned from."""

    def __init__(self, spec: StreamSpec, seed: int = 0) -> None:
        require("seed", seed, isinstance(seed, (int, np.integer)) and seed >= 0, "a whole number of at least 0")
        self.spec = spec
        self.seed = int(seed)
        self.threshold_: float | None = None
        self.learned_: dict[str, NDArray[Any]] = {}
        self.skills_: tuple[str, ...] = ()

    @abstractmethod
    def learn(self, streams: Sequence[NDArray[np.float32]], progress: Progress) -> dict[str, NDArray[Any]]:
        """What is to be known of nominal streams, (T, D) each."""

    def build(self) -> None:  # noqa: B027 (many need none)
        """Makes what ``shares`` needs out of ``learned_``. Raises ValueError where that does not fit together."""

    @abstractmethod
    def start(self, batch: int) -> State:
        """The state before the first row of ``batch`` streams: a NamedTuple of arrays whose first axis is B."""

    @abstractmethod
    def shares(self, state: State, rows: NDArray[np.float64]) -> tuple[State, NDArray[np.float64]]:
        """The next rows (B, D), perhaps not all finite: the new state, and each number's share of the surprise."""

    @property
    def threshold(self) -> float:
        if self.threshold_ is None:
            raise RuntimeError(
                f"this {type(self).__name__} has no threshold yet: call calibrate(nominal_episodes) first"
            )
        return self.threshold_

    def get_params(self) -> dict[str, Any]:
        """The hyperparameters by name."""
        return {name: getattr(self, name) for name in self.hyperparameters}

    def fit(self, episodes: Sequence[Episode], progress: Progress | None = None) -> Self:
        """Learns from whole nominal episodes of any number of skills; no labels.

        Args:
            episodes: of this spec.
            progress: called as ``progress(done, total)`` while learning.

        Raises:
            ValueError: no episode, one that is too short or of another spec, or a number that is not finite.
        """
        self._check(episodes)
        # One thread: products this small are slowed down by several, and ruined by several that share a core.
        with threadpool_limits(1):
            learned = self.learn([e.stream for e in episodes], progress or (lambda done, total: None))
        self.learned_, self.threshold_ = learned, None
        self.build()
        return self

    def calibrate(self, episodes: Sequence[Episode], false_alarm_rate: float = 0.01) -> Self:
        """Sets the threshold from nominal episodes that ``fit`` has not seen; P(any alarm in one) <= the rate.

        Args:
            episodes: at least ``conformal_episodes(false_alarm_rate)`` of them.
            false_alarm_rate: P(any alarm in a nominal episode), at most.
        """
        self._fitted()
        conformal_episodes(false_alarm_rate)  # refuses a bad rate before the work begins
        self._check(episodes)
        maxima = np.array([s.value.max() for s in self.score_episodes(episodes)])
        self.threshold_ = conformal_threshold(maxima, false_alarm_rate)
        return self

    def initial_state(self, batch: int = 1) -> State:
        """The state before the first row of ``batch`` streams."""
        if batch < 1:
            raise ValueError(f"batch must be at least 1, got {batch}")
        self._fitted()
        return self.start(batch)

    def observe(self, state: State, stream: NDArray[np.floating[Any]]) -> tuple[State, Surprise]:
        """The next row of each stream: the new state, and how surprising the row was.

        A number that is not finite makes the value and its own attribution infinite; it counts as unseen, so that
        later rows can be judged again.

        Args:
            state: as handed back last; it is not changed.
            stream: (B, D) one row a stream.
        """
        self._fitted()
        rows = np.asarray(stream, np.float64)
        self.spec.check_row(rows)
        batch = _batch(state)
        if rows.shape != (batch, self.spec.size):
            raise ValueError(f"stream must have the shape {(batch, self.spec.size)}, got {rows.shape}")
        state, attribution = self.shares(state, rows)
        finite = np.isfinite(rows)
        broken = ~finite.all(axis=1)
        if broken.any():
            attribution[broken] = np.where(finite[broken], 0.0, np.inf)
        return state, Surprise(attribution.sum(axis=1), attribution)

    def score(self, episode: Episode) -> Surprise:
        """The surprise of each step of an episode: value (T,), attribution (T, D)."""
        return self.score_episodes([episode])[0]

    def score_episodes(self, episodes: Sequence[Episode]) -> list[Surprise]:
        """``score`` for many episodes, which are run side by side."""
        for episode in episodes:
            self.spec.require(episode.spec, "the episode")
        self._fitted()
        scores: list[Surprise] = [Surprise(np.zeros(0), np.zeros((0, self.spec.size)))] * len(episodes)
        with threadpool_limits(1):
            for group, steps in side_by_side([e.stream for e in episodes], self.start, self.observe):
                for n, i in enumerate(group):
                    mine = steps[: len(episodes[i])]
                    value, attribution = (np.array([s[k][n] for s in mine]) for k in range(2))
                    scores[i] = Surprise(value, attribution.reshape(-1, self.spec.size))
        return scores

    def save(self, path: str | Path) -> None:
        """Writes everything learned to one file: arrays and JSON."""
        self._fitted()
        header = {
            "spec": self.spec.to_json(),
            "hyperparameters": self.get_params(),
            "threshold": self.threshold_,
            "skills": list(self.skills_),
            "shapes": {name: list(array.shape) for name, array in self.learned_.items()},
        }
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
            monitor = cls(StreamSpec.from_json(saved.header["spec"]), **saved.header["hyperparameters"])
            monitor.threshold_, monitor.skills_ = saved.header["threshold"], tuple(saved.header["skills"])
            shapes = saved.header["shapes"]
            monitor.learned_ = {name: saved.array(name, *shape) for name, shape in shapes.items()}
            monitor.build()
        except (KeyError, TypeError) as error:
            raise ValueError(f"{path} is damaged: {error}") from error
        return monitor

    def _fitted(self) -> None:
        if not self.learned_:
            raise RuntimeError(f"this {type(self).__name__} has learned nothing yet: call fit(episodes) first")

    def _check(self, episodes: Sequence[Episode]) -> None:
        """Refuses episodes that cannot be learned from."""
        if isinstance(episodes, Episode):
            raise TypeError("episodes must be a list of them, got a single Episode")
        if len(episodes) == 0:
            raise ValueError("at least one episode is needed, got none")
        for n, episode in enumerate(episodes):
            self.spec.require(episode.spec, f"episode {n}")
            if len(episode) < self.shortest:
                raise ValueError(f"episode {n} must be at least {self.shortest} steps long, got {len(episode)}")
            bad = np.argwhere(~np.isfinite(episode.stream))
            if len(bad):
                step, column = bad[0]
                label, value = self.spec.labels[column], episode.stream[step, column]
                raise ValueError(f"episode {n}, step {step}, {label} must be finite, got {value}")
        refuse_wild(episodes)


def refuse_wild(episodes: Sequence[Episode]) -> None:
    """Raises ValueError for a number out of all proportion, which would hide whatever its channel does otherwise."""
    if max(float(np.abs(e.stream).max()) for e in episodes) <= WILD / 2:
        return
    rows = np.concatenate([e.stream for e in episodes]).astype(np.float64)
    low, middle, high = np.quantile(rows, (0.01, 0.5, 0.99), axis=0)
    reach = WILD * np.maximum(np.maximum(high - low, np.abs(middle)), 1.0)
    for n, episode in enumerate(episodes):
        wild = np.argwhere(np.abs(episode.stream - middle) > reach)
        if len(wild):
            step, column = wild[0]
            label, value = episode.spec.labels[column], episode.stream[step, column]
            raise ValueError(
                f"episode {n}, step {step}, {label} is {value:g}, where 98 % of all lie between {low[column]:g} and "
                f"{high[column]:g}: leave the episode out"
            )


def side_by_side(
    streams: Sequence[NDArray[np.float32]],
    start: Callable[[int], State],
    advance: Callable[[State, NDArray[np.float64]], tuple[State, Any]],
) -> Iterator[tuple[list[int], list[Any]]]:
    """Runs many streams together, the longest first; those that have ended are left out.

    Yields, for each group of streams, their indices and what ``advance`` said of each step.
    """
    order = sorted(range(len(streams)), key=lambda i: -len(streams[i]))
    for first in range(0, len(order), SCORED_AT_ONCE):
        group = order[first : first + SCORED_AT_ONCE]
        state, said = start(len(group)), []
        for t in range(len(streams[group[0]])):
            rows = np.stack([streams[i][t] for i in group if t < len(streams[i])]).astype(np.float64)
            state, step = advance(_first(state, len(rows)), rows)
            said.append(step)
        yield group, said


def require(name: str, value: object, fulfilled: bool, what: str) -> None:
    """Raises ValueError unless a hyperparameter is what it must be."""
    if not fulfilled:
        raise ValueError(f"{name} must be {what}, got {value}")


def columns(spec: StreamSpec, suffix: str) -> NDArray[np.intp]:
    """Where the channels whose name ends in ``suffix`` stand in a row; one for each arm.

    Raises:
        ValueError: there is none.
    """
    found = [i for name, s in spec.slices.items() if name.endswith(suffix) for i in range(spec.size)[s]]
    if not found:
        raise ValueError(f"this stream has no {suffix}; it has: {', '.join(spec.slices)}")
    return np.array(found, dtype=np.intp)


def _first(state: State, count: int) -> State:
    """The state of the first ``count`` streams."""
    return type(state)(*(_first(s, count) for s in state)) if isinstance(state, tuple) else state[:count]


def _batch(state: State) -> int:
    """B."""
    return _batch(state[0]) if isinstance(state, tuple) else len(state)
