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
from collections.abc import Iterator, Mapping, Sequence
from typing import NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from asm_gym.data.episode import Episode
from asm_gym.detection import ModelOutput
from asm_gym.detection.base import Arrays
from asm_gym.memory.linear import check_inputs
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
    weights: Floats  # (X, I)
    left: Floats  # (N, X) cross-fitted errors
    R2: Floats  # (X,) cross-fitted
    alone: Floats  # (X,) 1 where a value is predicted from its joint alone


class _Normal(NamedTuple):
    """Normal equations of each fold of rows, and of all."""

    fold: NDArray[np.intp]  # (N,)
    grams: Floats  # (FOLDS, I, I)
    crosses: Floats  # (FOLDS, I, X)

    @classmethod
    def of(cls, inputs: Floats, targets: Floats, fold: NDArray[np.intp]) -> Self:
        parts = [(inputs[fold == f], targets[fold == f]) for f in range(FOLDS)]
        return cls(fold, np.array([z.T @ z for z, _ in parts]), np.array([z.T @ x for z, x in parts]))

    def weights(self, used: NDArray[np.intp], mine: NDArray[np.intp], penalty: float) -> Floats:
        """Return the weights (U, M) of the used inputs for some targets."""
        N = len(self.fold)
        gram, cross = self.grams.sum(axis=0)[np.ix_(used, used)], self.crosses.sum(axis=0)[np.ix_(used, mine)]
        found: Floats = np.linalg.solve(gram / N + penalty * np.eye(len(used)), cross / N)
        return found

    def left(self, inputs: Floats, targets: Floats, used: NDArray[np.intp], mine: NDArray[np.intp]) -> Iterator[Floats]:
        """Yield the cross-fitted errors (N, M) of some targets, predicted from the used inputs, by each penalty."""
        spectra = []
        for f in range(FOLDS):
            rows = max(int((self.fold != f).sum()), 1)
            gram, cross = (a.sum(axis=0) - a[f] for a in (self.grams, self.crosses))
            values, vectors = np.linalg.eigh(gram[np.ix_(used, used)] / rows)
            spectra.append((np.maximum(values, 0.0)[:, None], vectors, vectors.T @ cross[np.ix_(used, mine)] / rows))
        for penalty in PENALTIES:
            errors = targets[:, mine].copy()
            for f, (values, vectors, projected) in enumerate(spectra):
                errors[self.fold == f] -= inputs[self.fold == f][:, used] @ (vectors @ (projected / (values + penalty)))
            yield errors


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

    A body model is used where it explains held-out torques better than sines of angles do. Where columns do not name
    its joints, they are taken in the order that explains the torques best.

    Args:
        spec: the stream it is to expect.
        urdf: text of a body model, as ``read_urdf`` reads it: what links weigh, and their inertia, in place of sines.

    Attributes:
        left_by_body: what the body model leaves of held-out torques, as a share of what is left without it; the body is
            not used where that is 1 or more. NaN before ``fit``, and without a body model.
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

    @property
    def error_columns(self) -> NDArray[np.intp]:
        if not self.learned_:
            return self.spec.sensory
        columns: NDArray[np.intp] = self.spec.sensory[self._values]
        return columns

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

    def fit(self, episodes: Sequence[Episode], rng: np.random.Generator, progress: Progress) -> Self:
        streams = [e.stream for e in episodes]
        senses = self.senses_ = StreamScaler.fit(self.spec, streams, self.lag)
        lengths = [len(stream) - self.lag for stream in streams]
        parts = [[a[self.lag :] for a in self._read(senses.read_episode(stream))] for stream in streams]
        read = _Read(*(np.concatenate(part) for part in zip(*parts, strict=True)))
        fold = _folds(lengths)
        self._derived = Derived.of(self.spec)
        inputs, scale, own, given = self._predicted(read, fold)
        if self.urdf:
            alone, self._derived = self._derived, self._ordered(read)
            by_body = self._predicted(read, fold)
            loads = self._places(forces(self.spec))
            self.left_by_body = float(
                (1.0 - by_body[-1].R2[loads]).sum() / max((1.0 - given.R2[loads]).sum(), FAINTEST)
            )
            if self.left_by_body < 1.0:
                inputs, scale, own, given = by_body
            else:
                self._derived = alone
        judged = self.judged(given.R2)
        judged = judged if len(judged) else np.arange(len(given.R2))
        judging = np.unique(senses.groups[judged]) if inputs.shape[1] <= MOST_INPUTS else ()
        far, left = [], given.left[:, judged]
        for g in judging:
            matrix, factor = _far(inputs, fold, own[g])
            far.append(matrix)
            left[:, (senses.groups[judged] == g) & (given.alone[judged] == 0)] /= factor[:, None]
        ends = np.cumsum(lengths)[:-1]
        largest = [np.abs(averaged(part, self.window)).max(axis=0) for part in np.split(left, ends)]
        progress(1, 1)
        learned = {
            "derived_mean": scale[0],
            "derived_spread": scale[1],
            "body": np.zeros(0) if self._derived.links is None else self._derived.links.columns * 1.0,
            "judged_values": judged * 1.0,
            "R2_values": given.R2,
            "D": given.weights[judged],
            "joint_alone": given.alone[judged],
            "largest": np.maximum(np.max(largest, axis=0), FAINTEST),
            "far": np.array(far).reshape(len(far), *inputs.shape[1:] * 2),
        }
        return self.restore({**senses.arrays, **learned})

    def restore(self, learned: Arrays, skills: tuple[str, ...] = ()) -> Self:
        self._values = learned["judged_values"].astype(np.intp)
        columns = learned["body"].astype(np.intp)
        self._derived = self._told.with_joints(columns) if len(columns) else Derived.of(self.spec)
        return super().restore(learned, skills)

    def start(self, batch: int) -> Averaged:
        return Averaged(super().start(batch), np.zeros((batch, self.window, len(self._values))))

    def predict(self, state: Averaged, rows: NDArray[np.float64]) -> tuple[Averaged, ModelOutput]:
        history, read, known = read_next(self.senses_, state.history, rows)
        scaled, found = self._read(read), self.learned_
        derived = (self._of(scaled, self._derived) - found["derived_mean"]) / found["derived_spread"]
        inputs = np.hstack([*scaled[:3], derived, scaled.commands])
        now = known * (scaled.values[:, self._values] - inputs @ found["D"].T) / self._farther(inputs)
        left = np.concatenate([state.left[:, 1:], now[:, None]], axis=1)
        return Averaged(history, left), ModelOutput(left.mean(axis=1) / found["largest"], no_context(rows))

    def _read(self, read: ScaledRows) -> _Read:
        X = len(self.spec.sensory)
        found = read.senses[:, :X], read.inputs[:, self.senses_.changes], read.inputs[:, self.spec.sensory]
        return _Read(*(np.asarray(a, np.float64) for a in (*found, read.commands)))

    def _of(self, read: _Read, derived: Derived) -> Floats:
        """Return the derived inputs (N, M)."""
        return derived(*self._physical(read))

    def _physical(self, read: _Read) -> tuple[Floats, Floats, Floats, Floats]:
        """Return values (N, X) and standardised changes (N, X), and the spread and rate (X,) that these are of."""
        senses, sensory = self.senses_, self.spec.sensory
        spread, rate = senses.spread[sensory], senses.change[sensory] / (self.lag * self.spec.dt)
        return read.values * spread + senses.mean[sensory], read.steps, spread, rate

    def _ordered(self, read: _Read) -> Derived:
        """Return what the body model derives, with its joints in the order that explains the torques best."""
        told, loads = self._told, self._places(forces(self.spec))
        assert told.links is not None
        if told.links.by_name or len(loads) != len(told.angles):
            return told
        physical = self._physical(read)
        moved = told.motion(*physical)
        return told.with_joints(told.links.in_best_order(*moved, physical[0][:, loads]).columns)

    def _predicted(
        self, read: _Read, fold: NDArray[np.intp]
    ) -> tuple[Floats, tuple[Floats, Floats], list[NDArray[np.intp]], _Fitted]:
        """Return inputs (N, I), mean and spread of the derived ones, each group's own inputs, and what they predict."""
        derived = self._of(read, self._derived)
        middle, width = derived.mean(axis=0), np.maximum(derived.std(axis=0), FAINTEST)
        inputs = np.hstack([*read[:3], (derived - middle) / width, read.commands])
        check_inputs(inputs.shape[1])
        own = self._own()
        return (
            inputs,
            (middle, width),
            own,
            _crossfitted(inputs, read.values, fold, self.senses_.groups, own, self._joint_inputs(inputs.shape[1])),
        )

    def _joint_inputs(self, size: int) -> dict[int, NDArray[np.intp]]:
        """Return the inputs, of ``size``, of each torque's own joint: its speed, friction and body, and commands."""
        X, derived, loads = len(self.spec.sensory), self._derived, self._places(forces(self.spec))
        S, J = len(derived.speeds), len(derived.angles)
        if len(loads) != S or (derived.links is not None and J != S):
            return {}
        speed = derived.speeds + (X if derived.from_steps else 0)
        parts = [speed, *(3 * X + w * S + np.arange(S) for w in range(len(WIDTHS)))]
        if derived.links is not None:
            parts += [3 * X + len(WIDTHS) * S + n * J + np.arange(J) for n in range(2)]
        commands = np.arange(size - len(self.spec.motor) - 1, size)
        return {k: np.append([part[n] for part in parts], commands).astype(np.intp) for n, k in enumerate(loads)}

    def _places(self, columns: NDArray[np.intp]) -> list[int]:
        """Return the places of columns among the senses."""
        place = {int(column): k for k, column in enumerate(self.spec.sensory)}
        return [place[int(i)] for i in columns]

    def judged(self, R2: Floats) -> NDArray[np.intp]:
        """Return which values are judged, by their cross-fitted R² (X,)."""
        judged = R2 > PREDICTED
        loads, moves = (self._places(found) for found in (forces(self.spec), motion(self.spec)))
        if loads and moves:
            judged[moves] = False
            judged[loads] = True
        return np.flatnonzero(judged)

    def _farther(self, inputs: Floats) -> Floats:
        """Return the factors (N, V) of the spreads of judged values, for inputs (N, I)."""
        found, learned = np.ones((len(inputs), len(self._values))), self.learned_
        groups = np.where(learned["joint_alone"] > 0, -1, self.senses_.groups[self._values])
        for group, far in zip(np.unique(self.senses_.groups[self._values]), learned["far"], strict=False):
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
    inputs: Floats,
    targets: Floats,
    fold: NDArray[np.intp],
    groups: NDArray[np.intp],
    own: list[NDArray[np.intp]],
    joints: Mapping[int, NDArray[np.intp]],
) -> _Fitted:
    """Return weights by the penalty that leaves the least in rows of other folds, and what it leaves there.

    ``own`` are the inputs that each group is not predicted from, ``joints`` those of the joint of a value: a value is
    predicted from these alone where that leaves less.
    """
    (N, size), X = inputs.shape, targets.shape[1]
    fitted = _Fitted(np.zeros((X, size)), np.zeros((N, X)), np.zeros(X), np.zeros(X))
    normal = _Normal.of(inputs, targets, fold)
    for k, used in joints.items():
        errors = next(normal.left(inputs, targets, used, np.array([k])))[:, 0]
        fitted.left[:, k], fitted.alone[k] = errors, 1.0
        fitted.weights[k, used] = normal.weights(used, np.array([k]), PENALTIES[0])[:, 0]
    for g, withheld in enumerate(own):
        mine, used = np.flatnonzero(groups == g), np.setdiff1d(np.arange(size), withheld)
        errors = np.array(list(normal.left(inputs, targets, used, mine)))  # (P, N, X of the group)
        squares = (errors**2).sum(axis=1)
        best, better = (
            squares.argmin(axis=0),
            squares.min(axis=0) < np.where(fitted.alone[mine] > 0, (fitted.left[:, mine] ** 2).sum(axis=0), np.inf),
        )
        for n in np.unique(best[better]):
            taken = np.flatnonzero(better & (best == n))
            fitted.left[:, mine[taken]], fitted.alone[mine[taken]] = errors[n][:, taken], 0.0
            fitted.weights[mine[taken]] = 0.0
            fitted.weights[np.ix_(mine[taken], used)] = normal.weights(used, mine[taken], PENALTIES[n]).T
    return fitted._replace(R2=_explained(fitted.left, targets))


