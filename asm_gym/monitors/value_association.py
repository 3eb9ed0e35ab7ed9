r"""Ridge regression of values: each group of senses from the values and changes of the others, without its own past.

    x̂_g,t = D_g [x_{¬g,t}, Δ_{¬g,t}, φ_{¬g,t}, u_t, 1]       judged: torques, and what a cross-fitted R² of 1/2 tells
    φ      friction and weight, see ``arm_inputs``
    r_t    = (x_t - x̂_t) / √max(1, h/h̃)
    ε_t    = (r_t + … + r_{t-w+1}) / w q                      w: rows of a tenth of a second
    q      the largest |r_t + … + r_{t-w+1}| / w of each x in nominal episodes, cross-fitted
    h      = zᵀ (ZᵀZ/N + λ)⁻¹ z,  h̃ its cross-fitted median    z: what x is expected from

A push that is held is explained after one step where a value is predicted from its own last one; where it is predicted
from the others, it is not. A torque is always judged; positions and speeds, beside torques, are left to their changes,
for no other sense predicts where an arm may go. Where few rows were learned from, h is large and an error counts for
less. Penalties, q, R² and h̃ come from five folds over episodes, or over blocks of a long one.

Sources: Hoerl and Kennard 1970; for h, the leverage: Hoaglin and Welsch 1978 (The American Statistician 32).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from asm_gym.data.episode import Episode
from asm_gym.detection import ModelOutput
from asm_gym.detection.base import Arrays
from asm_gym.memory.linear_association import check_inputs
from asm_gym.memory.temporal import RowHistory
from asm_gym.monitors.arm_inputs import WIDTHS, Derived, forces, motion
from asm_gym.monitors.base import Progress
from asm_gym.monitors.body_model import BodyModel
from asm_gym.monitors.stream_model import ScaledModel, no_context, read_next
from asm_gym.scaling import ScaledRows, StreamScaler, rows_apart
from asm_gym.spec import StreamSpec
from asm_gym.validation import typed

Floats = NDArray[np.float64]

FOLDS = 5
PENALTIES = (1e-4, 1e-3, 1e-2, 1e-1, 1.0)  # of standardised inputs
ALIKE_S = 0.1  # time that errors are averaged over [s]
PREDICTED = 0.5  # R² from which on a value is judged
FAINTEST = 1e-4  # least spread of what is left of a standardised number
STIFFNESS = 1e-3  # λ
MOST_INPUTS = 1024  # with more inputs no leverage is computed: the matrices would be too large


class _Fitted(NamedTuple):
    inputs: Floats  # (N, I)
    scale: tuple[Floats, Floats]  # mean and spread of the derived ones
    grams: Floats  # (FOLDS + 1, I, I) see ``_equations``
    own: list[NDArray[np.intp]]  # of each group the inputs that it is not predicted from
    weights: Floats  # (X, I)
    left: Floats  # (N, X) cross-fitted errors
    R2: Floats  # (X,) cross-fitted
    alone: Floats  # (X,) 1 where a value is predicted from its joint alone


class _Read(NamedTuple):
    values: Floats  # (N, X)
    steps: Floats  # (N, X) changes
    before: Floats  # (N, X) values l rows before
    commands: Floats  # (N, A + 1) with a 1


class Averaged(NamedTuple):
    """State of B streams; never changed in place."""

    history: RowHistory
    left: Floats  # (B, w, V) r, the newest last; 0 where nothing could be predicted


class ValueAssociation(ScaledModel):
    """Ridge regression of values; it has no context. Where nothing predicts a value, all are judged.

    A body model, the text ``urdf`` as ``read_urdf`` reads it, takes the place of sines where it explains held-out
    torques better: ``left_by_body`` is what it leaves, as a share of what is left without it. Where columns do not name
    its joints, they are taken in the order that explains the torques best.
    """

    kind = "association_values"
    held_out = 0  # what it learns of errors is cross-fitted

    @typed
    def __init__(self, spec: StreamSpec, urdf: str = "") -> None:
        super().__init__(spec, rows_apart(spec.dt))
        self.urdf = urdf
        self.window = max(1, round(ALIKE_S / spec.dt))
        self.left_by_body = math.nan
        self._derived = self._told = Derived.of(spec, urdf)
        self._loads = np.searchsorted(spec.sensory, forces(spec))

    @property
    def error_columns(self) -> NDArray[np.intp]:
        if not self.learned_:
            return self.spec.sensory
        return self.spec.sensory[self._values]

    @property
    def links(self) -> BodyModel | None:
        """The body model in use."""
        return self._derived.links

    @property
    def joints(self) -> list[tuple[str, str]]:
        """The angles that a body model is told, and the joint that each is taken for."""
        if self.links is None:
            return []
        labels = [self.spec.labels[self.spec.sensory[i]] for i in self._derived.angles]
        order = np.argsort(self.links.columns)
        return [(labels[self.links.columns[k]], self.links.names[k]) for k in order]

    def fit(
        self, episodes: Sequence[Episode], rng: np.random.Generator, progress: Progress
    ) -> Self:
        streams = [e.stream for e in episodes]
        senses = self.senses_ = StreamScaler.fit(self.spec, streams, self.lag)
        parts = [
            [a[self.lag :] for a in self._read(senses.read_episode(stream))] for stream in streams
        ]
        lengths = [len(part[0]) for part in parts]
        read, fold = (
            _Read(*(np.concatenate(part) for part in zip(*parts, strict=True))),
            _folds(lengths),
        )
        self._derived = Derived.of(self.spec)
        given = self._fitted(read, fold)
        if self.urdf:
            alone, self._derived = self._derived, self._ordered(read)
            by_body = self._fitted(read, fold)
            left, before = ((1.0 - found.R2[self._loads]).sum() for found in (by_body, given))
            self.left_by_body = float(left / max(before, FAINTEST))
            if self.left_by_body < 1.0:
                given = by_body
            else:
                self._derived = alone
        judged = self.judged(given.R2)
        judged = judged if len(judged) else np.arange(len(given.R2))
        judging = np.unique(senses.groups[judged]) if given.inputs.shape[1] <= MOST_INPUTS else ()
        far, errors = [], given.left[:, judged]
        for g in judging:
            matrix, factor = _far(given, fold, given.own[g])
            far.append(matrix)
            errors[:, (senses.groups[judged] == g) & (given.alone[judged] == 0)] /= factor[:, None]
        ends = np.cumsum(lengths)[:-1]
        largest = [
            np.abs(averaged(part, self.window)).max(axis=0) for part in np.split(errors, ends)
        ]
        progress(1, 1)
        learned = {
            "derived_mean": given.scale[0],
            "derived_spread": given.scale[1],
            "body": np.zeros(0)
            if self._derived.links is None
            else self._derived.links.columns * 1.0,
            "judged_values": judged * 1.0,
            "R2_values": given.R2,
            "D": given.weights[judged],
            "joint_alone": given.alone[judged],
            "largest": np.maximum(np.max(largest, axis=0), FAINTEST),
            "far": np.array(far).reshape(len(far), *given.inputs.shape[1:] * 2),
        }
        return self.restore({**senses.arrays, **learned})

    def restore(self, learned: Arrays, skills: tuple[str, ...] = ()) -> Self:
        self._values = learned["judged_values"].astype(np.intp)
        self._derived = Derived.of(self.spec)
        if len(learned["body"]) and self._told.links is not None:
            links = replace(self._told.links, columns=learned["body"].astype(np.intp))
            self._derived = self._told._replace(links=links)
        return super().restore(learned, skills)

    def start(self, batch: int) -> Averaged:
        return Averaged(super().start(batch), np.zeros((batch, self.window, len(self._values))))

    def predict(self, state: Averaged, rows: NDArray[np.float64]) -> tuple[Averaged, ModelOutput]:
        history, read, known = read_next(self.senses_, state.history, rows)
        scaled, found = self._read(read), self.learned_
        derived = (self._derived(*self._physical(scaled)) - found["derived_mean"]) / found[
            "derived_spread"
        ]
        inputs = np.hstack([*scaled[:3], derived, scaled.commands])
        now = (
            known * (scaled.values[:, self._values] - inputs @ found["D"].T) / self._farther(inputs)
        )
        left = np.concatenate([state.left[:, 1:], now[:, None]], axis=1)
        return Averaged(history, left), ModelOutput(
            left.mean(axis=1) / found["largest"], no_context(rows)
        )

    def _read(self, read: ScaledRows) -> _Read:
        X = len(self.spec.sensory)
        found = (
            read.senses[:, :X],
            read.inputs[:, self.senses_.changes],
            read.inputs[:, self.spec.sensory],
        )
        return _Read(*(np.asarray(a, np.float64) for a in (*found, read.commands)))

    def _physical(self, read: _Read) -> tuple[Floats, Floats, Floats, Floats]:
        """Return values (N, X) and standardised changes (N, X), and the spread and rate (X,) that these are of."""
        senses, sensory = self.senses_, self.spec.sensory
        spread, rate = senses.spread[sensory], senses.change[sensory] / (self.lag * self.spec.dt)
        return read.values * spread + senses.mean[sensory], read.steps, spread, rate

    def _ordered(self, read: _Read) -> Derived:
        """Return what the body model derives, with its joints in the order that explains the torques best."""
        told, physical = self._told, self._physical(read)
        assert told.links is not None
        if told.links.by_name or len(self._loads) != len(told.angles):
            return told
        return told._replace(
            links=told.links.in_best_order(*told.motion(*physical), physical[0][:, self._loads])
        )

    def _fitted(self, read: _Read, fold: NDArray[np.intp]) -> _Fitted:
        """Return weights by the penalty that leaves the least in rows of other folds, and what it leaves there.

        A torque is predicted from the inputs of its own joint alone, where that leaves less.
        """
        derived = self._derived(*self._physical(read))
        middle, width = derived.mean(axis=0), np.maximum(derived.std(axis=0), FAINTEST)
        z, x, every = (
            np.hstack([*read[:3], (derived - middle) / width, read.commands]),
            read.values,
            self._own(),
        )
        check_inputs(z.shape[1])
        (N, size), X = z.shape, x.shape[1]
        grams, crosses = _equations(z, x, fold)

        def solved(
            f: int, used: NDArray[np.intp], mine: NDArray[np.intp], penalty: float
        ) -> Floats:
            gram = grams[f][np.ix_(used, used)] + penalty * np.eye(len(used))
            return np.linalg.solve(gram, crosses[f][np.ix_(used, mine)])  # (U, M)

        def unseen(used: NDArray[np.intp], mine: NDArray[np.intp], penalty: float) -> Floats:
            errors = x[:, mine].copy()  # (N, M)
            for f in range(FOLDS):
                errors[fold == f] -= z[fold == f][:, used] @ solved(f, used, mine, penalty)
            return errors

        weights, left, alone = np.zeros((X, size)), np.zeros((N, X)), np.zeros(X)
        for k, used in self._joint_inputs(size).items():
            one = np.array([k])
            left[:, one], alone[k] = unseen(used, one, PENALTIES[0]), 1.0
            weights[k, used] = solved(FOLDS, used, one, PENALTIES[0])[:, 0]
        for g, own in enumerate(every):
            mine, used = (
                np.flatnonzero(self.senses_.groups == g),
                np.setdiff1d(np.arange(size), own),
            )
            errors = np.array([unseen(used, mine, penalty) for penalty in PENALTIES])  # (P, N, M)
            squares = (errors**2).sum(axis=1)
            better = squares.min(axis=0) < np.where(
                alone[mine] > 0, (left[:, mine] ** 2).sum(axis=0), np.inf
            )
            for n, penalty in enumerate(PENALTIES):
                taken = np.flatnonzero(better & (squares.argmin(axis=0) == n))
                if len(taken):
                    left[:, mine[taken]], alone[mine[taken]], weights[mine[taken]] = (
                        errors[n][:, taken],
                        0.0,
                        0.0,
                    )
                    weights[np.ix_(mine[taken], used)] = solved(FOLDS, used, mine[taken], penalty).T
        R2 = 1.0 - (left**2).mean(axis=0) / np.maximum(x.var(axis=0), FAINTEST**2)
        return _Fitted(z, (middle, width), grams, every, weights, left, R2, alone)

    def _joint_inputs(self, size: int) -> dict[int, NDArray[np.intp]]:
        """Return the inputs, of ``size``, of each torque's own joint: its speed, friction and body, and commands."""
        X, derived = len(self.spec.sensory), self._derived
        S, J = len(derived.speeds), len(derived.angles)
        if len(self._loads) != S or (derived.links is not None and J != S):
            return {}
        bodies = 0 if derived.links is None else 2  # weight and motion
        first = 3 * X + S * np.arange(len(WIDTHS) + bodies)  # of each kind of input
        commands = np.arange(size - len(self.spec.motor) - 1, size)
        speed = derived.speeds + (X if derived.from_steps else 0)
        return {
            int(k): np.concatenate([[speed[n]], first + n, commands])
            for n, k in enumerate(self._loads)
        }

    def judged(self, R2: Floats) -> NDArray[np.intp]:
        """Return which values are judged, by their cross-fitted R² (X,)."""
        judged, moves = R2 > PREDICTED, np.searchsorted(self.spec.sensory, motion(self.spec))
        if len(self._loads) and len(moves):
            judged[moves] = False
            judged[self._loads] = True
        return np.flatnonzero(judged)

    def _farther(self, inputs: Floats) -> Floats:
        """Return the factors (N, V) of the spreads of judged values, for inputs (N, I)."""
        found, learned = np.ones((len(inputs), len(self._values))), self.learned_
        groups = np.where(learned["joint_alone"] > 0, -1, self.senses_.groups[self._values])
        for group, far in zip(
            np.unique(self.senses_.groups[self._values]), learned["far"], strict=False
        ):
            found[:, groups == group] = np.sqrt(np.maximum(1.0, squares(inputs, far)))[:, None]
        return found

    def _own(self) -> list[NDArray[np.intp]]:
        """Return the inputs of each group that hold its own values, which it is not predicted from."""
        X, groups = len(self.spec.sensory), self.senses_.groups
        found = []
        for g in range(int(groups.max()) + 1):
            own = np.flatnonzero(groups == g)
            derived = 3 * X + np.flatnonzero(self._derived.sources[:, own].any(axis=1))
            # a value is predicted from this row alone
            withheld = [
                own,
                X + own,
                derived,
                2 * X + np.arange(X),
            ]
            found.append(np.unique(np.concatenate(withheld)).astype(np.intp))
        return found


