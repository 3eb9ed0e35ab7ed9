"""A Kalman filter of a stream, whose innovations are its errors.

    x_t = A x_{t-1} + B u_t + c + w, w ~ N(0, Q)      y_t = x_t + v, v ~ N(0, R)     ε: innovations

R is the sensor noise that the stream's spec states; A, B, c by ridge regression; Q is what is left of the residuals.

Sources: Kalman 1960; Mehra and Peschon 1971 (Automatica 7) for faults found in innovations; Hoerl and Kennard 1970.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple, Self

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import LinAlgError, solve_discrete_are

from asm_gym.data.episode import Episode
from asm_gym.detection import ModelOutput
from asm_gym.memory.linear_association import check_inputs
from asm_gym.monitors.stream_model import StreamModel, no_context, zero_unless_finite
from asm_gym.monitors.surprise import Progress
from asm_gym.spec import StreamSpec
from asm_gym.validation import check_number, typed

LEAST_VARIANCE = 1e-4  # of w and v, standardised
LEAST_SPREAD = 1e-6  # of a channel [its unit]

Floats = NDArray[np.float64]


class KalmanState(NamedTuple):
    """State of the filter in B streams."""

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
        sensed = [e.stream[:, self.spec.sensory].astype(np.float64) for e in episodes]
        rows = np.concatenate(sensed)
        mean = rows.mean(axis=0)
        spread = np.maximum(rows.std(axis=0), LEAST_SPREAD)
        states = [(x - mean) / spread for x in sensed]

        before = np.concatenate([x[:-1] for x in states])  # (N, X)
        after = np.concatenate([x[1:] for x in states])
        commands = np.concatenate([e.stream[1:, self.spec.motor] for e in episodes])
        inputs = np.hstack([before, commands.astype(np.float64), np.ones((len(after), 1))])
        penalty = self.ridge * len(inputs) * np.eye(inputs.shape[1])
        weights = np.linalg.solve(inputs.T @ inputs + penalty, inputs.T @ after)
        residual = after - inputs @ weights

        noise = self.spec.noise[self.spec.sensory] / spread
        R = np.diag(np.maximum(noise**2, LEAST_VARIANCE))
        P = _state_covariance(A=weights[: len(mean)].T, R=R, residual=residual)
        S = P + R
        gain = np.linalg.solve(S.T, P.T).T
        return self.restore(
            {
                "weights": weights,
                "gain": gain,
                "deviation": np.sqrt(np.diag(S)),
                "mean": mean,
                "spread": spread,
            }
        )

    def start(self, batch: int) -> KalmanState:
        return KalmanState(np.zeros((batch, len(self.spec.sensory))), np.zeros(batch, np.int64))

    def predict(self, state: KalmanState, rows: Floats) -> tuple[KalmanState, ModelOutput]:
        learned = self.learned_
        y = (rows[:, self.spec.sensory] - learned["mean"]) / learned["spread"]
        commands = zero_unless_finite(rows[:, self.spec.motor])
        inputs = np.hstack([state.estimate, commands, np.ones((len(rows), 1))])
        begun = (state.steps > 0)[:, None]
        expected = np.where(begun, inputs @ learned["weights"], zero_unless_finite(y))
        innovation = zero_unless_finite(y - expected)
        estimate = expected + innovation @ learned["gain"].T
        error = innovation / learned["deviation"]
        return KalmanState(estimate, state.steps + 1), ModelOutput(error, no_context(rows))


def _state_covariance(A: Floats, R: Floats, residual: Floats) -> Floats:
    """Return P (X, X) of the predicted state, from the residuals (N, X) of regression."""
    # A residual holds the new measurement's noise and, through A, that of the last.
    excess = residual.T @ residual / len(residual) - R - A @ R @ A.T
    values, vectors = np.linalg.eigh((excess + excess.T) / 2)
    Q = (vectors * np.maximum(values, LEAST_VARIANCE)) @ vectors.T  # the nearest that is positive
    try:
        return solve_discrete_are(A.T, np.eye(len(A)), Q, R)
    except (LinAlgError, ValueError):  # an unstable A: trust the measurements
        return Q + R