def _explained(left: Floats, targets: Floats) -> Floats:
    """Return R² (X,) of targets (N, X) with errors (N, X)."""
    R2: Floats = 1.0 - (left**2).mean(axis=0) / np.maximum(targets.var(axis=0), FAINTEST**2)
    return R2


def averaged(left: Floats, window: int) -> Floats:
    """Return the mean (T, V) of the last rows of errors (T, V) of an episode; before the first they are 0."""
    total = np.cumsum(np.vstack([np.zeros((window, left.shape[1])), left]), axis=0)
    mean: Floats = (total[window:] - total[:-window]) / window
    return mean


def _far(inputs: Floats, fold: NDArray[np.intp], withheld: NDArray[np.intp]) -> tuple[Floats, Floats]:
    """Return the matrix (I, I) with which zᵀ far z is h/h̃ for inputs z, and the cross-fitted √max(1, h/h̃) (N,)."""
    size = inputs.shape[1]
    found = np.zeros((size, size))
    used = np.setdiff1d(np.arange(size), withheld)
    h = np.zeros(len(inputs))
    for f in np.unique(fold):
        tested = inputs[fold == f][:, used]
        h[fold == f] = ((tested @ _inverse(inputs[fold != f][:, used])) * tested).sum(axis=1)
    found[np.ix_(used, used)] = _inverse(inputs[:, used]) / np.median(h)
    return found, np.sqrt(np.maximum(1.0, h / np.median(h)))


def _inverse(inputs: Floats) -> Floats:
    """Return (ZᵀZ/N + λ)⁻¹ of inputs Z (N, I)."""
    found: Floats = np.linalg.inv(inputs.T @ inputs / max(len(inputs), 1) + STIFFNESS * np.eye(inputs.shape[1]))
    return found
