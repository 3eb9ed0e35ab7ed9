"""A rule of friction: torque beyond what the joint's own speed explains.

    r_j = mean over 0.1 s of τ_j - (c_0 + c_1 v_j + Σ_w c_w tanh(v_j/w s_j))    ε = r_j / spread_j

With a body model also c_g g_j + c_m (M q̈ + c)_j is taken away, see ``torque.body_model``.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple, Self

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from asm_gym.data.episode import Episode
from asm_gym.detection import ModelOutput
from asm_gym.memory.temporal import RowHistory
from asm_gym.monitors.monitor_protocol import Progress
from asm_gym.monitors.stream_model import StreamModel, no_context
from asm_gym.monitors.torque.arm_features import WIDTHS, ArmFeatures, torque_columns
from asm_gym.monitors.torque.body_model import JointMotion, explained_torque, joint_weights
from asm_gym.scaling import rows_apart
from asm_gym.spec import StreamSpec

RESIDUAL_S = 0.1  # time that a residual is averaged over [s]
LEAST_SPREAD = 1e-9  # of a speed and of a residual [their units]

Floats = NDArray[np.float64]


class FrictionState(NamedTuple):
    """State of B streams."""

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
        self.urdf = urdf
        self._arm = ArmFeatures.of(spec, urdf)
        torques = torque_columns(spec)
        speeds = spec.sensory[self._arm.speeds]
        joints = min(len(torques), len(speeds))
        if not joints:
            raise ValueError(
                "a rule of friction needs a torque and a speed of each joint; there are: "
                f"{spec.slices}"
            )
        self._torques = torques[:joints]
        self._speeds = speeds[:joints]
        self.lag = rows_apart(spec.dt)
        self._lag_s = self.lag * spec.dt
        self.window = max(1, round(RESIDUAL_S / spec.dt))
        self.shortest = self.lag + self.window

    @property
    def error_columns(self) -> NDArray[np.intp]:
        return self._torques

    def fit(
        self, episodes: Sequence[Episode], rng: np.random.Generator, progress: Progress
    ) -> Self:
        streams = [episode.stream.astype(np.float64) for episode in episodes]
        pairs = [(stream[self.lag :], stream[: -self.lag]) for stream in streams]
        speeds = np.concatenate([self._speed(rows, before) for rows, before in pairs])
        width = np.maximum(speeds.std(axis=0), LEAST_SPREAD)
        torques = [rows[:, self._torques] for rows, _ in pairs]
        inputs = [self._inputs(rows, before, width) for rows, before in pairs]
        weights = joint_weights(np.concatenate(inputs), np.concatenate(torques))

        residuals = []
        for torque, inputs_of_episode in zip(torques, inputs, strict=True):
            residual = pd.DataFrame(torque - explained_torque(inputs_of_episode, weights))
            residuals.append(residual.rolling(self.window, min_periods=1).mean())
        spread = np.maximum(np.concatenate(residuals).std(axis=0), LEAST_SPREAD)
        return self.restore({"width": width, "weights": weights, "rule_spread": spread})

    def start(self, batch: int) -> FrictionState:
        residuals = np.full((batch, self.window, len(self._torques)), np.nan)
        return FrictionState(RowHistory.empty(batch, self.lag, self.spec.size), residuals)

    def predict(self, state: FrictionState, rows: Floats) -> tuple[FrictionState, ModelOutput]:
        before, _ = state.history.past(rows)
        inputs = self._inputs(rows, before, self.learned_["width"])
        newest = rows[:, self._torques] - explained_torque(inputs, self.learned_["weights"])
        residuals = np.concatenate([state.residuals[:, 1:], newest[:, None]], axis=1)
        ready = np.isfinite(residuals).all(axis=1)  # (B, J)
        mean = np.where(ready, residuals.mean(axis=1), 0.0)
        error = mean / self.learned_["rule_spread"]
        new = FrictionState(state.history.followed_by(rows), residuals)
        return new, ModelOutput(error, no_context(rows))

    def _speed(self, rows: Floats, before: Floats) -> Floats:
        """Return the speeds (N, J) in rows (N, D), by those ``lag`` rows before."""
        now = rows[:, self._speeds]
        if not self._arm.from_changes:
            return now
        return (now - before[:, self._speeds]) / self._lag_s

    def _inputs(self, rows: Floats, before: Floats, width: Floats) -> Floats:
        """Return 1, the speed and its smooth signs, and the torques of the body model (N, J, K)."""
        speed = self._speed(rows, before)
        parts = [np.ones_like(speed), speed]
        parts += [np.tanh(speed / (share * width)) for share in WIDTHS]
        if self._arm.body is not None:
            motion = self._motion(rows, before, speed)
            parts += self._arm.body.torques(motion)
        return np.stack(parts, axis=2)

    def _motion(self, rows: Floats, before: Floats, speed: Floats) -> JointMotion:
        """Return the motion of the joints in rows (N, D) of speeds (N, J), by those ``lag`` rows before."""
        radians = self._arm.radians
        angle = rows[:, self.spec.sensory[self._arm.angles]] * radians
        now = speed * radians
        change = np.zeros_like(now)
        if not self._arm.from_changes:
            change = now - before[:, self._speeds] * radians
        return JointMotion(angle, speed=now, acceleration=change / self._lag_s)
