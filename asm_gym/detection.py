"""From prediction errors to evidence, and from evidence to an alarm.

    whitened   e_t = M ε_t/σ_t,   M = ((1 - λ) C + λ tr(C)/X I)^(-½),   C = E[(ε/σ)(ε/σ)ᵀ] over nominal steps
    bounded    ẽ_t = e_t / √(1 + ‖e_t‖²/(ν X))                          ‖ẽ_t‖² < ν X, however large e_t
    evidence   w_t = (1 - a) w_{t-1} + a ẽ_t,   w_0 = 0
    value      s_t = ‖w_t‖² (2 - a) / (a X (1 - (1 - a)^{2t}))          nominal mean 1 for white errors, for every t
    alarm      s_t > q,   q the ⌈(n + 1)(1 - rate)⌉-th smallest of the maxima of n nominal episodes

Sources: Kessy et al. 2018 (ZCA whitening); Lange et al. 1989 (errors weighted as under a multivariate t);
Lowry et al. 1992 (multivariate EWMA chart, its exact variance at start-up);
Vovk et al. 2005 and Angelopoulos and Bates 2023 (split conformal prediction).
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.floating[Any]]


def whitening(errors: Array, shrinkage: float = 0.01) -> NDArray[np.float64]:
    """The symmetric (ZCA) matrix M (X, X) that makes ``errors`` (N, X) white; of all, it turns them the least.

    Args:
        errors: normalised errors of nominal steps; their mean is taken to be 0, as that of a prediction should be.
        shrinkage: λ in [0, 1], towards equal variance and no correlation. Above 0 a channel that is constant, or a
            copy of another, is no trouble.
    """
    if not 0.0 <= shrinkage <= 1.0:
        raise ValueError(f"shrinkage must be in [0, 1], got {shrinkage}")
    exact = np.asarray(errors, np.float64)
    covariance = exact.T @ exact / len(exact)  # (X, X)
    scale = float(np.trace(covariance)) / len(covariance)
    target = (scale if scale > 0 else 1.0) * np.eye(len(covariance))
    values, vectors = np.linalg.eigh((1.0 - shrinkage) * covariance + shrinkage * target)
    matrix: NDArray[np.float64] = (vectors / np.sqrt(values)) @ vectors.T
    return matrix


def bounded(errors: Array, bound: float) -> NDArray[np.float64]:
    """Whitened errors (B, X) pulled in as a whole, directions kept: a step counts at most ν = ``bound`` usual ones."""
    exact = np.asarray(errors, np.float64)
    excess = (exact**2).sum(axis=1, keepdims=True) / (bound * exact.shape[1])  # (B, 1)
    pulled: NDArray[np.float64] = exact / np.sqrt(1.0 + excess)
    return pulled


class Evidence(NamedTuple):
    """What the last steps of each stream in a batch have added up to; never changed in place."""

    vector: NDArray[np.float64]  # (B, X) w_t
    steps: NDArray[np.int64]  # (B,) t, how many steps are in it


def no_evidence(batch: int, size: int) -> Evidence:
    """w_0 for ``batch`` streams of ``size`` channels."""
    return Evidence(np.zeros((batch, size)), np.zeros(batch, np.int64))


def accumulate(evidence: Evidence, whitened: Array, gain: float) -> Evidence:
    """w_t from w_{t-1} and the whitened errors e_t (B, X); ``gain`` is a in (0, 1], and 1 forgets all but this step."""
    return Evidence((1.0 - gain) * evidence.vector + gain * whitened, evidence.steps + 1)


def shares(evidence: Evidence, gain: float) -> NDArray[np.float64]:
    """Each channel's part of s_t (B, X): they add up to s_t, whose nominal mean is 1."""
    variance = gain / (2.0 - gain) * (1.0 - (1.0 - gain) ** (2 * evidence.steps))  # (B,) of each w_t,i
    parts: NDArray[np.float64] = evidence.vector**2 / (evidence.vector.shape[1] * variance[:, None])
    return parts


def conformal_episodes(rate: float) -> int:
    """How many nominal episodes a false-alarm rate needs at least: ⌈1/rate⌉ - 1."""
    if not 0.0 < rate < 1.0:
        raise ValueError(f"false_alarm_rate must be in (0, 1), got {rate}")
    return math.ceil(1.0 / rate - 1e-9) - 1


def conformal_threshold(maxima: Array, rate: float) -> float:
    """The q that the maximum of a fresh nominal episode exceeds with a probability of at most ``rate``.

    The guarantee is over the draw of both the n calibration episodes and the fresh one, and needs no more than that
    they are exchangeable.

    Args:
        maxima: (n,) the largest value in each nominal episode.
        rate: P(any alarm in a nominal episode).
    """
    n, needed = len(maxima), conformal_episodes(rate)
    if n < needed:
        raise ValueError(f"a false alarm rate of {rate} needs at least {needed} nominal episodes, got {n}")
    rank = math.ceil((n + 1) * (1.0 - rate) - 1e-9)  # (n + 1)(1 - rate) is often whole, but not in floating point
    return float(np.sort(maxima)[rank - 1])
