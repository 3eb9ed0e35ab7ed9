r"""Ridge regression on values: each group of senses from what the others say and do now, its own past left out.

    x̂_g,t = D_g [x_{¬g,t}, Δ_{¬g,t}, φ_{¬g,t}, u_t, 1]       judged where a cross-fitted R² exceeds 1/2
    Δ̂_g,t = E_g [x_{t-l}, Δ_{¬g,t}, φ_{¬g,t}, u_t, 1]        judged where it exceeds 0.99
    φ      = tanh(v/w s),  w ∈ {0.01, 0.1, 1}                  of each speed v of spread s
             sin, cos of angles q, of q_2 + q_3, …, and products of two of them
    ε      = (x - x̂)/s_x                                      s_x: the cross-fitted spread

What is judged given its own last value explains a push that is held after one step; a value that is expected from the
others does not. Motor current is torque plus what the sign of the speed says, and weight is a sum of products of sines
of angles along the chain: a linear model can say neither, and with φ both.
Changes are judged beside values only where they are nearly certain, as those of encoders are given speeds. Penalties,
spreads and R² come from five folds over episodes, or over blocks of a long one.

Sources: Hoerl and Kennard 1970; Stribeck friction smoothed by tanh: Makkar et al. 2005 (IEEE/ASME AIM).
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from typing import NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from asm_gym.data.coverage import POSITION, SPEED
from asm_gym.data.units import ratio
from asm_gym.detection import ModelOutput
from asm_gym.detection.base import Arrays
from asm_gym.episode import Episode
from asm_gym.memory.linear import check_inputs
from asm_gym.monitors.base import Progress, Told
from asm_gym.monitors.baselines.base import Lagged, associated, no_context, nothing_before
from asm_gym.monitors.stream_model import StreamModel
from asm_gym.scaling import ScaledRows, StreamScaler, rows_apart
from asm_gym.spec import StreamSpec
from asm_gym.validation import check_flag, typed

Floats = NDArray[np.float64]

WIDTHS = (0.01, 0.1, 1.0)
"""w, shares of a speed's spread."""

MOST_ANGLES = 12
"""More are no arm's: their products would be too many."""

CHAIN = 3
"""Angles from the second on that are added up: shoulder, elbow and wrist often turn about parallel axes."""

FOLDS = 5
PENALTIES = (1e-6, 1e-4, 1e-3, 1e-2, 1e-1)
"""Of standardised inputs."""

TOLD, CERTAIN = 0.5, 0.99
"""R² from which on a value and a change are judged."""

FAINTEST = 1e-4
"""Least spread of what is left of a standardised number."""


class _Fitted(NamedTuple):
    weights: Floats  # (X, I)
    left: Floats  # (X,) cross-fitted spread
    told: Floats  # (X,) cross-fitted R²


