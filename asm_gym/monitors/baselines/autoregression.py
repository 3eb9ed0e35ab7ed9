"""The linear baseline: each row predicted from the two before it and the commanded action.

    x̂_t = A₁ x_{t-1} + A₂ x_{t-2} + B u_t + c,    ridge regression over nominal steps

Source: vector autoregression with exogenous input (Lütkepohl 2005, ch. 10), and the Mahalanobis distance of its
residuals.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from asm_gym.detection import ModelOutput
from asm_gym.episode import Episode
from asm_gym.monitors.base import Progress, Told
from asm_gym.monitors.baselines.base import Standard, no_context
from asm_gym.monitors.model import StreamModel

RIDGE = 1e-3
"""Of the standardised inputs; keeps channels that are constant or copies of others from mattering."""


class _State(NamedTuple):
    before: NDArray[np.float64]  # (B, X) the sensory row seen last, standardised; NaN before the first
    earlier: NDArray[np.float64]  # (B, X) the one before


class Autoregression(StreamModel):
    """A linear model of the stream."""

    kind = "autoregression"
    shortest = 3

    def fit(self, episodes: Sequence[Episode], rng: np.random.Generator, progress: Progress) -> Self:
        streams = [e.stream for e in episodes]
        standard = Standard.fit(self.spec, streams)
        inputs, targets = [], []
        for stream in streams:
            x, u = standard(stream.astype(np.float64)), stream[:, self.spec.motor].astype(np.float64)
            # The first two rows have nothing before them to be predicted from.
            inputs.append(_regressors(x[1:-1], x[:-2], u[2:]))
            targets.append(x[2:])
        Z, Y = np.concatenate(inputs), np.concatenate(targets)  # (N, R), (N, X)
        penalty = RIDGE * len(Z) * np.eye(Z.shape[1])
        weights = np.linalg.solve(Z.T @ Z + penalty, Z.T @ Y)  # (R, X)
        deviation = np.maximum((Y - Z @ weights).std(axis=0), 1e-9)
        return self.restore({**standard.arrays, "weights": weights, "deviation": deviation})

    def start(self, batch: int, told: Sequence[Told] = ()) -> _State:
        unknown = np.full((batch, len(self.spec.sensory)), np.nan)
        return _State(unknown, unknown)

    def predict(self, state: _State, rows: NDArray[np.float64]) -> tuple[_State, ModelOutput]:
        x = Standard.of(self.spec, self.learned_)(rows)
        # What is not finite is taken to be what it was.
        x = np.where(np.isfinite(x), x, np.where(np.isfinite(state.before), state.before, 0.0))
        before = np.where(np.isfinite(state.before), state.before, x)
        earlier = np.where(np.isfinite(state.earlier), state.earlier, before)
        u = rows[:, self.spec.motor]
        expected = _regressors(before, earlier, np.where(np.isfinite(u), u, 0.0)) @ self.learned_["weights"]
        error = (x - expected) / self.learned_["deviation"]
        error[~np.isfinite(state.earlier).all(axis=1)] = 0.0  # two rows must have been seen to expect a third
        return _State(x, state.before), ModelOutput(error, no_context(rows))


def _regressors(
    before: NDArray[np.float64], earlier: NDArray[np.float64], u: NDArray[np.float64]
) -> NDArray[np.float64]:
    return np.hstack([before, earlier, u, np.ones((len(u), 1))])
