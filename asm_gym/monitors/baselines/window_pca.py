"""Principal components of a short window: what the newest row has that windows of nominal rows do not.

    w_t = [x_{t-4}, …, x_t] standardised        ε_t = (w_t - W Wᵀ w_t) of x_t, over its nominal spread

W: the leading eigenvectors of the windows' covariance, as many as hold all but 1 % of the variance.
Source: Jackson and Mudholkar 1979 (Technometrics 21(3)) for residuals of principal components; Ku et al. 1995 for
windows.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from asm_gym.detection import ModelOutput
from asm_gym.episodes import Episode
from asm_gym.memory.linear import check_inputs
from asm_gym.monitors.base import Progress
from asm_gym.monitors.baselines.base import no_context
from asm_gym.monitors.model import StreamModel

ROWS = 5
KEPT = 0.99
"""Share of the variance that the components hold."""

FAINTEST = 1e-4
"""Smallest spread of a residual, in standard deviations of its channel."""


class _Window(NamedTuple):
    rows: NDArray[np.float64]  # (B, ROWS - 1, D) the newest last, standardised; what was not finite is the mean
    steps: NDArray[np.int64]  # (B,)


class WindowPCA(StreamModel):
    """The residual of each sense beyond the principal components of five rows; it has no context."""

    kind = "window_pca"
    shortest = ROWS

    def fit(self, episodes: Sequence[Episode], rng: np.random.Generator, progress: Progress) -> Self:
        check_inputs(ROWS * self.spec.size)
        rows = np.concatenate([e.stream for e in episodes]).astype(np.float64)
        mean, spread = rows.mean(axis=0), np.maximum(rows.std(axis=0), 1e-6)
        windows = np.concatenate([_windows((e.stream - mean) / spread) for e in episodes])  # (N, ROWS D)
        values, vectors = np.linalg.eigh(windows.T @ windows / len(windows))
        count = int(np.searchsorted(np.cumsum(values[::-1]), KEPT * values.sum())) + 1
        W = np.ascontiguousarray(vectors[:, ::-1][:, :count])
        senses = windows.shape[1] - self.spec.size + self.spec.sensory
        left = windows[:, senses] - (windows @ W) @ W[senses].T
        deviation = np.maximum(np.sqrt(np.mean(left**2, axis=0)), FAINTEST)
        return self.restore({"mean": mean, "spread": spread, "components": W, "deviation": deviation})

    def start(self, batch: int, skills: Sequence[str] = ()) -> _Window:
        return _Window(np.zeros((batch, ROWS - 1, self.spec.size)), np.zeros(batch, np.int64))

    def predict(self, state: _Window, rows: NDArray[np.float64]) -> tuple[_Window, ModelOutput]:
        scaled = (rows - self.learned_["mean"]) / self.learned_["spread"]
        known = np.isfinite(scaled)
        window = np.concatenate([state.rows, np.where(known, scaled, 0.0)[:, None]], axis=1)  # (B, ROWS, D)
        flat, W = window.reshape(len(rows), -1), self.learned_["components"]
        senses = (ROWS - 1) * self.spec.size + self.spec.sensory
        left = (flat[:, senses] - (flat @ W) @ W[senses].T) / self.learned_["deviation"]
        judged = known[:, self.spec.sensory] & (state.steps >= ROWS - 1)[:, None]
        return _Window(window[:, 1:], state.steps + 1), ModelOutput(np.where(judged, left, 0.0), no_context(rows))


def _windows(rows: NDArray[np.float64]) -> NDArray[np.float64]:
    """(T - ROWS + 1, ROWS D) of rows (T, D), the oldest row first."""
    return np.hstack([rows[k : len(rows) - ROWS + 1 + k] for k in range(ROWS)])
