"""Linear baselines: a Kalman filter, ridge regression, a rule of friction, and the limits in use today.

    Kalman      x_t = A x_{t-1} + B u_t + c + w, w ~ N(0, Q)      y_t = x_t + v, v ~ N(0, R)     ε: innovations
    ridge       ε_t = (Δ_t - D a_t)/s                             D, s, a_t: association without hidden units
    friction    r_j = mean over 0.1 s of τ_j - (c_0 + c_1 v_j + Σ_w c_w tanh(v_j/w s_j))    ε = r_j / spread_j
                with a body model also less c_g g_j + c_m (M q̈ + c)_j, see ``body_model``
    limits      ε = (x - centre) / scale    of channels: force of the wrist [N] less the hand's own weight, the mean
                over nominal episodes; external torque of each joint, from a momentum observer, over its nominal spread

R is the sensor noise that the stream's spec states; A, B, c by ridge regression; Q is what is left of the residuals.
What the memory's hidden units, precision and temporal network are worth is what it finds beyond ``LinearAssociation``.

Sources: Kalman 1960; Mehra and Peschon 1971 (Automatica 7) for faults found in innovations; Hoerl and Kennard 1970;
Will and Grossman 1975 for the guarded move; Haddadin, De Luca and Albu-Schäffer 2017, Eq. 15 and 31, for torques.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple, Self

import numpy as np
import pandas as pd
from numpy.typing import NDArray
from scipy.linalg import LinAlgError, solve_discrete_are

from asm_gym.data.episode import Episode
from asm_gym.detection import ModelOutput
from asm_gym.memory.association import ChangeLayout
from asm_gym.memory.linear_association import check_inputs, learn_linear
from asm_gym.memory.temporal import RowHistory
from asm_gym.monitors.arm_inputs import WIDTHS, Derived, forces, speeds
from asm_gym.monitors.base import Progress
from asm_gym.monitors.stream_model import ScaledModel, StreamModel, no_context, read_next
from asm_gym.scaling import StreamScaler, rows_apart
from asm_gym.spec import StreamSpec
from asm_gym.validation import check_number, typed

FAINTEST = 1e-4  # smallest spread of what is left of a standardised number, and smallest variance of w and v
LEAST_SPREAD = 1e-6  # smallest spread of a channel [its unit]

Floats = NDArray[np.float64]


class _Filtered(NamedTuple):
    estimate: Floats  # (B, X) x̂, standardised
    steps: NDArray[np.int64]  # (B,)


class Kalman(StreamModel):
    """A steady-state Kalman filter; ``ridge`` is the penalty on A, B and c, of the standardised inputs."""

    kind = "kalman"

    @typed
    def __init__(self, spec: StreamSpec, ridge: float = 1e-6) -> None:
        super().__init__(spec)
        self.ridge = check_number("ridge", ridge, low=0.0)

    def fit(
        self, episodes: Sequence[Episode], rng: np.random.Generator, progress: Progress
    ) -> Self:
        check_inputs(self.spec.size + 1)
        streams = [e.stream for e in episodes]
        sensed = [s[:, self.spec.sensory].astype(np.float64) for s in streams]
        rows = np.concatenate(sensed)
        mean, spread = rows.mean(axis=0), np.maximum(rows.std(axis=0), LEAST_SPREAD)
        xs = [(x - mean) / spread for x in sensed]
        before, after = (np.concatenate([x[k : len(x) - 1 + k] for x in xs]) for k in (0, 1))
        u = np.concatenate([s[1:, self.spec.motor] for s in streams]).astype(np.float64)
        Z = np.hstack([before, u, np.ones((len(u), 1))])
        # (X + A + 1, X)
        weights = np.linalg.solve(Z.T @ Z + self.ridge * len(Z) * np.eye(Z.shape[1]), Z.T @ after)
        X = len(self.spec.sensory)
        A, residual = weights[:X].T, after - Z @ weights
        R = np.diag(np.maximum((self.spec.noise[self.spec.sensory] / spread) ** 2, FAINTEST))
        # A residual holds the new measurement's noise and, through A, that of the last.
        excess = residual.T @ residual / len(residual) - R - A @ R @ A.T
        values, vectors = np.linalg.eigh((excess + excess.T) / 2)
        Q = (vectors * np.maximum(values, FAINTEST)) @ vectors.T  # the nearest that is positive
        try:
            P = solve_discrete_are(A.T, np.eye(X), Q, R)
        except (LinAlgError, ValueError):  # an unstable A: trust the measurements
            P = Q + R
        S = P + R
        gain = np.linalg.solve(S.T, P.T).T
        filtered = {"weights": weights, "gain": gain, "deviation": np.sqrt(np.diag(S))}
        return self.restore({"mean": mean, "spread": spread, **filtered})

    def start(self, batch: int) -> _Filtered:
        return _Filtered(np.zeros((batch, len(self.spec.sensory))), np.zeros(batch, np.int64))

    def predict(self, state: _Filtered, rows: Floats) -> tuple[_Filtered, ModelOutput]:
        y = (rows[:, self.spec.sensory] - self.learned_["mean"]) / self.learned_["spread"]
        u = rows[:, self.spec.motor]
        begun = (state.steps > 0)[:, None]
        inputs = np.hstack([state.estimate, np.where(np.isfinite(u), u, 0.0), np.ones((len(u), 1))])
        expected = np.where(
            begun, inputs @ self.learned_["weights"], np.where(np.isfinite(y), y, 0.0)
        )
        innovation: Floats = np.where(np.isfinite(y), y - expected, 0.0)
        estimate = expected + innovation @ self.learned_["gain"].T
        error = innovation / self.learned_["deviation"]
        return _Filtered(estimate, state.steps + 1), ModelOutput(error, no_context(rows))


class LinearAssociation(ScaledModel):
    """Ridge regression of each group's changes; it has no context."""

    kind = "association_linear"

    def __init__(self, spec: StreamSpec) -> None:
        super().__init__(spec, rows_apart(spec.dt))

    def fit(
        self, episodes: Sequence[Episode], rng: np.random.Generator, progress: Progress
    ) -> Self:
        streams = [e.stream for e in episodes]
        senses = StreamScaler.fit(self.spec, streams, self.lag)
        check_inputs(senses.inputs)
        a = np.concatenate([senses.read_episode(s).inputs[self.lag :] for s in streams])
        D = learn_linear(a, ChangeLayout.of(senses))
        left = np.sqrt(np.mean((a[:, senses.changes] - a @ D.T) ** 2, axis=0))
        return self.restore({**senses.arrays, "D": D, "remainder": np.maximum(left, FAINTEST)})

    def predict(self, state: RowHistory, rows: Floats) -> tuple[RowHistory, ModelOutput]:
        state, r, known = read_next(self.senses_, state, rows)
        error = known * (r.changes - r.inputs @ self.learned_["D"].T) / self.learned_["remainder"]
        return state, ModelOutput(error, no_context(rows))


