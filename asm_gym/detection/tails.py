"""Tails: each number's surprise relative to its worst in nominal episodes, and how far beyond it may go.

    r_i = (v_i/q_i)^κ_i        q_i: v_i stays below it in 90 % of episodes
                               κ_i = min(1, ξ_0/ξ_i),  ξ_i: the index of the tail beyond q_i

Beyond q the maxima of episodes fall off as v^(-1/ξ), and κ makes equal ratios equally rare for all numbers. Where hours
of healthy operation set q (``ceilings``), it is a quantile of 98 % and κ goes by a smaller ξ_0; ξ_i stays as learned.

Source: Hill 1975 for the index of a tail.
"""

from __future__ import annotations

import numpy as np

from asm_gym.detection.base import Array, Floats

TAIL_INDEX = 0.3  # ξ_0: a ratio falls off as probability to this power
NOMINAL_QUANTILE = 0.9  # share of nominal episodes whose maximum of v stays below q
HOURS_TAIL_INDEX, HOURS_QUANTILE = 0.2, 0.98  # the same two where hours of healthy operation set q
FEWEST_EPISODES = 100  # that such a quantile needs
TAIL_PRIOR_COUNT = 10  # maxima beyond q after which a number's own tail counts as much as the tail common to all
SMALLEST = 1e-9  # lower bound of q
LEAST_SHARE = 1e-3  # the same as a share of the median q, for numbers that never erred in a few episodes


def worst_case(maxima: Array, tail_index: float = TAIL_INDEX) -> tuple[Floats, Floats]:
    """Return q and κ (…) by ξ_0 from the maxima of N nominal episodes (N, …)."""
    ceiling = ceilings(maxima, NOMINAL_QUANTILE)
    beyond = np.log(np.maximum(maxima / ceiling, 1.0))
    total, count = beyond.sum(axis=0), (beyond > 0).sum(axis=0)
    common = np.median(total / np.maximum(count, 1))  # Hill's estimate of ξ is total / count
    index = (total + TAIL_PRIOR_COUNT * common) / (count + TAIL_PRIOR_COUNT)
    return ceiling, tail_index / np.maximum(index, tail_index)


def ceilings(maxima: Array, quantile: float) -> Floats:
    """Return q (…): a quantile of the maxima of N nominal episodes (N, …)."""
    found = np.maximum(np.quantile(maxima, quantile, axis=0), SMALLEST)
    least: Floats = np.maximum(found, LEAST_SHARE * np.median(found))
    return least
