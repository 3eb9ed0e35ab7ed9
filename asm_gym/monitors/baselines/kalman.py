"""The engineer's baseline: a Kalman filter of the stream, and the Mahalanobis distance of its innovations.

    x_t = A x_{t-1} + B u_t + c + w,  w ~ N(0, Q)        y_t = x_t + v,  v ~ N(0, R)

R is the sensor noise that the stream's spec states; A, B, c by ridge regression; Q is what is left of the residuals.
Sources: Kalman 1960; Mehra and Peschon 1971 (Automatica 7) for faults found in innovations.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple, Self

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import LinAlgError, solve_discrete_are

from asm_gym.detection import ModelOutput
from asm_gym.episode import Episode
from asm_gym.memory.linear import check_inputs
from asm_gym.monitors.base import Progress
from asm_gym.monitors.stream_model import StreamModel, no_context
from asm_gym.spec import StreamSpec
from asm_gym.validation import check_number, typed

FAINTEST = 1e-4
"""Smallest variance of w and v, of standardised channels; keeps the filter's equation solvable."""


class _State(NamedTuple):
    estimate: NDArray[np.float64]  # (B, X) x̂, standardised
    steps: NDArray[np.int64]  # (B,)


class Kalman(StreamModel):
    """A steady-state Kalman filter; its errors are innovations in standard deviations.

    Args:
        spec: the stream it is to expect.
        ridge: penalty on A, B and c, of the standardised inputs.
    """

    kind = "kalman"

    @typed
    def __init__(self, spec: StreamSpec, ridge: float = 1e-6) -> None:
        super().__init__(spec)
        self.ridge = check_number("ridge", ridge, low=0.0)

    def fit(self, episodes: Sequence[Episode], rng: np.random.Generator, progress: Progress) -> Self:
        check_inputs(self.spec.size + 1)
        streams = [e.stream for e in episodes]
        sensed = [s[:, self.spec.sensory].astype(np.float64) for s in streams]
        rows = np.concatenate(sensed)
        mean, spread = rows.mean(axis=0), np.maximum(rows.std(axis=0), 1e-6)
        xs = [(x - mean) / spread for x in sensed]
        before, after = (np.concatenate([x[k : len(x) - 1 + k] for x in xs]) for k in (0, 1))
        u = np.concatenate([s[1:, self.spec.motor] for s in streams]).astype(np.float64)
        Z = np.hstack([before, u, np.ones((len(u), 1))])
        weights = np.linalg.solve(Z.T @ Z + self.ridge * len(Z) * np.eye(Z.shape[1]), Z.T @ after)  # (X + A + 1, X)
        X = len(self.spec.sensory)
        A, residual = weights[:X].T, after - Z @ weights
        R = np.diag(np.maximum((self.spec.noise[self.spec.sensory] / spread) ** 2, FAINTEST))
        # A residual holds the new measurement's noise and, through A, that of the last.
        Q = _positive(residual.T @ residual / len(residual) - R - A @ R @ A.T)
        try:
            P = solve_discrete_are(A.T, np.eye(X), Q, R)
        except (LinAlgError, ValueError):  # an unstable A: trust the measurements
            P = Q + R
        S = P + R
        gain = np.linalg.solve(S.T, P.T).T
        filtered = {"weights": weights, "gain": gain, "deviation": np.sqrt(np.diag(S))}
        return self.restore({"mean": mean, "spread": spread, **filtered})

    def start(self, batch: int) -> _State:
        return _State(np.zeros((batch, len(self.spec.sensory))), np.zeros(batch, np.int64))

    def predict(self, state: _State, rows: NDArray[np.float64]) -> tuple[_State, ModelOutput]:
        y = (rows[:, self.spec.sensory] - self.learned_["mean"]) / self.learned_["spread"]
        u = rows[:, self.spec.motor]
        begun = (state.steps > 0)[:, None]
        inputs = np.hstack([state.estimate, np.where(np.isfinite(u), u, 0.0), np.ones((len(u), 1))])
        expected = np.where(begun, inputs @ self.learned_["weights"], np.where(np.isfinite(y), y, 0.0))
        innovation: NDArray[np.float64] = np.where(np.isfinite(y), y - expected, 0.0)
        estimate = expected + innovation @ self.learned_["gain"].T
        error = innovation / self.learned_["deviation"]
        return _State(estimate, state.steps + 1), ModelOutput(error, no_context(rows))


def _positive(matrix: NDArray[np.float64]) -> NDArray[np.float64]:
    """The nearest symmetric matrix whose eigenvalues are at least ``FAINTEST``."""
    values, vectors = np.linalg.eigh((matrix + matrix.T) / 2)
    nearest: NDArray[np.float64] = (vectors * np.maximum(values, FAINTEST)) @ vectors.T
    return nearest
