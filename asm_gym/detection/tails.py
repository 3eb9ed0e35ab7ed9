"""Tails: how surprised each number is in nominal episodes at its worst, and how much further it may go.

    r_i = (v_i/q_i)^κ_i        q_i: what v_i stays below in 90 % of episodes
                               κ_i = min(1, ξ_0/ξ_i),  ξ_i: the index of the tail beyond q_i

Each number is measured against what it does at its worst, so that a wrist that is often surprised by contact does not
drown an encoder that never is. Beyond q the maxima of episodes fall off as v^(-1/ξ): a ratio of 10 happens to a wrist
now and then, to an encoder never. The exponent κ makes the same ratio as rare for the one as for the other.

Hours of healthy operation tell q better than what was learned from (``ceilings``): q is then what 98 % of episodes stay
below, and κ goes by a smaller ξ_0. Few hours tell no tail of 98 %, and those of one policy nothing of others, so ξ_i
stays what was learned.

Source: Hill 1975 for the index of a tail.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from asm_gym.detection.base import Array

TAIL_INDEX = 0.3
"""ξ_0: a ratio falls off as probability to this power."""

HOURS_TAIL_INDEX, HOURS_QUANTILE = 0.2, 0.98
"""ξ_0, and the share of episodes below q, where hours of healthy operation tell q."""

FEWEST_EPISODES = 100
"""That tell what 98 % of episodes stay below."""

NOMINAL_QUANTILE = 0.9
"""Share of nominal episodes whose maximum of v stays below q; those above tell how far it goes."""

TAIL_PRIOR_COUNT = 10
"""How many maxima beyond q a tail must show of its own to count as much as what is common among all."""

SMALLEST = 1e-9
"""Lower bound of q."""

LEAST_SHARE = 1e-3
"""q is at least this share of what is common among all numbers: one that never erred in a few episodes may do so yet,
and its first small error is not a thousand million times what is usual."""


def worst_case(maxima: Array, tail_index: float = TAIL_INDEX) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """q and κ by ξ_0, of the shape of one episode's maxima, from those of N nominal episodes (N, …)."""
    ceiling = ceilings(maxima, NOMINAL_QUANTILE)
    beyond = np.log(np.maximum(maxima / ceiling, 1.0))
    total, count = beyond.sum(axis=0), (beyond > 0).sum(axis=0)
    common = np.median(total / np.maximum(count, 1))  # Hill's estimate of ξ is total / count
    index = (total + TAIL_PRIOR_COUNT * common) / (count + TAIL_PRIOR_COUNT)
    return ceiling, tail_index / np.maximum(index, tail_index)


def ceilings(maxima: Array, quantile: float) -> NDArray[np.float64]:
    """q, of the shape of one episode's maxima: what that share of N nominal episodes (N, …) stays below."""
    found = np.maximum(np.quantile(maxima, quantile, axis=0), SMALLEST)
    least: NDArray[np.float64] = np.maximum(found, LEAST_SHARE * np.median(found))
    return least
