"""The classical associative skill memory: a library of skills, each a movement primitive with its sensor traces.

    τ v̇ = α (β (g - y) - v) + f(x),   τ ẏ = v,   τ ẋ = -α_x x,   f(x) = Σ ψ_i(x) w_i x / Σ ψ_i(x)     for the hand
    s_t = Σ_i ((x_t,i - m_i(φ)) / σ_i(φ))²                                     φ the phase, for every other sense
    g, w and m = M [1, z]                                                      z the goal

The skill that is running has to be selected, and its goal perceived. Here it is told both, which no other monitor is:
``episode.info["skill"]``, and ``episode.info["goal"]``, what vision would say of the objects before the first step. A
primitive that is given another end alone reaches for where things usually are, so all of it is regressed on the goal.

Sources: Pastor, Kalakrishnan, Chitta, Theodorou and Schaal 2011 (ICRA), “Skill learning and task outcome
prediction for manipulation”; Ijspeert et al. 2013 (Neural Computation 25(2)) for the primitive; Ude, Gams, Asfour and
Morimoto 2010 (IEEE Transactions on Robotics 26(5)) for regressing primitives on their goals.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from asm_gym.detection import ModelOutput
from asm_gym.episode import Episode
from asm_gym.monitors.base import Progress, Told
from asm_gym.monitors.baselines.base import no_context
from asm_gym.monitors.stream_model import StreamModel, skills_of
from asm_gym.spec import StreamSpec
from asm_gym.validation import check_number, typed

Floats = NDArray[np.float64]

PHASES = 60
"""Bins of the phase that sensor statistics are kept for."""

DECAY = 4.0
"""α_x of the phase."""

PENALTIES = 10.0 ** np.arange(-2, 5)
"""Of the regression on the goal, in episodes; the last leaves next to nothing of it."""

FAINTEST = 1e-4
"""Standard deviation of a number of the goal below which it is always the same."""


class _Running(NamedTuple):
    skill: NDArray[np.intp]  # (B,)
    steps: NDArray[np.int64]  # (B,)
    goal: Floats  # (B, 1 + K) 1 and z
    place: Floats  # (B, P) y, where the primitive has the hand
    speed: Floats  # (B, P) v


class SkillLibrary(StreamModel):
    """A library of movement primitives; ``start`` has to be told which of them is to run, and towards what.

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
        goals = [_goal(e.info) for e in episodes]
        floor = 0.01 * np.maximum(np.concatenate(xs).std(axis=0), 1e-6)
        skills, widest = sorted(set(names)), max(map(len, goals))
        library = []
        for skill in skills:
            own = [n for n, name in enumerate(names) if name == skill]
            library.append(self._learn([xs[n] for n in own], [goals[n] for n in own], widest, floor))
        return self.restore({k: np.stack([one[k] for one in library]) for k in library[0]}, tuple(skills))

    def start(self, batch: int, told: Sequence[Told] = ()) -> _Running:
        """Of a skill that is not in the library, or not told, the first is taken to run, and of a goal the usual."""
        found, told = self.learned_, told or [{}] * batch
        skill = np.array([self.skills_.index(n) if (n := t.get("skill")) in self.skills_ else 0 for t in told], np.intp)
        z = np.zeros((batch, found["usual"].shape[1]))
        for own, k, goal in zip(z, skill, map(_goal, told), strict=True):
            if len(goal) == found["goal_size"][k]:
                own[: len(goal)] = (goal - found["usual"][k, : len(goal)]) / found["varies"][k, : len(goal)]
        nowhere = np.zeros((batch, len(self._hand)))
        return _Running(skill, np.zeros(batch, np.int64), np.column_stack([np.ones(batch), z]), nowhere, nowhere)

    def predict(self, state: _Running, rows: Floats) -> tuple[_Running, ModelOutput]:
        found, skill = self.learned_, state.skill
        x = rows[:, self.spec.sensory]
        phase = np.minimum(state.steps / found["steps"][skill], 1.0)  # (B,) of the movement
        bins = np.minimum((phase * PHASES).astype(np.intp), PHASES - 1)
        hand = x[:, self._hand]
        expected = np.einsum("bk,bkx->bx", state.goal, found["mean"][skill, :, bins])  # (B, X)
        # A primitive starts where the hand is, as fast as it was shown, and runs on its own from there.
        begins = np.where(np.isfinite(hand), hand, expected[:, self._hand])
        first = (state.steps == 0)[:, None]
        y = np.where(first, begins, state.place)
        v = np.where(first, np.einsum("bk,bkp->bp", state.goal, found["speed"][skill]), state.speed)
        expected[:, self._hand] = y
        error = (x - expected) / found["spread"][skill, bins]
        dt = 1.0 / found["steps"][skill][:, None]
        clock = np.exp(-DECAY * phase)[:, None]
        basis = _basis(clock, self.bases)  # (B, N)
        force = np.einsum("bk,bn,bknp->bp", state.goal, basis, found["weights"][skill]) * clock
        end = np.einsum("bk,bkp->bp", state.goal, found["goal"][skill])
        v = v + dt * (self._spring(end - y, v) + force)
        running = state._replace(steps=state.steps + 1, place=y + dt * v, speed=v)
        return running, ModelOutput(np.where(np.isfinite(error), error, 0.0), no_context(rows))

    def _spring(self, away: Floats, v: Floats) -> Floats:
        """α (β (g - y) - v)."""
        return self.stiffness * (self.stiffness / 4 * away - v)

    def _learn(self, xs: Sequence[Floats], goals: Sequence[Floats], widest: int, floor: Floats) -> dict[str, Floats]:
        """A primitive for the hand, by regression on the mean demonstration, and the statistics of every sense.

        Args:
            xs: (T, X) of each episode.
            goals: (K,) of each; those of a skill are regressed on only where all of them are told, and alike.
            widest: numbers of the goal of the skill that has most.
            floor: (X,) least spread.
        """
        size = len(goals[0]) if len({len(g) for g in goals}) == 1 else 0
        usual, varies = np.zeros(widest), np.ones(widest)
        told = np.stack([g[:size] for g in goals])  # (E, K)
        usual[:size] = told.mean(axis=0)
        varies[:size] = np.where(told.std(axis=0) > FAINTEST, told.std(axis=0), np.inf)
        z = np.zeros((len(xs), widest))
        z[:, :size] = (told - usual[:size]) / varies[:size]

        steps = float(np.mean([len(x) for x in xs]))
        bins = [
            np.minimum((np.minimum(np.arange(len(x)) / steps, 1.0) * PHASES).astype(np.intp), PHASES - 1) for x in xs
        ]
        rows, of = np.concatenate(xs), np.concatenate(bins)
        pooled = np.stack([(rows[of == b] if (of == b).any() else rows).mean(axis=0) for b in range(PHASES)])
        each = np.repeat(pooled[None], len(xs), axis=0)  # (E, PHASES, X)
        for own, x, b in zip(each, xs, bins, strict=True):
            own[np.unique(b)] = [x[b == n].mean(axis=0) for n in np.unique(b)]
        slopes, alone = _slopes(z, each - pooled)
        mean = np.concatenate([pooled[None], slopes])  # (1 + K, PHASES, X)
        # Of each episode what the others say of it, for what it says of itself is too good.
        left = np.concatenate([x - (m - off)[b] for x, m, off, b in zip(xs, each, alone, bins, strict=True)])
        around = rows - rows.mean(axis=0)
        spread = np.stack([(left[of == b] if (of == b).any() else around).std(axis=0) for b in range(PHASES)]) + floor

        time = np.linspace(0, 1, max(3, round(steps)))
        paths = np.zeros((len(xs), len(time), len(self._hand)))  # (E, T, P) the demonstrations
        for path, x in zip(paths, xs, strict=True):
            for p, h in enumerate(self._hand):
                path[:, p] = np.interp(time * (len(x) - 1), np.arange(len(x)), x[:, h])
        usually = paths.mean(axis=0)
        path = np.concatenate([usually[None], _slopes(z, paths - usually)[0]])  # (1 + K, T, P)
        v = np.gradient(path, time, axis=1)
        clock = np.exp(-DECAY * time)[:, None]
        force = np.gradient(v, time, axis=1) - self._spring(path[:, -1:] - path, v)
        design = _basis(clock, self.bases) * clock  # (T, N)
        solved = np.linalg.solve(design.T @ design + 1e-6 * np.eye(self.bases), design.T)  # (N, T)
        about = {"goal_size": np.array(float(size)), "usual": usual, "varies": varies, "steps": np.array(steps)}
        return {
            **about,
            "goal": path[:, -1],
            "speed": v[:, 0],
            "weights": solved @ force,
            "mean": mean,
            "spread": spread,
        }


