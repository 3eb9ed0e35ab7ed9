"""What a roboticist writes in an afternoon: torque of each joint less friction by speed, over a tenth of a second.

r_j = mean over 0.1 s of  τ_j - (c_0 + c_1 v_j + Σ_w c_w tanh(v_j/w s_j))       least squares
s   = max_j |r_j| / spread_j
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from asm_gym.detection import ModelOutput
from asm_gym.episode import Episode
from asm_gym.memory.state import RowHistory
from asm_gym.monitors.arm_inputs import WIDTHS, forces, speeds
from asm_gym.monitors.base import Progress
from asm_gym.monitors.stream_model import StreamModel, no_context
from asm_gym.scaling import rows_apart
from asm_gym.spec import StreamSpec

OVER = 0.1
"""Seconds that a residual is averaged over."""

Floats = NDArray[np.float64]


class _State(NamedTuple):
    history: RowHistory
    residuals: Floats  # (B, W, J) the newest last; NaN before the first


class FrictionRule(StreamModel):
    """Torque beyond friction; it needs channels of torque or current, and of speed or position.

    Raises:
        ValueError: the stream has none of them.
    """

    kind = "friction_rule"
    held_out = 0

    def __init__(self, spec: StreamSpec) -> None:
        super().__init__(spec)
        self._torques = forces(spec)
        self._speeds, self._from_positions = speeds(spec)
        joints = min(len(self._torques), len(self._speeds))
        if not joints:
            raise ValueError(f"a rule of friction needs a torque and a speed of each joint; there are: {spec.slices}")
        self._torques, self._speeds = self._torques[:joints], self._speeds[:joints]
        self.lag = rows_apart(spec.dt)
        self.window = max(1, round(OVER / spec.dt))
        self.shortest = self.lag + self.window

    @property
    def error_columns(self) -> NDArray[np.intp]:
        return self._torques

    def fit(self, episodes: Sequence[Episode], rng: np.random.Generator, progress: Progress) -> Self:
        parts = []
        for episode in episodes:
            rows = episode.stream.astype(np.float64)
            parts.append((rows[self.lag :, self._torques], self._speed(rows[self.lag :], rows[: -self.lag])))
        torque, speed = (np.concatenate([p[k] for p in parts]) for k in range(2))
        width = np.maximum(speed.std(axis=0), 1e-9)
        inputs = _inputs(speed, width)
        solved = [np.linalg.lstsq(inputs[:, j], torque[:, j], rcond=None)[0] for j in range(torque.shape[1])]
        weights, smoothed = np.array(solved), []
        for tau, v in parts:
            left = tau - np.einsum("njk,jk->nj", _inputs(v, width), weights)
            means = [left[max(0, n - self.window + 1) : n + 1].mean(axis=0) for n in range(len(left))]
            smoothed.append(np.array(means))
        spread = np.maximum(np.concatenate(smoothed).std(axis=0), 1e-9)
        return self.restore({"width": width, "weights": weights, "rule_spread": spread})

    def start(self, batch: int) -> _State:
        residuals = np.full((batch, self.window, len(self._torques)), np.nan)
        return _State(RowHistory.empty(batch, self.lag, self.spec.size), residuals)

    def predict(self, state: _State, rows: Floats) -> tuple[_State, ModelOutput]:
        speed = self._speed(rows, state.history.past(rows)[0])
        friction = np.einsum("njk,jk->nj", _inputs(speed, self.learned_["width"]), self.learned_["weights"])
        left = rows[:, self._torques] - friction
        residuals = np.concatenate([state.residuals[:, 1:], left[:, None]], axis=1)
        ready = np.isfinite(residuals).all(axis=1)  # (B, J)
        mean = np.where(ready, residuals.mean(axis=1), 0.0)
        now = _State(state.history.followed_by(rows), residuals)
        return now, ModelOutput(mean / self.learned_["rule_spread"], no_context(rows))

    def _speed(self, rows: Floats, before: Floats) -> Floats:
        now = rows[:, self._speeds]
        return (now - before[:, self._speeds]) / (self.lag * self.spec.dt) if self._from_positions else now


def _inputs(speed: Floats, width: Floats) -> Floats:
    """Return 1, the speed and its smooth signs (N, J, K)."""
    return np.stack([np.ones_like(speed), speed, *(np.tanh(speed / (w * width)) for w in WIDTHS)], axis=2)
