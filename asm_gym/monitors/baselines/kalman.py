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
from asm_gym.monitors.monitor_protocol import Progress
from asm_gym.monitors.stream_model import StreamModel, no_context, zero_unless_finite
from asm_gym.spec import StreamSpec
from asm_gym.validation import check_number, typed

LEAST_VARIANCE = 1e-4  # of w and v, standardised
LEAST_CHANNEL_SPREAD = 1e-6  # of a channel [its unit]


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
        sensory = self.spec.sensory
        sensed = [episode.stream[:, sensory].astype(np.float64) for episode in episodes]
        all_sensed = np.concatenate(sensed)
        mean = all_sensed.mean(axis=0)
        spread = np.maximum(all_sensed.std(axis=0), LEAST_CHANNEL_SPREAD)
        states = [(rows - mean) / spread for rows in sensed]

        before = np.concatenate([rows[:-1] for rows in states])  # (N, X)
        after = np.concatenate([rows[1:] for rows in states])
        commands = np.concatenate([episode.stream[1:, self.spec.commanded] for episode in episodes])
        inputs = _inputs(before, commands.astype(np.float64))
        penalty = self.ridge * len(inputs) * np.eye(inputs.shape[1])
        gram = inputs.T @ inputs + penalty
        weights = np.linalg.solve(gram, inputs.T @ after)
        residual = after - inputs @ weights

        noise = self.spec.noise[sensory] / spread
        R = np.diag(np.maximum(noise**2, LEAST_VARIANCE))
        A = weights[: len(sensory)].T
        P = _state_covariance(A, R, residual)
        S = P + R
        learned = {
            "weights": weights,
            "gain": np.linalg.solve(S.T, P.T).T,
            "deviation": np.sqrt(np.diag(S)),
            "mean": mean,
            "spread": spread,
        }
        return self.restore(learned)

    def start(self, batch: int) -> KalmanState:
        estimate = np.zeros((batch, len(self.spec.sensory)))
        return KalmanState(estimate, steps=np.zeros(batch, np.int64))

    def predict(self, state: KalmanState, rows: Floats) -> tuple[KalmanState, ModelOutput]:
        learned = self.learned_
        y = (rows[:, self.spec.sensory] - learned["mean"]) / learned["spread"]
        inputs = _inputs(state.estimate, zero_unless_finite(rows[:, self.spec.commanded]))
        has_begun = state.steps[:, None] > 0
        predicted = inputs @ learned["weights"]
        expected = np.where(has_begun, predicted, zero_unless_finite(y))
        innovation = zero_unless_finite(y - expected)
        estimate = expected + innovation @ learned["gain"].T
        error = innovation / learned["deviation"]
        return KalmanState(estimate, state.steps + 1), ModelOutput(error, no_context(rows))


def _inputs(state: Floats, commands: Floats) -> Floats:
    """Return x_{t-1} (N, X), u_t (N, A) and 1 side by side."""
    return np.hstack([state, commands, np.ones((len(state), 1))])


def _state_covariance(A: Floats, R: Floats, residual: Floats) -> Floats:
    """Return P (X, X) of the predicted state, from the residuals (N, X) of regression."""
    covariance = residual.T @ residual / len(residual)
    # A residual holds the new measurement's noise and, through A, that of the last.
    excess = covariance - R - A @ R @ A.T
    symmetric = (excess + excess.T) / 2
    values, vectors = np.linalg.eigh(symmetric)
    Q = (vectors * np.maximum(values, LEAST_VARIANCE)) @ vectors.T  # the nearest that is positive
    try:
        return solve_discrete_are(A.T, np.eye(len(A)), Q, R)
    except (LinAlgError, ValueError):  # an unstable A: trust the measurements
        return Q + R
