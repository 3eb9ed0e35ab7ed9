"""Evidence: whitened errors accumulated over a short while, each relative to its worst in nominal episodes.

    whitened   e_t = M ε_t/σ_t,   M = ((1 - λ) C + λ tr(C)/X I)^(-½),   C = E[(ε/σ)(ε/σ)ᵀ] over nominal steps
    bounded    ẽ_i = e_i / √(1 + e_i²/ν²)                               |ẽ_i| < ν, however large e_i
    evidence   w_t = (1 - a) w_{t-1} + a ẽ_t,   w_0 = 0                 for each of several gains a
               v_i = w_i² (2 - a) / (a (1 - (1 - a)^{2t}))              nominal mean 1 for white errors, for every t
    ratios     r_i = (v_i/q_i)^κ_i                                      q_i: v_i stays below it in 90 % of episodes
    pooled     s_t = (Σ_i r_i^p)^(1/p)

Beyond q the maxima of episodes fall off as v^(-1/ξ), and κ = min(1, ξ_0/ξ) makes equal ratios equally rare. Where hours
of healthy operation set q (``ceilings``), it is a quantile of 98 % and κ goes by a smaller ξ_0; ξ stays as learned.
``accumulated`` serves to fit; in use the compiled step of ``detector`` does the same.

Sources: Kessy et al. 2018 (ZCA whitening); Lange et al. 1989 (errors weighted as under a t distribution); Lowry et al.
1992 (multivariate EWMA chart, its exact variance at start-up); Hill 1975 (index of a tail).
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from asm_gym.compilation import compiled, inner
from asm_gym.detection.base import Array, Floats
from asm_gym.memory.linear_association import check_inputs, gram

POWER = 8  # p
CONTEXT_GAIN = 0.2  # weight of the newest row in the running mean of the context
TINY = float(np.finfo(np.float64).tiny)

TAIL_INDEX = 0.3  # ξ_0: a ratio falls off as probability to this power
NOMINAL_QUANTILE = 0.9  # share of nominal episodes whose maximum of v stays below q
HOURS_TAIL_INDEX = 0.2  # ξ_0 where hours of healthy operation set q
HOURS_QUANTILE = 0.98  # share of their episodes
FEWEST_EPISODES = 100  # that such a quantile needs
TAIL_PRIOR_COUNT = 10
"""Maxima beyond q after which a number's own tail counts as much as the tail common to all."""
LEAST_CEILING = 1e-9  # lower bound of q
LEAST_SHARE = 1e-3
"""The same as a share of the median q, for numbers that never erred in a few episodes."""


def whitening(errors: Array, shrinkage: float = 0.01) -> Floats:
    """Return the symmetric matrix M (X, X) that makes ``errors`` (N, X) white. Raises ValueError for a large X."""
    check_inputs(errors.shape[1])
    exact = np.asarray(errors, np.float64)
    covariance = gram(exact) / len(exact)  # (X, X)
    variance = float(np.trace(covariance)) / len(covariance)
    if not variance > 0:
        variance = 1.0
    prior = variance * np.eye(len(covariance))
    shrunk = (1.0 - shrinkage) * covariance + shrinkage * prior
    values, vectors = np.linalg.eigh(shrunk)
    return (vectors / np.sqrt(values)) @ vectors.T


@compiled
def bounded(errors: Array, bound: float) -> Floats:
    """Return the errors, none beyond ν = ``bound`` standard deviations."""
    limited = np.empty(errors.shape)
    for n in range(len(errors)):
        for i in range(errors.shape[1]):
            share = errors[n, i] / bound
            limited[n, i] = errors[n, i] / np.sqrt(1.0 + share * share)
    return limited


