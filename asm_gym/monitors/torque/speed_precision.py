"""How far errors of a torque usually go at the speed of its joint.

    log σ = k_0 + Σ_w k_w tanh²(v/w s)      w, s: see ``arm_features``;  |log σ| <= 1.5

Friction is predicted worst where a joint reverses and where it is fast. k is a ridge regression of log(|r̄| + 0.1 rms r̄)
on cross-fitted errors r̄, the mean of a tenth of a second. σ is relative: log σ is 0 on average.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]

PENALTY = 0.03  # of standardised inputs
LEAST_ERROR = 0.1  # added to errors before the logarithm, in their root mean square
MOST = 1.5  # |log σ|
LEAST_SPREAD = 1e-9  # of an input, and of an error


def speed_weights(errors: Floats, squares: Floats) -> Floats:
    """Return k (V, 1 + W) for errors (N, V) and squares of friction (N, V, W); 0 where the squares are 0."""
    mean = squares.mean(axis=0)  # (V, W)
    spread = np.maximum(squares.std(axis=0), LEAST_SPREAD)
    inputs = (squares - mean) / spread
    usual = np.maximum(np.sqrt((errors**2).mean(axis=0)), LEAST_SPREAD)
    logs = np.log(np.abs(errors) + LEAST_ERROR * usual)
    logs -= logs.mean(axis=0)
    weights = np.zeros((squares.shape[1], 1 + squares.shape[2]))
    for value in range(len(weights)):
        z = inputs[:, value]
        gram = z.T @ z / len(z) + PENALTY * np.eye(z.shape[1])
        slopes = np.linalg.solve(gram, z.T @ logs[:, value] / len(z)) / spread[value]
        weights[value] = [-slopes @ mean[value], *slopes]
    return weights


def usual_errors(weights: Floats, squares: Floats) -> Floats:
    """Return σ (N, V) for k (V, 1 + W) and squares of friction (N, V, W)."""
    logs = weights[:, 0] + (squares * weights[:, 1:]).sum(axis=2)
    return np.asarray(np.exp(np.clip(logs, -MOST, MOST)))


def running_mean(errors: Floats, window: int) -> Floats:
    """Return the mean (T, V) of the last ``window`` rows of errors (T, V); before the first they are 0."""
    before = np.zeros((window, errors.shape[1]))
    total = np.cumsum(np.vstack([before, errors]), axis=0)
    return (total[window:] - total[:-window]) / window


def episode_means(errors: Floats, lengths: Sequence[int], window: int) -> Floats:
    """Return the ``running_mean`` of the errors (N, V) of episodes of these lengths."""
    episodes = np.split(errors, np.cumsum(lengths)[:-1])
    return np.concatenate([running_mean(episode, window) for episode in episodes])
