r"""Ridge regression of values: each group of senses from the values and changes of the others, without its own past.

    x̂_g,t = D_g [x_{¬g,t}, Δ_{¬g,t}, φ_{¬g,t}, u_t, 1]       judged: torques, and what a cross-fitted R² of 1/2 tells
    φ      friction and weight, see ``arm_inputs``
    ε      = (x - x̂) / s_x √max(1, h/h̃)                      s_x: the cross-fitted spread
    h      = zᵀ (ZᵀZ/N + λ)⁻¹ z,  h̃ its cross-fitted median    z: what x is expected from

A push that is held is explained after one step where a value is predicted from its own last one; where it is predicted
from the others, it is not. A torque is always judged; positions and speeds, beside torques, are left to their changes,
for no other sense predicts where an arm may go. Where few rows were learned from, h is large and an error counts for
less. Penalties, spreads, R² and h̃ come from five folds over episodes, or over blocks of a long one.

Sources: Hoerl and Kennard 1970; for h, the leverage: Hoaglin and Welsch 1978 (The American Statistician 32).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from asm_gym.data.episode import Episode
from asm_gym.detection import ModelOutput
from asm_gym.detection.base import Arrays
from asm_gym.memory.linear import check_inputs
from asm_gym.memory.temporal import RowHistory
from asm_gym.monitors.arm_inputs import Derived, forces, motion
from asm_gym.monitors.base import Progress
from asm_gym.monitors.stream_model import ScaledModel, no_context, read_next
from asm_gym.scaling import ScaledRows, StreamScaler, rows_apart
from asm_gym.spec import StreamSpec
from asm_gym.validation import typed

Floats = NDArray[np.float64]

FOLDS = 5
PENALTIES = (1e-6, 1e-4, 1e-3, 1e-2, 1e-1)  # of standardised inputs
PREDICTED = 0.5  # R² from which on a value is judged
FAINTEST = 1e-4  # least spread of what is left of a standardised number
STIFFNESS = 1e-2  # λ
MOST_INPUTS = 1024  # with more inputs no leverage is computed: the matrices would be too large


class _Fitted(NamedTuple):
    weights: Floats  # (X, I)
    left: Floats  # (X,) cross-fitted spread
    R2: Floats  # (X,) cross-fitted


class ValueAssociation(ScaledModel):
    """Ridge regression of values; it has no context. Where nothing predicts a value, all are judged.

    Args:
        spec: the stream it is to expect.
        urdf: text of a body model, as ``read_urdf`` reads it: what links weigh, and their inertia, in place of sines.
    """

    kind = "association_values"

    @typed
    def __init__(self, spec: StreamSpec, urdf: str = "") -> None:
        super().__init__(spec, rows_apart(spec.dt))
        self.urdf = urdf
        self._derived = Derived.of(spec, urdf)

    @property
    def error_columns(self) -> NDArray[np.intp]:
        if not self.learned_:
            return self.spec.sensory
        columns: NDArray[np.intp] = self.spec.sensory[self._values]
        return columns

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
        own = self._own()
        given = _crossfitted(inputs, values, fold, senses.groups, own)
        progress(1, 1)
        judged = self.judged(given.R2)
        judged = judged if len(judged) else np.arange(len(given.R2))
        judging = np.unique(senses.groups[judged]) if inputs.shape[1] <= MOST_INPUTS else ()
        far = [_far(inputs, fold, own[g]) for g in judging]
        learned = {
            "derived_mean": middle,
            "derived_spread": width,
            "judged_values": judged * 1.0,
            "R2_values": given.R2,
            "D": given.weights[judged],
            "remainder": np.maximum(given.left[judged], FAINTEST),
            "far": np.array(far).reshape(len(far), *inputs.shape[1:] * 2),
        }
        return self.restore({**senses.arrays, **learned})

    def restore(self, learned: Arrays, skills: tuple[str, ...] = ()) -> Self:
        self._values = learned["judged_values"].astype(np.intp)
        return super().restore(learned, skills)

    def predict(self, state: RowHistory, rows: NDArray[np.float64]) -> tuple[RowHistory, ModelOutput]:
        state, read, known = read_next(self.senses_, state, rows)
        values, steps, before, derived, commands = self._read(read)
        found = self.learned_
        derived = (derived - found["derived_mean"]) / found["derived_spread"]
        inputs = np.hstack([values, steps, before, derived, commands])
        errors = (values[:, self._values] - inputs @ found["D"].T) / self._farther(inputs)
        return state, ModelOutput(known * errors / found["remainder"], no_context(rows))

    def _read(self, read: ScaledRows) -> tuple[Floats, Floats, Floats, Floats, Floats]:
        """Return values, changes and values before (N, X), derived inputs (N, M), and commands with a 1 (N, A + 1)."""
        senses, sensory = self.senses_, self.spec.sensory
        values = np.asarray(read.senses[:, : len(sensory)], np.float64)
        steps = np.asarray(read.inputs[:, senses.changes], np.float64)
        before = np.asarray(read.inputs[:, sensory], np.float64)
        physical = values * senses.spread[sensory] + senses.mean[sensory]
        derived = self._derived(
            physical, steps, senses.spread[sensory], senses.change[sensory] / (self.lag * self.spec.dt)
        )
        return values, steps, before, derived, np.asarray(read.commands, np.float64)

    def judged(self, R2: Floats) -> NDArray[np.intp]:
        """Return which values are judged, by their cross-fitted R² (X,)."""
        place = {int(column): k for k, column in enumerate(self.spec.sensory)}
        judged = R2 > PREDICTED
        loads, moves = ([place[int(i)] for i in found] for found in (forces(self.spec), motion(self.spec)))
        if loads and moves:
            judged[moves] = False
            judged[loads] = True
        return np.flatnonzero(judged)

    def _farther(self, inputs: Floats) -> Floats:
        """Return the factors (N, V) of the spreads of judged values, for inputs (N, I)."""
        found = np.ones((len(inputs), len(self._values)))
        groups = self.senses_.groups[self._values]
        for group, far in zip(np.unique(groups), self.learned_.get("far", ()), strict=False):
            found[:, groups == group] = np.sqrt(np.maximum(1.0, ((inputs @ far) * inputs).sum(axis=1)))[:, None]
        return found

    def _own(self) -> list[NDArray[np.intp]]:
        """Return the inputs of each group that hold its own values, which it is not predicted from."""
        X, groups = len(self.spec.sensory), self.senses_.groups
        found = []
        for g in range(int(groups.max()) + 1):
            own = np.flatnonzero(groups == g)
            derived = 3 * X + np.flatnonzero(self._derived.sources[:, own].any(axis=1))
            withheld = [own, X + own, derived, 2 * X + np.arange(X)]  # a value is predicted from this row alone
            found.append(np.unique(np.concatenate(withheld)).astype(np.intp))
        return found


def _folds(lengths: Sequence[int]) -> NDArray[np.intp]:
    """Return the fold (N,) of each row: whole episodes, or blocks where they are few."""
    if len(lengths) >= FOLDS:
        return np.repeat(np.arange(len(lengths)) % FOLDS, lengths)
    blocks: NDArray[np.intp] = np.arange(sum(lengths), dtype=np.intp) * FOLDS // max(sum(lengths), 1)
    return blocks


def _crossfitted(
    inputs: Floats, targets: Floats, fold: NDArray[np.intp], groups: NDArray[np.intp], own: list[NDArray[np.intp]]
) -> _Fitted:
    """Return weights by the penalty that leaves the least in rows of other folds, and what it leaves there."""
    N, size = inputs.shape
    weights, left, R2 = np.zeros((targets.shape[1], size)), np.zeros(targets.shape[1]), np.zeros(targets.shape[1])
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
        R2[mine] = 1.0 - left[mine] ** 2 / np.maximum(variance, FAINTEST**2)
        whole = gram[np.ix_(used, used)] / N
        for n in np.unique(best):
            solved = np.linalg.solve(whole + PENALTIES[n] * np.eye(len(used)), cross[np.ix_(used, mine)] / N)
            for k in np.flatnonzero(best == n):
                weights[mine[k], used] = solved[:, k]
    return _Fitted(weights, left, R2)


def _far(inputs: Floats, fold: NDArray[np.intp], withheld: NDArray[np.intp]) -> Floats:
    """Return the matrix (I, I) with which zᵀ far z is h/h̃ for inputs z."""
    size = inputs.shape[1]
    found = np.zeros((size, size))
    used = np.setdiff1d(np.arange(size), withheld)
    h = np.zeros(len(inputs))
    for f in np.unique(fold):
        tested = inputs[fold == f][:, used]
        h[fold == f] = ((tested @ _inverse(inputs[fold != f][:, used])) * tested).sum(axis=1)
    found[np.ix_(used, used)] = _inverse(inputs[:, used]) / np.median(h)
    return found


def _inverse(inputs: Floats) -> Floats:
    """Return (ZᵀZ/N + λ)⁻¹ of inputs Z (N, I)."""
    found: Floats = np.linalg.inv(inputs.T @ inputs / max(len(inputs), 1) + STIFFNESS * np.eye(inputs.shape[1]))
    return found