OVER = 0.1  # seconds that a residual is averaged over


class _Averaged(NamedTuple):
    history: RowHistory
    residuals: Floats  # (B, W, J) the newest last; NaN before the first


class FrictionRule(StreamModel):
    """Torque beyond friction, and beyond weight and inertia by the text of a body model, ``urdf``.

    Raises:
        ValueError: the stream has no channels of torque or current, or none of speed or position.
    """

    kind = "friction_rule"
    held_out = 0

    def __init__(self, spec: StreamSpec, urdf: str = "") -> None:
        super().__init__(spec)
        self.urdf, self._body = urdf, Derived.of(spec, urdf)
        self._torques = forces(spec)
        self._speeds, self._from_positions = speeds(spec)
        joints = min(len(self._torques), len(self._speeds))
        if not joints:
            raise ValueError(
                f"a rule of friction needs a torque and a speed of each joint; there are: {spec.slices}"
            )
        self._torques, self._speeds = self._torques[:joints], self._speeds[:joints]
        self.lag = rows_apart(spec.dt)
        self.window = max(1, round(OVER / spec.dt))
        self.shortest = self.lag + self.window

    @property
    def error_columns(self) -> NDArray[np.intp]:
        return self._torques

    def fit(
        self, episodes: Sequence[Episode], rng: np.random.Generator, progress: Progress
    ) -> Self:
        streams = [e.stream.astype(np.float64) for e in episodes]
        pairs = [(rows[self.lag :], rows[: -self.lag]) for rows in streams]
        width = np.maximum(np.concatenate([self._speed(*pair) for pair in pairs]).std(axis=0), 1e-9)
        parts = [
            (rows[:, self._torques], self._inputs(rows, before, width)) for rows, before in pairs
        ]
        torque, inputs = (np.concatenate([p[k] for p in parts]) for k in range(2))
        solved = [
            np.linalg.lstsq(inputs[:, j], torque[:, j], rcond=None)[0]
            for j in range(torque.shape[1])
        ]
        weights = np.array(solved)
        left = [pd.DataFrame(tau - np.einsum("njk,jk->nj", told, weights)) for tau, told in parts]
        smoothed = [of.rolling(self.window, min_periods=1).mean() for of in left]
        spread = np.maximum(np.concatenate(smoothed).std(axis=0), 1e-9)
        return self.restore({"width": width, "weights": weights, "rule_spread": spread})

    def start(self, batch: int) -> _Averaged:
        residuals = np.full((batch, self.window, len(self._torques)), np.nan)
        return _Averaged(RowHistory.empty(batch, self.lag, self.spec.size), residuals)

    def predict(self, state: _Averaged, rows: Floats) -> tuple[_Averaged, ModelOutput]:
        inputs = self._inputs(rows, state.history.past(rows)[0], self.learned_["width"])
        friction = np.einsum("njk,jk->nj", inputs, self.learned_["weights"])
        left = rows[:, self._torques] - friction
        residuals = np.concatenate([state.residuals[:, 1:], left[:, None]], axis=1)
        ready = np.isfinite(residuals).all(axis=1)  # (B, J)
        mean = np.where(ready, residuals.mean(axis=1), 0.0)
        now = _Averaged(state.history.followed_by(rows), residuals)
        return now, ModelOutput(mean / self.learned_["rule_spread"], no_context(rows))

    def _speed(self, rows: Floats, before: Floats) -> Floats:
        now = rows[:, self._speeds]
        return (
            (now - before[:, self._speeds]) / (self.lag * self.spec.dt)
            if self._from_positions
            else now
        )

    def _inputs(self, rows: Floats, before: Floats, width: Floats) -> Floats:
        """Return 1, the speed and its smooth signs, and what the body model tells (N, J, K)."""
        speed, body = self._speed(rows, before), self._body
        parts = [np.ones_like(speed), speed, *(np.tanh(speed / (w * width)) for w in WIDTHS)]
        if body.links is not None:
            q, now = rows[:, self.spec.sensory[body.angles]] * body.radians, speed * body.radians
            pace = now - (now if self._from_positions else before[:, self._speeds] * body.radians)
            parts += body.links.torques(q, now, pace / (self.lag * self.spec.dt))
        return np.stack(parts, axis=2)


