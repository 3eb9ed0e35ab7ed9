"""The classical associative skill memory: a library of skills, each a movement primitive with its sensor traces.

    τ v̇ = α (β (g - y) - v) + f(x),   τ ẏ = v,   τ ẋ = -α_x x,   f(x) = Σ ψ_i(x) w_i x / Σ ψ_i(x)     for the hand
    s_t = Σ_i ((x_t,i - m_i(φ)) / σ_i(φ))²                                     φ the phase, for every other sense

The skill that is running has to be selected; here it is told, from ``episode.info["skill"]``, which no other monitor
reads. Sources: Pastor, Kalakrishnan, Chitta, Theodorou and Schaal 2011 (ICRA), “Skill learning and task outcome
prediction for manipulation”; Ijspeert et al. 2013 (Neural Computation 25(2)) for the primitive.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from asm_gym.detection.detector import Run
from asm_gym.episodes import Episode
from asm_gym.monitors.base import Surprise
from asm_gym.monitors.baselines.base import Baseline
from asm_gym.monitors.monitor import Progress
from asm_gym.stream import StreamSpec

BASES = 40
"""Basis functions of a primitive."""

PHASES = 60
"""Bins of the phase that sensor statistics are kept for."""

STIFFNESS, DECAY = 25.0, 4.0
"""α of the spring, with β = α/4 for critical damping, and α_x of the phase."""


class _Running(NamedTuple):
    skill: NDArray[np.intp]  # (B,)
    steps: NDArray[np.int64]  # (B,)
    place: NDArray[np.float64]  # (B, P) y, where the primitive has the hand
    speed: NDArray[np.float64]  # (B, P) v


class SkillLibrary(Baseline):
    """A library of movement primitives; the arguments are those of ``PredictiveMonitor``.

    Attributes:
        selected: number of the skill in ``skills_`` that a new state starts with.
    """

    kind = "skill_library"

    def __init__(self, spec: StreamSpec, **kwargs: Any) -> None:
        super().__init__(spec, **kwargs)
        hand = [i for n, s in spec.slices.items() if n.endswith("hand_position") for i in range(spec.size)[s]]
        self._hand = np.searchsorted(spec.sensory, hand).astype(np.intp)  # among the sensory columns; perhaps none
        self.selected = 0
        self._skill: dict[int, str] = {}

    def fit(self, episodes: Sequence[Episode], progress: Progress | None = None) -> Self:
        self._skill = {id(e.stream): _name(e) for e in episodes}
        try:
            return super().fit(episodes, progress)
        finally:
            self._skill = {}

    def learn_model(
        self, streams: Sequence[NDArray[np.float32]], rng: np.random.Generator, progress: Progress
    ) -> dict[str, NDArray[Any]]:
        skills = sorted(set(self._skill.values()))
        xs = [s[:, self.spec.sensory].astype(np.float64) for s in streams]
        overall = np.maximum(np.concatenate(xs).std(axis=0), 1e-6)
        learned = []
        for name in skills:
            own = [x for x, s in zip(xs, streams, strict=True) if self._skill[id(s)] == name] or xs
            learned.append(_learn(own, self._hand, 0.01 * overall))
        self.skills_ = tuple(skills)
        return {k: np.stack([one[k] for one in learned]) for k in learned[0]}

    def build_model(self) -> None:
        """Nothing to make: the arrays are used as they are."""

    def start_model(self, batch: int) -> _Running:
        nowhere = np.zeros((batch, len(self._hand)))
        return _Running(np.full(batch, self.selected), np.zeros(batch, np.int64), nowhere, nowhere)

    def predict(
        self, state: _Running, rows: NDArray[np.float64]
    ) -> tuple[_Running, NDArray[np.float64], NDArray[np.float64]]:
        found, skill = self.learned_, state.skill
        x = rows[:, self.spec.sensory]
        phase = np.minimum(state.steps / found["steps"][skill], 1.0)  # (B,) of the movement
        bins = np.minimum((phase * PHASES).astype(np.intp), PHASES - 1)
        hand = x[:, self._hand]
        mean = found["mean"][skill, bins]  # (B, X)
        # A primitive starts where the hand is, and runs on its own from there.
        y = np.where((state.steps == 0)[:, None], np.where(np.isfinite(hand), hand, mean[:, self._hand]), state.place)
        v = state.speed
        expected = mean.copy()
        expected[:, self._hand] = y
        error = (x - expected) / found["spread"][skill, bins]
        dt = 1.0 / found["steps"][skill][:, None]
        clock = np.exp(-DECAY * phase)[:, None]
        basis = _basis(clock)  # (B, BASES)
        force = np.einsum("bn,bnp->bp", basis, found["weights"][skill]) * clock
        v = v + dt * (STIFFNESS * (STIFFNESS / 4 * (found["goal"][skill] - y) - v) + force)
        running = _Running(skill, state.steps + 1, y + dt * v, v)
        return running, np.where(np.isfinite(error), error, 0.0), np.zeros((len(rows), 0))

    def score_episodes(self, episodes: Sequence[Episode]) -> list[Surprise]:
        """As for any monitor, but each episode with the skill that its ``info["skill"]`` names."""
        scores: dict[int, Surprise] = {}
        for name in sorted({_name(e) for e in episodes}):
            own = [i for i, e in enumerate(episodes) if _name(e) == name]
            self.selected = self.skills_.index(name) if name in self.skills_ else 0
            scores.update(zip(own, super().score_episodes([episodes[i] for i in own]), strict=True))
        self.selected = 0
        return [scores[i] for i in range(len(episodes))]

    def _runs(self, streams: Sequence[NDArray[np.float32]]) -> list[Run]:
        runs: dict[int, Run] = {}
        for number, name in enumerate(sorted(set(self._skill.values()))):
            self.selected = number
            own = [i for i, s in enumerate(streams) if self._skill[id(s)] == name]
            if own:
                runs.update(zip(own, super()._runs([streams[i] for i in own]), strict=True))
        self.selected = 0
        return [runs[i] for i in range(len(streams))]


def _name(episode: Episode) -> str:
    return str(episode.info.get("skill", ""))


def _basis(clock: NDArray[np.float64]) -> NDArray[np.float64]:
    """ψ_i(x) / Σ ψ (B, BASES) for x (B, 1), evenly spaced in time."""
    centres = np.exp(-DECAY * np.linspace(0, 1, BASES))
    widths = 1.0 / np.gradient(centres) ** 2
    activity = np.exp(-0.5 * widths * (clock - centres) ** 2) + 1e-12
    normalised: NDArray[np.float64] = activity / activity.sum(axis=1, keepdims=True)
    return normalised


def _learn(
    xs: Sequence[NDArray[np.float64]], hand: NDArray[np.intp], floor: NDArray[np.float64]
) -> dict[str, NDArray[np.float64]]:
    """A primitive for the hand, by regression on the mean demonstration, and the statistics of every sense."""
    steps = float(np.mean([len(x) for x in xs]))
    phase = np.concatenate([np.minimum(np.arange(len(x)) / steps, 1.0) for x in xs])
    bins, rows = np.minimum((phase * PHASES).astype(np.intp), PHASES - 1), np.concatenate(xs)
    mean, spread = np.zeros((PHASES, rows.shape[1])), np.zeros((PHASES, rows.shape[1]))
    for b in range(PHASES):
        own = rows[bins == b] if (bins == b).any() else rows
        mean[b], spread[b] = own.mean(axis=0), own.std(axis=0) + floor
    time = np.linspace(0, 1, max(3, round(steps)))
    path = np.zeros((len(time), len(hand)))  # (T, P) the mean demonstration
    for p, h in enumerate(hand):
        path[:, p] = np.mean([np.interp(time * (len(x) - 1), np.arange(len(x)), x[:, h]) for x in xs], axis=0)
    v = np.gradient(path, time, axis=0)
    clock = np.exp(-DECAY * time)[:, None]
    force = np.gradient(v, time, axis=0) - STIFFNESS * (STIFFNESS / 4 * (path[-1] - path) - v)
    design = _basis(clock) * clock  # (T, BASES)
    weights = np.linalg.solve(design.T @ design + 1e-6 * np.eye(BASES), design.T @ force)
    return {"steps": np.array(steps), "goal": path[-1], "weights": weights, "mean": mean, "spread": spread}
