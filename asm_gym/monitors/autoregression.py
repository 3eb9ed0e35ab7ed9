"""The linear rival: each row predicted from the two before it and the commanded action.

    x̂_t = A₁ x_{t-1} + A₂ x_{t-2} + B u_t + c,    ridge regression over nominal steps

Its errors go through the same whitening and accumulation as the Neural ASM's. Source: vector autoregression with
exogenous input (Lütkepohl 2005, ch. 10); Mahalanobis distance of its residuals, with the accumulation of
``asm_gym.detection``.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from asm_gym.detection import Evidence, accumulate, bounded, no_evidence, shares, whitening
from asm_gym.monitors.base import State
from asm_gym.monitors.calibrated import CalibratedMonitor
from asm_gym.stream import StreamSpec

RIDGE = 1e-3
"""Of the standardised inputs; keeps channels that are constant or copies of others from mattering."""


class _State(NamedTuple):
    before: NDArray[np.float64]  # (B, X) the sensory row seen last, standardised
    earlier: NDArray[np.float64]  # (B, X) the one before
    evidence: Evidence


class Autoregression(CalibratedMonitor):
    """A linear model of the stream.

    Args:
        spec: the stream it watches.
        seed: not used; all is in closed form.
        gain, bound: of the accumulated evidence, as in ``NeuralASM``.
    """

    kind = "autoregression"

    def __init__(self, spec: StreamSpec, seed: int = 0, gain: float = 0.2, bound: float = 50.0) -> None:
        super().__init__(spec, seed)
        self.gain, self.bound = gain, bound

    def learn(self, streams: Sequence[NDArray[np.float64]]) -> dict[str, NDArray[np.float64]]:
        rows = np.concatenate(streams)[:, self.spec.sensory]
        self.learned_ = {"mean": rows.mean(axis=0), "spread": np.maximum(rows.std(axis=0), 1e-6)}
        inputs, targets = [], []
        for stream in streams:
            x, u = self._standard(stream), stream[:, self.spec.motor]
            # The first two rows have nothing before them to be predicted from.
            inputs.append(_regressors(x[1:-1], x[:-2], u[2:]))
            targets.append(x[2:])
        Z, Y = np.concatenate(inputs), np.concatenate(targets)  # (N, R), (N, X)
        if not len(Z):
            raise ValueError("an episode of at least 3 steps is needed")
        penalty = RIDGE * len(Z) * np.eye(Z.shape[1])
        weights = np.linalg.solve(Z.T @ Z + penalty, Z.T @ Y)  # (R, X)
        return {**self.learned_, "weights": weights, "whitening": whitening(Y - Z @ weights)}

    def initial_state(self, batch: int = 1) -> State:
        X = len(self.spec.sensory)
        return _State(np.zeros((batch, X)), np.zeros((batch, X)), no_evidence(batch, X))

    def shares(self, state: State, rows: NDArray[np.float64]) -> tuple[State, NDArray[np.float64]]:
        x = self._standard(rows)
        # Nothing has moved before the first row.
        first = (state.evidence.steps == 0)[:, None]
        before = np.where(first, x, state.before)
        earlier = np.where(first, x, state.earlier)
        error = x - _regressors(before, earlier, rows[:, self.spec.motor]) @ self.learned_["weights"]
        whitened = bounded(error @ self.learned_["whitening"], self.bound)
        evidence = accumulate(state.evidence, whitened, self.gain)
        attribution = np.zeros(rows.shape)
        attribution[:, self.spec.sensory] = shares(evidence, self.gain)
        return _State(x, before, evidence), attribution

    def _standard(self, rows: NDArray[np.float64]) -> NDArray[np.float64]:
        scaled: NDArray[np.float64] = (rows[:, self.spec.sensory] - self.learned_["mean"]) / self.learned_["spread"]
        return scaled


def _regressors(
    before: NDArray[np.float64], earlier: NDArray[np.float64], u: NDArray[np.float64]
) -> NDArray[np.float64]:
    return np.hstack([before, earlier, u, np.ones((len(u), 1))])