class Evidence(NamedTuple):
    """Evidence of B streams; never changed in place."""

    vector: Floats  # (B, G, X) w_t, for each of G gains
    context: Floats  # (B, C) running mean of the contexts
    steps: NDArray[np.int64]  # (B,) t, rows so far

    @classmethod
    def start(
        cls,
        batch: int,
        gains: int,
        errors: int,
        context: int = 0,
    ) -> Evidence:
        """Return w_0 for ``batch`` streams."""
        return cls(
            vector=np.zeros((batch, gains, errors)),
            context=np.zeros((batch, context)),
            steps=np.zeros(batch, np.int64),
        )


@inner
def average(
    before: Any,
    after: Any,
    values: Any,
    gain: float,
) -> None:
    """Write the running mean (N,) of values (N,)."""
    for i in range(len(values)):
        after[i] = before[i] + gain * (values[i] - before[i])


@inner
def scale(values: Any, factor: Any) -> None:
    """Multiply the values (N,) by a factor."""
    for i in range(len(values)):
        values[i] *= factor


@inner
def total(values: Any) -> float:
    """Return the sum of the values (N,)."""
    added = 0.0
    for value in values:
        added += value
    return added


@inner
def add_evidence(
    gains: Any,
    before: Any,
    after: Any,
    whitened: Any,
) -> None:
    """Write w_t (G, X) = w_{t-1} + a (ẽ_t - w_{t-1})."""
    for g in range(len(gains)):
        average(before[g], after[g], whitened, gains[g])


@compiled
def accumulated(
    whitened: Array,
    contexts: Array,
    gains: Array,
) -> tuple[Floats, Floats]:
    """Return w_t (T, G, X) of whitened errors ẽ_t (T, X), and the running mean of the contexts (T, C)."""
    rows, errors = whitened.shape
    vectors = np.zeros((rows, len(gains), errors))
    running = np.zeros(contexts.shape)
    for t in range(rows):
        before = max(t - 1, 0)  # in the first row all is still 0
        add_evidence(gains, vectors[before], vectors[t], whitened[t])
        average(running[before], running[t], contexts[t], CONTEXT_GAIN)
    return vectors, running


def strength(evidence: Evidence, gains: Array) -> Floats:
    """Return v (B, G, X), the squared evidence in each error."""
    rows = evidence.steps[:, None]
    lost = (1.0 - gains) ** (2 * rows)  # (B, G)
    variance = gains / (2.0 - gains) * (1.0 - lost)  # of each w_t,i
    return evidence.vector**2 / variance[:, :, None]


def pool(ratios: Array) -> tuple[Floats, Floats]:
    """Return (Σ_i r_i^p)^(1/p) (B,), and each ratio's part of it (B, X), which add up to it; r >= 0."""
    greatest = np.maximum(ratios.max(axis=1, keepdims=True), TINY)
    powers = (ratios / greatest) ** POWER
    total = powers.sum(axis=1, keepdims=True)
    pooled = greatest * total ** (1.0 / POWER)
    return pooled[:, 0], pooled * (powers / np.maximum(total, TINY))


def worst_case(maxima: Array, tail_index: float = TAIL_INDEX) -> tuple[Floats, Floats]:
    """Return q and κ (…) by ξ_0 from the maxima of N nominal episodes (N, …)."""
    ceiling = ceilings(maxima, NOMINAL_QUANTILE)
    beyond = np.log(np.maximum(maxima / ceiling, 1.0))
    total = beyond.sum(axis=0)
    count = (beyond > 0).sum(axis=0)
    common = np.median(total / np.maximum(count, 1))  # Hill's estimate of ξ is total / count
    index = (total + TAIL_PRIOR_COUNT * common) / (count + TAIL_PRIOR_COUNT)
    return ceiling, tail_index / np.maximum(index, tail_index)


def ceilings(maxima: Array, quantile: float) -> Floats:
    """Return q (…): a quantile of the maxima of N nominal episodes (N, …)."""
    ceiling = np.maximum(np.quantile(maxima, quantile, axis=0), LEAST_CEILING)
    return np.maximum(ceiling, LEAST_SHARE * np.median(ceiling))