class ValueAssociation(StreamModel):
    """Ridge regression of values and of changes that are nearly certain; it has no context.

    Args:
        spec: the stream it is to expect.
        friction: whether smooth signs of the speeds are among the inputs.
        body: whether sines of the angles are; angles are taken to stand in the order of the chain.
        changes: whether changes are judged too.
    """

    kind = "association_values"

    @typed
    def __init__(self, spec: StreamSpec, friction: bool = True, body: bool = True, changes: bool = True) -> None:
        super().__init__(spec)
        self.friction, self.body = check_flag("friction", friction), check_flag("body", body)
        self.changes = check_flag("changes", changes)
        self.lag = rows_apart(spec.dt)
        self.shortest = 1 + self.lag
        self._derived = Derived.of(spec, friction, body)

    @property
    def error_columns(self) -> NDArray[np.intp]:
        if not self.learned_:
            return self.spec.sensory
        found: NDArray[np.intp] = self.spec.sensory[np.concatenate([self._told, self._certain])]
        return found

    def fit(self, episodes: Sequence[Episode], rng: np.random.Generator, progress: Progress) -> Self:
        streams = [e.stream for e in episodes]
        senses = self.senses_ = StreamScaler.fit(self.spec, streams, self.lag)
        parts = []
        for stream in streams:
            read = senses.read_episode(stream)
            parts.append([a[self.lag :] for a in self._read(read)])
        values, steps, before, derived, commands = (np.concatenate([p[k] for p in parts]) for k in range(5))
        middle, width = derived.mean(axis=0), np.maximum(derived.std(axis=0), FAINTEST)
        inputs = np.hstack([values, steps, before, (derived - middle) / width, commands])
        check_inputs(inputs.shape[1])
        fold = _folds([len(p[0]) for p in parts])
        given = _crossfitted(inputs, values, fold, senses.groups, self._own(values=True))
        progress(1, 2)
        moved = _crossfitted(inputs, steps, fold, senses.groups, self._own(values=False))
        progress(2, 2)
        told = np.flatnonzero(given.told > TOLD)
        certain = np.flatnonzero(moved.told > CERTAIN) if self.changes else np.zeros(0, np.intp)
        if not len(told) + len(certain):
            certain = np.arange(len(self.spec.sensory))  # nothing can be told: the changes are all there is
        left = np.concatenate([given.left[told], moved.left[certain]])
        return self.restore(
            {
                **{"mean": senses.mean, "spread": senses.spread, "change": senses.change},
                **{"derived_mean": middle, "derived_spread": width},
                **{
                    "judged_values": told * 1.0,
                    "judged_changes": certain * 1.0,
                    "R2_values": given.told,
                    "R2_changes": moved.told,
                },
                **{"D": given.weights[told], "E": moved.weights[certain], "remainder": np.maximum(left, FAINTEST)},
            }
        )

    def restore(self, learned: Arrays, skills: tuple[str, ...] = ()) -> Self:
        self.senses_ = StreamScaler(self.spec, learned["mean"], learned["spread"], learned["change"], self.lag)
        self._told, self._certain = (learned[f"judged_{what}"].astype(np.intp) for what in ("values", "changes"))
        return super().restore(learned, skills)

    def start(self, batch: int, told: Sequence[Told] = ()) -> Lagged:
        return nothing_before(batch, self.lag, self.spec.size)

    def predict(self, state: Lagged, rows: NDArray[np.float64]) -> tuple[Lagged, ModelOutput]:
        state, read, known = associated(self.senses_, state, rows)
        values, steps, before, derived, commands = self._read(read)
        found = self.learned_
        derived = (derived - found["derived_mean"]) / found["derived_spread"]
        inputs = np.hstack([values, steps, before, derived, commands])
        values, steps = values[:, self._told], steps[:, self._certain]
        errors = np.hstack([values - inputs @ found["D"].T, steps - inputs @ found["E"].T])
        return state, ModelOutput(known * errors / found["remainder"], no_context(rows))

    def _read(self, read: ScaledRows) -> tuple[Floats, Floats, Floats, Floats, Floats]:
        """Values, changes and values before (N, X), what is derived (N, M), and commands with a 1 (N, A + 1)."""
        senses, sensory = self.senses_, self.spec.sensory
        values = np.asarray(read.senses[:, : len(sensory)], np.float64)
        steps = np.asarray(read.inputs[:, senses.changes], np.float64)
        before = np.asarray(read.inputs[:, sensory], np.float64)
        physical = values * senses.spread[sensory] + senses.mean[sensory]
        derived = self._derived(physical, steps, senses.spread[sensory])
        return values, steps, before, derived, np.asarray(read.commands, np.float64)

    def _own(self, values: bool) -> list[NDArray[np.intp]]:
        """Of each group, the inputs that say what it says itself, which it is not expected from."""
        X, groups = len(self.spec.sensory), self.senses_.groups
        found = []
        for g in range(int(groups.max()) + 1):
            own = np.flatnonzero(groups == g)
            withheld = [own, X + own, 3 * X + np.flatnonzero(self._derived.sources[:, own].any(axis=1))]
            # A value is expected from now alone; a change from all that was before, and not from values now.
            withheld.append(2 * X + np.arange(X) if values else np.arange(X))
            found.append(np.unique(np.concatenate(withheld)).astype(np.intp))
        return found


class Derived(NamedTuple):
    """What is made of speeds and angles.

    Attributes:
        speeds: (S,) senses that are speeds, or whose changes are.
        from_steps: they are those of positions.
        angles: (J,) senses that are angles, along the chain.
        radians: (J,) in one of their units.
        pairs: (2, P) of sines and cosines of single angles, that are multiplied.
        sources: (M, X) which senses each is made of.
    """

    speeds: NDArray[np.intp]
    from_steps: bool
    angles: NDArray[np.intp]
    radians: Floats
    pairs: NDArray[np.intp]
    sources: NDArray[np.bool_]

    @classmethod
    def of(cls, spec: StreamSpec, friction: bool, body: bool) -> Self:
        """What a stream has by the names of its channels."""
        place = {int(column): k for k, column in enumerate(spec.sensory)}
        moving, from_steps = speeds(spec) if friction else (np.zeros(0, np.intp), False)
        columns = _named(spec, POSITION) if body else np.zeros(0, np.intp)
        columns = columns if len(columns) <= MOST_ANGLES else columns[:0]
        units = {
            i: c.unit for c, s in zip(spec.channels, spec.slices.values(), strict=True) for i in range(s.start, s.stop)
        }
        radians = np.array([ratio(units[int(i)], "rad") or 1.0 for i in columns])
        S, J = len(moving), len(columns)
        pairs = np.array(np.triu_indices(2 * J), np.intp) if J else np.zeros((2, 0), np.intp)
        own = np.eye(J, dtype=np.bool_)
        ends = range(2, min(J, CHAIN + 1))
        sums = np.array([[1 <= k <= n for k in range(J)] for n in ends], np.bool_).reshape(len(ends), J)
        single = np.vstack([own, own])
        of_angles = np.vstack([single, sums, sums, single[pairs[0]] | single[pairs[1]]])
        sources = np.zeros((S * len(WIDTHS) + len(of_angles), len(spec.sensory)), np.bool_)
        at = [place[int(i)] for i in moving]
        for w in range(len(WIDTHS)):
            sources[w * S + np.arange(S), at] = True
        angles = np.array([place[int(i)] for i in columns], np.intp)
        sources[S * len(WIDTHS) :, angles] = of_angles
        return cls(np.array(at, np.intp), from_steps, angles, radians, pairs, sources)

    def __call__(self, values: Floats, steps: Floats, spread: Floats) -> Floats:
        """(N, M) of values (N, X) in their units, standardised changes (N, X), and the values' spread (X,)."""
        speed = steps[:, self.speeds] if self.from_steps else values[:, self.speeds] / spread[self.speeds]
        parts = [np.tanh(speed / width) for width in WIDTHS]
        if len(self.angles):
            q = values[:, self.angles] * self.radians
            single = np.hstack([np.sin(q), np.cos(q)])
            sums = np.cumsum(q[:, 1 : CHAIN + 1], axis=1)[:, 1:]
            products = single[:, self.pairs[0]] * single[:, self.pairs[1]]
            parts += [single, np.sin(sums), np.cos(sums), products]
        return np.hstack(parts)


