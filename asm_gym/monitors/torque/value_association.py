r"""Ridge regression of values: each group of senses from the values and changes of the others, without its own past.

    x̂_g,t = D_g [x_{¬g,t}, Δ_{¬g,t}, φ_{¬g,t}, u_t, 1]       judged: torques, and what a cross-fitted R² of 1/2 tells
    φ      friction and weight, see ``arm_features``
    r_t    = (x_t - x̂_t) / σ_t √max(1, h/h̃)
    ε_t    = (r_t + … + r_{t-w+1}) / w q                      w: rows of a tenth of a second
    q      the largest |r_t + … + r_{t-w+1}| / w of each x in nominal episodes, cross-fitted
    h, h̃   leverage and its cross-fitted median, see ``crossfitting``
    σ      of a torque, by the speed of its joint, see ``speed_precision``; 1 of other values

A push that is held is explained after one step where a value is predicted from its own last one; where it is predicted
from the others, it is not. A torque is always judged; positions and speeds, beside torques, are left to their changes,
for no other sense predicts where an arm may go. Where few rows were learned from, h is large and an error counts for
less.
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
from asm_gym.monitors.monitor_protocol import Progress
from asm_gym.monitors.stream_model import (
    ScaledModel,
    no_context,
    read_next,
    require_arrays,
    rows_after,
)
from asm_gym.monitors.torque.arm_features import (
    WIDTHS,
    ArmFeatures,
    PhysicalRows,
    motion_columns,
    torque_columns,
)
from asm_gym.monitors.torque.body_model import BodyModel
from asm_gym.monitors.torque.crossfitting import (
    LEAST_REMAINDER,
    CrossFit,
    FoldEquations,
    Leverage,
    folds_of,
    quadratic_form,
)
from asm_gym.monitors.torque.regression_inputs import InputColumns, RegressionRows, inputs_of
from asm_gym.monitors.torque.speed_precision import (
    episode_means,
    running_mean,
    speed_weights,
    usual_errors,
)
from asm_gym.scaling import ScaledRows, rows_apart
from asm_gym.spec import StreamSpec
from asm_gym.validation import typed

Floats = NDArray[np.float64]
Places = NDArray[np.intp]

ALIKE_S = 0.1  # time that errors are averaged over [s]
NOTICEABLE = 0.99  # share of what is left without a body model, below which it is used
PREDICTED = 0.5  # R² from which on a value is judged
# With more inputs no leverage is computed: the matrices would be too large.
MOST_LEVERAGE_INPUTS = 1024

LEARNED = (
    "derived_mean",  # (M,) of the features φ
    "derived_spread",  # (M,)
    "body",  # (J,) the column of each joint of the body model; empty where none is used
    "judged_values",  # (V,) of the X values
    "R2_values",  # (X,) cross-fitted
    "D",  # (V, I)
    "largest",  # (V,) q
    "far",  # (K, I, I) leverage by each set of inputs; of none with very many inputs
    "far_of",  # (V,) which set of inputs a value is predicted from
)


class AveragedErrors(NamedTuple):
    """State of B streams; never changed in place."""

    history: RowHistory
    errors: Floats  # (B, w, V) r, the newest last; 0 where nothing could be predicted


class FeatureFit(NamedTuple):
    """Regression on the features of an arm."""

    features: ArmFeatures
    mean: Floats  # (M,) of the features
    spread: Floats  # (M,)
    regression: CrossFit


class ValueAssociation(ScaledModel):
    """Ridge regression of values; it has no context. Where nothing predicts a value, all are judged.

    A torque is predicted by a model of the arm: friction of its joint, weight and inertia, all linear. All other senses
    predict it where they leave less than half of the squared error of held-out rows. A body model, the text ``urdf`` as
    ``read_urdf`` reads it, counts where it explains held-out torques better: ``left_by_body`` is what is left with it,
    as a share of what is left without it. Where columns do not name its joints, they are taken in the order that
    explains the torques best.
    """

    kind = "association_values"
    held_out = 0  # what it learns of errors is cross-fitted

    @typed
    def __init__(self, spec: StreamSpec, urdf: str = "") -> None:
        super().__init__(spec, rows_apart(spec.dt))
        self.urdf = urdf
        self.window = max(1, round(ALIKE_S / spec.dt))
        self.left_by_body = math.nan
        self._by_sines = ArmFeatures.of(spec)
        self._by_body = ArmFeatures.of(spec, urdf)
        self._features = self._by_body
        self._torques = np.searchsorted(spec.sensory, torque_columns(spec))

    @property
    def error_columns(self) -> Places:
        if not self.learned_:
            return self.spec.sensory
        return self.spec.sensory[self._judged]

    @property
    def body(self) -> BodyModel | None:
        """The body model in use."""
        return self._features.body

    @property
    def joints(self) -> list[tuple[str, str]]:
        """The angles that a body model is told, and the joint that each is taken for, whether it is used or not."""
        body = self.body or self._by_body.body
        if body is None:
            return []
        joint_of = dict(zip(body.columns.tolist(), body.names, strict=True))
        sensed = self.spec.sensory[self._features.angles]
        return [(self.spec.labels[sensed[k]], joint_of[k]) for k in sorted(joint_of)]

    def fit(
        self, episodes: Sequence[Episode], rng: np.random.Generator, progress: Progress
    ) -> Self:
        rows = self._regression_rows(rows_after(self.lag, self.read_nominal(episodes)))
        lengths = [len(episode) - self.lag for episode in episodes]
        fit = self._best_fit(rows, folds_of(lengths))
        regression = fit.regression
        judged = self.judged(regression.R2)
        if not len(judged):
            judged = np.arange(len(self.spec.sensory))
        errors, matrices, matrix_of = self._weighed_errors(fit, judged)
        columns: Places = np.zeros(0, np.intp)
        if fit.features.body is not None:
            columns = fit.features.body.columns
        squares = self._friction_squares(rows, judged)
        by_speed = speed_weights(episode_means(errors, lengths, self.window), squares)
        errors /= usual_errors(by_speed, squares)
        largest = np.abs(episode_means(errors, lengths, self.window)).max(axis=0)
        progress(1, 1)
        learned = {
            "derived_mean": fit.mean,
            "derived_spread": fit.spread,
            "body": columns.astype(np.float64),
            "judged_values": judged.astype(np.float64),
            "R2_values": regression.R2,
            "by_speed": by_speed,
            "D": regression.weights[judged],
            "largest": np.maximum(largest, LEAST_REMAINDER),
            "far": matrices,
            "far_of": matrix_of.astype(np.float64),
        }
        return self.restore({**self.senses_.arrays, **learned})

    def restore(self, learned: Arrays, skills: tuple[str, ...] = ()) -> Self:
        require_arrays(learned, LEARNED)
        self._judged = learned["judged_values"].astype(np.intp)
        self._by_speed = learned.get("by_speed")
        self._features = self._by_sines
        columns = learned["body"].astype(np.intp)
        body = self._by_body.body
        if len(columns) and body is not None:
            self._features = replace(self._by_body, body=replace(body, columns=columns))
        return super().restore(learned, skills)

    def start(self, batch: int) -> AveragedErrors:
        errors = np.zeros((batch, self.window, len(self._judged)))
        return AveragedErrors(super().start(batch), errors)

    def predict(self, state: AveragedErrors, rows: Floats) -> tuple[AveragedErrors, ModelOutput]:
        history, reading, known = read_next(self.senses_, state.history, rows)
        error = self._errors(reading, known)
        errors = np.concatenate([state.errors[:, 1:], error[:, None]], axis=1)
        return AveragedErrors(history, errors), self._output(errors.mean(axis=1))

    def predict_stretch(self, reading: ScaledRows, known: NDArray[np.float32]) -> ModelOutput:
        """Return what ``predict`` returns for T rows of one stream, in one piece.

        Args:
            reading: the rows.
            known: (T, 1) of ``stretches``.
        """
        return self._output(running_mean(self._errors(reading, known), self.window))

    def _output(self, means: Floats) -> ModelOutput:
        """Return the errors for means (N, V) of the last rows."""
        return ModelOutput(means / self.learned_["largest"], no_context(means))

    def _errors(self, reading: ScaledRows, known: NDArray[np.float32]) -> Floats:
        """Return r (N, V) of rows; 0 of those that are not ``known`` (N, 1)."""
        learned = self.learned_
        scaled = self._regression_rows(reading)
        features = self._features(self._physical(scaled))
        standardised = (features - learned["derived_mean"]) / learned["derived_spread"]
        inputs = inputs_of(scaled, standardised)

        expected = inputs @ learned["D"].T
        rest = scaled.values[:, self._judged] - expected
        usual = self._widening(inputs)
        if self._by_speed is not None:
            usual *= usual_errors(self._by_speed, self._friction_squares(scaled, self._judged))
        return np.asarray(known * rest / usual)

    def _friction_squares(self, rows: RegressionRows, judged: Places) -> Floats:
        """Return squares of friction (N, V, W) of the joints of judged torques; 0 of other values."""
        squares = np.zeros((len(rows.values), len(judged), len(WIDTHS)))
        if len(self._torques) != len(self._by_sines.speeds):
            return squares
        _, places, joints = np.intersect1d(judged, self._torques, return_indices=True)
        signs = self._by_sines.friction(self._physical(rows))
        squares[:, places] = np.stack(signs, axis=2)[:, joints] ** 2
        return squares

    def judged(self, R2: Floats) -> Places:
        """Return which values are judged, by their cross-fitted R² (X,)."""
        is_judged = R2 > PREDICTED
        positions_and_speeds = np.searchsorted(self.spec.sensory, motion_columns(self.spec))
        if len(self._torques) and len(positions_and_speeds):
            is_judged[positions_and_speeds] = False
            is_judged[self._torques] = True
        return np.flatnonzero(is_judged)

    def _regression_rows(self, reading: ScaledRows) -> RegressionRows:
        """Return rows as regression reads them."""
        sensory = self.spec.sensory
        values = reading.senses[:, : len(sensory)]
        changes = reading.inputs[:, self.senses_.changes]
        return RegressionRows(
            values=values.astype(np.float64),
            changes=changes.astype(np.float64),
            before=reading.inputs[:, sensory].astype(np.float64),
            commands=reading.commands.astype(np.float64),
        )

    def _physical(self, rows: RegressionRows) -> PhysicalRows:
        """Return rows in the units of their senses."""
        sensory = self.spec.sensory
        spread = self.senses_.spread[sensory]
        return PhysicalRows(
            values=rows.values * spread + self.senses_.mean[sensory],
            changes=rows.changes,
            spread=spread,
            rate=self.senses_.change[sensory] / (self.lag * self.spec.dt),
        )

    def _best_fit(self, rows: RegressionRows, fold: Places) -> FeatureFit:
        """Return the fit by sines; or by sines and body model, where that leaves less of the torques."""
        by_sines = self._fit_on(self._by_sines, rows, fold)
        if not self.urdf:
            return by_sines
        by_body = self._fit_on(self._ordered_body(rows), rows, fold)
        left_by_sines = max(self._unexplained(by_sines), LEAST_REMAINDER)
        self.left_by_body = self._unexplained(by_body) / left_by_sines
        if self.left_by_body < NOTICEABLE:
            return by_body
        return by_sines

    def _unexplained(self, fit: FeatureFit) -> float:
        """Return the share of each torque's variance that is left, summed over torques."""
        shares = 1.0 - fit.regression.R2[self._torques]
        return float(shares.sum())

    def _ordered_body(self, rows: RegressionRows) -> ArmFeatures:
        """Return the features by the body model, with its joints in the order that explains the torques best."""
        features = self._by_body
        body = features.body
        assert body is not None
        if body.by_name or len(self._torques) != len(features.angles):
            return features
        physical = self._physical(rows)
        torque = physical.values[:, self._torques]
        ordered = body.in_best_order(features.motion(physical), torque)
        return replace(features, body=ordered)

    def _fit_on(self, features: ArmFeatures, rows: RegressionRows, fold: Places) -> FeatureFit:
        """Return the regression of rows on the features of an arm; ``fold`` is (N,)."""
        derived = features(self._physical(rows))
        mean = derived.mean(axis=0)
        spread = np.maximum(derived.std(axis=0), LEAST_REMAINDER)
        inputs = inputs_of(rows, (derived - mean) / spread)
        check_inputs(inputs.shape[1])
        columns = InputColumns.of(
            senses=rows.values.shape[1],
            features=derived.shape[1],
            commands=rows.commands.shape[1],
        )
        groups = self.senses_.groups
        regression = CrossFit(
            FoldEquations.of(inputs, rows.values, fold),
            by_arm=self._arms_by_torque(features, columns),
            groups=groups,
            withheld=columns.withheld(groups, features),
        )
        return FeatureFit(features, mean, spread, regression)

    def _arms_by_torque(
        self, features: ArmFeatures, columns: InputColumns
    ) -> dict[int, list[Places]]:
        """Return the sets of inputs that model the arm at each torque.

        There are none where torques, speeds and angles of a body model do not belong together one by one.
        """
        joints = len(features.speeds)
        if len(self._torques) != joints:
            return {}
        if features.body is not None and len(features.angles) != joints:
            return {}
        return dict(zip(self._torques.tolist(), columns.of_joints(features), strict=True))

    def _weighed_errors(self, fit: FeatureFit, judged: Places) -> tuple[Floats, Floats, Places]:
        """Weigh cross-fitted errors by leverage.

        Returns:
            (N, V) errors, less where leverage is large; (K, I, I) leverage by each set of inputs; and (V,) which of
            these sets a value is predicted from.
        """
        regression = fit.regression
        size = regression.weights.shape[1]
        errors = regression.errors[:, judged]  # a copy
        matrix_of = np.zeros(len(judged), np.intp)
        if size > MOST_LEVERAGE_INPUTS:
            return errors, np.zeros((0, size, size)), matrix_of
        leverages: dict[bytes, Leverage] = {}
        for n, value in enumerate(judged):
            used = regression.used[value]
            key = used.tobytes()
            if key not in leverages:
                leverages[key] = regression.equations.leverage(used)
            errors[:, n] /= leverages[key].widening
            matrix_of[n] = list(leverages).index(key)
        matrices = [leverage.matrix for leverage in leverages.values()]
        return errors, np.array(matrices), matrix_of

    def _widening(self, inputs: Floats) -> Floats:
        """Return √max(1, h/h̃) (N, V) of judged values, for inputs (N, I)."""
        matrices = self.learned_["far"]
        if not len(matrices):  # the inputs are very many
            return np.ones((len(inputs), len(self._judged)))
        by_matrix = np.stack([quadratic_form(inputs, matrix) for matrix in matrices], axis=1)
        leverage = by_matrix[:, self.learned_["far_of"].astype(np.intp)]
        return np.sqrt(np.maximum(1.0, leverage))