def _folds(lengths: Sequence[int]) -> NDArray[np.intp]:
    """Return the fold (N,) of each row: whole episodes, or blocks where they are few."""
    if len(lengths) >= FOLDS:
        return np.repeat(np.arange(len(lengths)) % FOLDS, lengths)
    return np.arange(sum(lengths), dtype=np.intp) * FOLDS // max(sum(lengths), 1)


def _equations(z: Floats, x: Floats, fold: NDArray[np.intp]) -> tuple[Floats, Floats]:
    """Return ZᵀZ/N and ZᵀX/N without the rows of each fold, and of all rows at last (FOLDS + 1, I, …)."""
    found, rows = [], np.append(len(z) - np.bincount(fold, minlength=FOLDS), len(z))
    for of in (z, x):
        each = np.array([z[fold == f].T @ of[fold == f] for f in range(FOLDS)])
        total = each.sum(axis=0)
        found.append(np.array([*(total - each), total]) / np.maximum(rows, 1)[:, None, None])
    return found[0], found[1]


def averaged(left: Floats, window: int) -> Floats:
    """Return the mean (T, V) of the last rows of errors (T, V) of an episode; before the first they are 0."""
    total = np.cumsum(np.vstack([np.zeros((window, left.shape[1])), left]), axis=0)
    return (total[window:] - total[:-window]) / window


def _far(
    given: _Fitted, fold: NDArray[np.intp], withheld: NDArray[np.intp]
) -> tuple[Floats, Floats]:
    """Return the matrix (I, I) with which zᵀ far z is h/h̃ for inputs z, and the cross-fitted √max(1, h/h̃) (N,)."""
    size, found, h = given.inputs.shape[1], np.zeros_like(given.grams[0]), np.zeros(len(fold))
    used = np.setdiff1d(np.arange(size), withheld)
    *unseen, of_all = (inverse(gram[np.ix_(used, used)]) for gram in given.grams)
    for f, matrix in enumerate(unseen):
        h[fold == f] = squares(given.inputs[fold == f][:, used], matrix)
    found[np.ix_(used, used)] = of_all / np.median(h)
    return found, np.sqrt(np.maximum(1.0, h / np.median(h)))


def inverse(gram: Floats) -> Floats:
    """Return (ZᵀZ/N + λ)⁻¹ of ZᵀZ/N (I, I)."""
    return np.linalg.inv(gram + STIFFNESS * np.eye(len(gram))).astype(np.float64)


def squares(z: Floats, matrix: Floats) -> Floats:
    """Return zᵀ M z of each row (N,)."""
    return ((z @ matrix) * z).sum(axis=1)