def _named(spec: StreamSpec, pattern: re.Pattern[str]) -> NDArray[np.intp]:
    """Columns of senses whose channel is called so."""
    named = zip(spec.channels, spec.slices.values(), strict=True)
    found = [np.arange(s.start, s.stop) for c, s in named if pattern.fullmatch(c.name.lower())]
    every = np.concatenate([*found, np.zeros(0, np.intp)])
    own: NDArray[np.intp] = np.intersect1d(every, spec.sensory).astype(np.intp)
    return own


def speeds(spec: StreamSpec) -> tuple[NDArray[np.intp], bool]:
    """Columns of the stream that are speeds; or of positions, and that their changes are."""
    for pattern, from_steps in ((SPEED, False), (POSITION, True)):
        found = _named(spec, pattern)
        if len(found):
            return found, from_steps
    return np.zeros(0, np.intp), False


def _folds(lengths: Sequence[int]) -> NDArray[np.intp]:
    """(N,) the fold of each row: whole episodes, or blocks where they are few."""
    if len(lengths) >= FOLDS:
        whole = [np.full(length, n % FOLDS, np.intp) for n, length in enumerate(lengths)]
        return np.concatenate(whole)
    total = sum(lengths)
    blocks: NDArray[np.intp] = np.arange(total, dtype=np.intp) * FOLDS // max(total, 1)
    return blocks


def _crossfitted(
    inputs: Floats, targets: Floats, fold: NDArray[np.intp], groups: NDArray[np.intp], own: list[NDArray[np.intp]]
) -> _Fitted:
    """Weights by the penalty that leaves the least in rows that were not learned from, and what it leaves there."""
    N, size = inputs.shape
    weights, left, told = np.zeros((targets.shape[1], size)), np.zeros(targets.shape[1]), np.zeros(targets.shape[1])
    grams = [inputs[fold == f].T @ inputs[fold == f] for f in range(FOLDS)]
    crosses = [inputs[fold == f].T @ targets[fold == f] for f in range(FOLDS)]
    gram, cross = sum(grams), sum(crosses)
    for g, withheld in enumerate(own):
        mine = np.flatnonzero(groups == g)
        used = np.setdiff1d(np.arange(size), withheld)
        squares = np.zeros((len(PENALTIES), len(mine)))
        for f in range(FOLDS):
            rest = (gram - grams[f])[np.ix_(used, used)]
            rows = max(int((fold != f).sum()), 1)
            eigenvalues, vectors = np.linalg.eigh(rest / rows)
            projected = vectors.T @ ((cross - crosses[f])[np.ix_(used, mine)] / rows)
            tried, wanted = inputs[fold == f][:, used] @ vectors, targets[fold == f][:, mine]
            for n, penalty in enumerate(PENALTIES):
                kept = projected / (np.maximum(eigenvalues, 0.0) + penalty)[:, None]
                squares[n] += ((wanted - tried @ kept) ** 2).sum(axis=0)
        best = np.argmin(squares, axis=0)
        left[mine] = np.sqrt(squares[best, np.arange(len(mine))] / N)
        variance = targets[:, mine].var(axis=0)
        told[mine] = 1.0 - left[mine] ** 2 / np.maximum(variance, FAINTEST**2)
        whole = gram[np.ix_(used, used)] / N
        for n in np.unique(best):
            solved = np.linalg.solve(whole + PENALTIES[n] * np.eye(len(used)), cross[np.ix_(used, mine)] / N)
            for k in np.flatnonzero(best == n):
                weights[mine[k], used] = solved[:, k]
    return _Fitted(weights, left, told)
