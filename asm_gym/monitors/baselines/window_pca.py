"""Principal components of a short window: what the newest row has that windows of nominal rows do not.

    w_t = [x_{t-R+1}, …, x_t] standardised      ε_t = (w_t - W Wᵀ w_t) of x_t, over its nominal spread

W: the leading eigenvectors of the windows' covariance, as many as hold most of the variance.
Source: Jackson and Mudholkar 1979 (Technometrics 21(3)) for residuals of principal components; Ku et al. 1995 for
windows.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from asm_gym.detection import ModelOutput
from asm_gym.episode import Episode
from asm_gym.memory.linear import check_inputs
from asm_gym.monitors.base import Progress
from asm_gym.monitors.stream_model import StreamModel, no_context
from asm_gym.spec import StreamSpec
from asm_gym.validation import check_number, typed

FAINTEST = 1e-4
"""Smallest spread of a residual, in standard deviations of its channel."""


class _Window(NamedTuple):
    rows: NDArray[np.float64]  # (B, R - 1, D) the newest last, standardised; what was not finite is the mean
    steps: NDArray[np.int64]  # (B,)


class WindowPCA(StreamModel):
    """The residual of each sense beyond the principal components of a few rows; it has no context.

    Args:
        spec: the stream it is to expect.
        rows: R, of a window.
        kept: share in (0, 1] of the variance that the components hold.
    """

    kind = "window_pca"

    @typed
    def __init__(self, spec: StreamSpec, rows: int = 5, kept: float = 0.999) -> None:
        super().__init__(spec)
        self.rows = check_number("rows", rows, low=1, whole=True)
        self.kept = check_number("kept", kept, above=0.0, high=1.0)
        self.shortest = self.rows

    def fit(self, episodes: Sequence[Episode], rng: np.random.Generator, progress: Progress) -> Self:
        check_inputs(self.rows * self.spec.size)
        rows = np.concatenate([e.stream for e in episodes]).astype(np.float64)
        mean, spread = rows.mean(axis=0), np.maximum(rows.std(axis=0), 1e-6)
        windows = np.concatenate([_windows((e.stream - mean) / spread, self.rows) for e in episodes])  # (N, R D)
        values, vectors = np.linalg.eigh(windows.T @ windows / len(windows))
        count = int(np.searchsorted(np.cumsum(values[::-1]), self.kept * values.sum())) + 1
        W = np.ascontiguousarray(vectors[:, ::-1][:, :count])
        senses = windows.shape[1] - self.spec.size + self.spec.sensory
        left = windows[:, senses] - (windows @ W) @ W[senses].T
        deviation = np.maximum(np.sqrt(np.mean(left**2, axis=0)), FAINTEST)
        return self.restore({"mean": mean, "spread": spread, "components": W, "deviation": deviation})

    def start(self, batch: int) -> _Window:
        return _Window(np.zeros((batch, self.rows - 1, self.spec.size)), np.zeros(batch, np.int64))

    def predict(self, state: _Window, rows: NDArray[np.float64]) -> tuple[_Window, ModelOutput]:
        scaled = (rows - self.learned_["mean"]) / self.learned_["spread"]
        known = np.isfinite(scaled)
        window = np.concatenate([state.rows, np.where(known, scaled, 0.0)[:, None]], axis=1)  # (B, R, D)
        flat, W = window.reshape(len(rows), -1), self.learned_["components"]
        senses = (self.rows - 1) * self.spec.size + self.spec.sensory
        left = (flat[:, senses] - (flat @ W) @ W[senses].T) / self.learned_["deviation"]
        judged = known[:, self.spec.sensory] & (state.steps >= self.rows - 1)[:, None]
        return _Window(window[:, 1:], state.steps + 1), ModelOutput(np.where(judged, left, 0.0), no_context(rows))


def _windows(rows: NDArray[np.float64], count: int) -> NDArray[np.float64]:
    """(T - R + 1, R D) of rows (T, D), the oldest row first, R of them at a time."""
    return np.hstack([rows[k : len(rows) - count + 1 + k] for k in range(count)])