def _goal(told: Told) -> Floats:
    """(K,) as an episode says it; nothing where it says none."""
    return np.asarray(told.get("goal", ()), np.float64).reshape(-1)


def _slopes(z: Floats, y: Floats) -> tuple[Floats, Floats]:
    """Ridge regression of y (E, T, X) on z (E, K), both without their means; a penalty for each of X.

    Returns the slopes (K, T, X), and what of each y is left by the regression of all others (E, T, X).
    """
    slopes, left = np.zeros((z.shape[1], *y.shape[1:])), y.copy()
    if not z.any() or len(z) < 3:
        return slopes, left
    u, s, vt = np.linalg.svd(z, full_matrices=False)
    least = np.full(y.shape[2], np.inf)
    for penalty in PENALTIES:
        inverse = vt.T * (s / (s**2 + penalty)) @ u.T  # (K, E)
        found = np.tensordot(inverse, y, 1)
        own = 1 / len(z) + np.einsum("ek,ke->e", z, inverse)  # the share of each in what is said of itself
        others = (y - np.tensordot(z, found, 1)) / (1 - own)[:, None, None]
        lost = (others**2).mean(axis=(0, 1))  # (X,)
        slopes[..., lost < least], left[..., lost < least] = found[..., lost < least], others[..., lost < least]
        least = np.minimum(least, lost)
    return slopes, left


def _basis(clock: NDArray[np.float64], bases: int) -> NDArray[np.float64]:
    """ψ_i(x) / Σ ψ (B, N) for x (B, 1), evenly spaced in time."""
    centres = np.exp(-DECAY * np.linspace(0, 1, bases))
    widths = 1.0 / np.gradient(centres) ** 2
    activity = np.exp(-0.5 * widths * (clock - centres) ** 2) + 1e-12
    normalised: NDArray[np.float64] = activity / activity.sum(axis=1, keepdims=True)
    return normalised