class _Limit(StreamModel):
    """A constant prediction for some channels. Raises ValueError where the stream has none of them."""

    shortest = 1
    held_out = 0  # so few numbers are not learned by heart
    channel = ""  # end of their names
    scaled = False

    def __init__(self, spec: StreamSpec) -> None:
        super().__init__(spec)
        named = [
            i
            for name, s in spec.slices.items()
            if name.endswith(self.channel)
            for i in range(spec.size)[s]
        ]
        self._columns = np.array(named, np.intp)
        if not len(self._columns):
            raise ValueError(f"this stream has no {self.channel}; it has: {', '.join(spec.slices)}")

    @property
    def error_columns(self) -> NDArray[np.intp]:
        return self._columns

    def fit(
        self, episodes: Sequence[Episode], rng: np.random.Generator, progress: Progress
    ) -> Self:
        rows = np.concatenate([e.stream for e in episodes])[:, self._columns].astype(float)
        scale = np.maximum(rows.std(axis=0), 1e-6) if self.scaled else np.ones(rows.shape[1])
        return self.restore({"limit_centre": rows.mean(axis=0), "limit_scale": scale})

    def start(self, batch: int) -> RowHistory:
        return RowHistory.empty(batch, 1, self.spec.size)  # it only says how many streams there are

    def predict(self, state: RowHistory, rows: Floats) -> tuple[RowHistory, ModelOutput]:
        error = (rows[:, self._columns] - self.learned_["limit_centre"]) / self.learned_[
            "limit_scale"
        ]
        return state, ModelOutput(np.where(np.isfinite(error), error, 0.0), no_context(rows))


class ForceLimit(_Limit):
    """A limit on the largest force of the wrist in a step."""

    kind = "force_limit"
    channel = "wrist_force_peak"


class ExternalTorqueLimit(_Limit):
    """A limit on each joint's external torque, in spreads of its nominal values."""

    kind = "external_torque_limit"
    channel = "external_torque_peak"
    scaled = True
