"""What a roboticist writes down in an afternoon: each joint's torque less friction by speed, over a tenth of a second.

    r_j = mean over 0.1 s of  τ_j - (c_0 + c_1 v_j + Σ_w c_w tanh(v_j/w s_j))       least squares
    s   = max_j |r_j| / spread_j

and a limit on each channel, which is what most cells have.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from asm_gym.detection import ModelOutput
from asm_gym.episode import Episode
from asm_gym.monitors.base import Progress, Told
from asm_gym.monitors.baselines.arm_inputs import WIDTHS, forces, speeds
from asm_gym.monitors.baselines.base import no_context
from asm_gym.monitors.stream_model import StreamModel
from asm_gym.scaling import rows_apart
from asm_gym.spec import StreamSpec

OVER = 0.1
"""Seconds that a residual is averaged over."""


class _Past(NamedTuple):
    rows: NDArray[np.float64]  # (B, l, D) seen last, the newest last
    residuals: NDArray[np.float64]  # (B, W, J) the newest last; NaN before the first


class FrictionRule(StreamModel):
    """The rule above; it needs channels of torque or current, and of speed or position.

    Raises:
        ValueError: the stream has none of them.
    """

    kind = "friction_rule"
    held_out = 0

    def __init__(self, spec: StreamSpec) -> None:
        super().__init__(spec)
        self._torques = forces(spec)
        self._speeds, self.derived = speeds(spec)
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
            before = np.concatenate([rows[: self.lag], rows[: -self.lag]])
            parts.append((rows[self.lag :, self._torques], self._speed(rows, before)[self.lag :]))
        torque, speed = (np.concatenate([p[k] for p in parts]) for k in range(2))
        width = np.maximum(speed.std(axis=0), 1e-9)
        weights = np.array(
            [
                np.linalg.lstsq(self._regressors(speed[:, [j]], width[[j]])[:, 0], torque[:, j], rcond=None)[0]
                for j in range(torque.shape[1])
            ]
        )
        fitted = {"width": width, "weights": weights}
        self.learned_ = fitted
        smoothed = []
        for tau, v in parts:
            left = tau - np.einsum("njk,jk->nj", self._regressors(v, width), weights)
            smoothed.append(
                np.array([left[max(0, n - self.window + 1) : n + 1].mean(axis=0) for n in range(len(left))])
            )
        spread = np.maximum(np.concatenate(smoothed).std(axis=0), 1e-9)
        return self.restore(fitted | {"rule_spread": spread})

    def start(self, batch: int, told: Sequence[Told] = ()) -> _Past:
        return _Past(
            np.full((batch, self.lag, self.spec.size), np.nan),
            np.full((batch, self.window, len(self._torques)), np.nan),
        )

    def predict(self, state: _Past, rows: NDArray[np.float64]) -> tuple[_Past, ModelOutput]:
        before = np.where(np.isfinite(state.rows[:, 0]), state.rows[:, 0], rows)
        speed = self._speed(rows, before)
        left = rows[:, self._torques] - np.einsum(
            "njk,jk->nj", self._regressors(speed, self.learned_["width"]), self.learned_["weights"]
        )
        residuals = np.concatenate([state.residuals[:, 1:], left[:, None]], axis=1)
        known = np.isfinite(residuals)
        mean = np.where(known, residuals, 0.0).sum(axis=1) / np.maximum(known.sum(axis=1), 1)
        ready = known.all(axis=1) if self.window > 1 else known[:, 0]
        error = np.where(ready, mean, 0.0) / self.learned_["rule_spread"]
        last = np.concatenate([state.rows[:, 1:], rows[:, None]], axis=1)
        return _Past(last, residuals), ModelOutput(error, no_context(rows))

    def _speed(self, rows: NDArray[np.float64], before: NDArray[np.float64]) -> NDArray[np.float64]:
        now = rows[:, self._speeds]
        return (now - before[:, self._speeds]) / (self.lag * self.spec.dt) if self.derived else now

    def _regressors(self, speed: NDArray[np.float64], width: NDArray[np.float64]) -> NDArray[np.float64]:
        """(N, J, K)."""
        return np.stack([np.ones_like(speed), speed, *(np.tanh(speed / (w * width)) for w in WIDTHS)], axis=2)


class ChannelLimit(StreamModel):
    """A limit on each channel: how far it is from the middle of its range, in halves of that."""

    kind = "channel_limit"
    shortest = 1
    held_out = 0

    def fit(self, episodes: Sequence[Episode], rng: np.random.Generator, progress: Progress) -> Self:
        rows = np.concatenate([e.stream for e in episodes])[:, self.spec.sensory].astype(np.float64)
        low, high = rows.min(axis=0), rows.max(axis=0)
        return self.restore({"middle": (low + high) / 2, "half": np.maximum((high - low) / 2, 1e-9)})

    def start(self, batch: int, told: Sequence[Told] = ()) -> NDArray[np.bool_]:
        return np.zeros(batch, np.bool_)

    def predict(self, state: NDArray[np.bool_], rows: NDArray[np.float64]) -> tuple[NDArray[np.bool_], ModelOutput]:
        error = (rows[:, self.spec.sensory] - self.learned_["middle"]) / self.learned_["half"]
        return state, ModelOutput(np.where(np.isfinite(error), error, 0.0), no_context(rows))
