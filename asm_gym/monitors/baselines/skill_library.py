"""The classical associative skill memory: a library of skills, each a movement primitive with its sensor traces.

    τ v̇ = α (β (g - y) - v) + f(x),   τ ẏ = v,   τ ẋ = -α_x x,   f(x) = Σ ψ_i(x) w_i x / Σ ψ_i(x)     for the hand
    s_t = Σ_i ((x_t,i - m_i(φ)) / σ_i(φ))²                                     φ the phase, for every other sense

The skill that is running has to be selected; here it is told, from ``episode.info["skill"]``, which no other monitor
reads. Sources: Pastor, Kalakrishnan, Chitta, Theodorou and Schaal 2011 (ICRA), “Skill learning and task outcome
prediction for manipulation”; Ijspeert et al. 2013 (Neural Computation 25(2)) for the primitive.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from asm_gym.checks import check_number
from asm_gym.detection import ModelOutput
from asm_gym.episodes import Episode
from asm_gym.monitors.base import Progress
from asm_gym.monitors.baselines.base import no_context
from asm_gym.monitors.model import StreamModel, skills_of
from asm_gym.stream import StreamSpec
from asm_gym.typed import typed

PHASES = 60
"""Bins of the phase that sensor statistics are kept for."""

DECAY = 4.0
"""α_x of the phase."""


class _Running(NamedTuple):
    skill: NDArray[np.intp]  # (B,)
    steps: NDArray[np.int64]  # (B,)
    place: NDArray[np.float64]  # (B, P) y, where the primitive has the hand
    speed: NDArray[np.float64]  # (B, P) v


class SkillLibrary(StreamModel):
    """A library of movement primitives; ``start`` has to be told which of them is to run.

    Args:
        spec: the stream it is to expect.
        bases: basis functions of a primitive.
        stiffness: α of the spring, with β = α/4 for critical damping.
    """

    kind = "skill_library"

    @typed
    def __init__(self, spec: StreamSpec, bases: int = 40, stiffness: float = 25.0) -> None:
        super().__init__(spec)
        self.bases = check_number("bases", bases, low=2, whole=True)
        self.stiffness = check_number("stiffness", stiffness, above=0.0)
        hand = [i for n, s in spec.slices.items() if n.endswith("hand_position") for i in range(spec.size)[s]]
        self._hand = np.searchsorted(spec.sensory, hand).astype(np.intp)  # among the sensory columns; perhaps none

    def fit(self, episodes: Sequence[Episode], rng: np.random.Generator, progress: Progress) -> Self:
        xs, names = [e.stream[:, self.spec.sensory].astype(np.float64) for e in episodes], skills_of(episodes)
        floor = 0.01 * np.maximum(np.concatenate(xs).std(axis=0), 1e-6)
        skills = sorted(set(names))
        library = [self._learn([x for x, n in zip(xs, names, strict=True) if n == s], floor) for s in skills]
        return self.restore({k: np.stack([one[k] for one in library]) for k in library[0]}, tuple(skills))

    def start(self, batch: int, skills: Sequence[str] = ()) -> _Running:
        """Of a skill that is not in the library, or not told, the first is taken to run."""
        told = [self.skills_.index(name) if name in self.skills_ else 0 for name in skills or [""] * batch]
        nowhere = np.zeros((batch, len(self._hand)))
        return _Running(np.array(told, np.intp), np.zeros(batch, np.int64), nowhere, nowhere)

    def predict(self, state: _Running, rows: NDArray[np.float64]) -> tuple[_Running, ModelOutput]:
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
        basis = _basis(clock, self.bases)  # (B, N)
        force = np.einsum("bn,bnp->bp", basis, found["weights"][skill]) * clock
        v = v + dt * (self._spring(found["goal"][skill] - y, v) + force)
        running = _Running(skill, state.steps + 1, y + dt * v, v)
        return running, ModelOutput(np.where(np.isfinite(error), error, 0.0), no_context(rows))

    def _spring(self, away: NDArray[np.float64], v: NDArray[np.float64]) -> NDArray[np.float64]:
        """α (β (g - y) - v)."""
        return self.stiffness * (self.stiffness / 4 * away - v)

    def _learn(self, xs: Sequence[NDArray[np.float64]], floor: NDArray[np.float64]) -> dict[str, NDArray[np.float64]]:
        """A primitive for the hand, by regression on the mean demonstration, and the statistics of every sense."""
        steps = float(np.mean([len(x) for x in xs]))
        phase = np.concatenate([np.minimum(np.arange(len(x)) / steps, 1.0) for x in xs])
        bins, rows = np.minimum((phase * PHASES).astype(np.intp), PHASES - 1), np.concatenate(xs)
        mean, spread = np.zeros((PHASES, rows.shape[1])), np.zeros((PHASES, rows.shape[1]))
        for b in range(PHASES):
            own = rows[bins == b] if (bins == b).any() else rows
            mean[b], spread[b] = own.mean(axis=0), own.std(axis=0) + floor
        time = np.linspace(0, 1, max(3, round(steps)))
        path = np.zeros((len(time), len(self._hand)))  # (T, P) the mean demonstration
        for p, h in enumerate(self._hand):
            path[:, p] = np.mean([np.interp(time * (len(x) - 1), np.arange(len(x)), x[:, h]) for x in xs], axis=0)
        v = np.gradient(path, time, axis=0)
        clock = np.exp(-DECAY * time)[:, None]
        force = np.gradient(v, time, axis=0) - self._spring(path[-1] - path, v)
        design = _basis(clock, self.bases) * clock  # (T, N)
        weights = np.linalg.solve(design.T @ design + 1e-6 * np.eye(self.bases), design.T @ force)
        return {"steps": np.array(steps), "goal": path[-1], "weights": weights, "mean": mean, "spread": spread}


def _basis(clock: NDArray[np.float64], bases: int) -> NDArray[np.float64]:
    """ψ_i(x) / Σ ψ (B, N) for x (B, 1), evenly spaced in time."""
    centres = np.exp(-DECAY * np.linspace(0, 1, bases))
    widths = 1.0 / np.gradient(centres) ** 2
    activity = np.exp(-0.5 * widths * (clock - centres) ** 2) + 1e-12
    normalised: NDArray[np.float64] = activity / activity.sum(axis=1, keepdims=True)
    return normalised
