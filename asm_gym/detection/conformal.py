"""Conformal calibration by the episode: a threshold that nominal episodes exceed no more often than promised.

    alarm      value > the ⌈(n + 1)(1 - rate)⌉-th smallest of the maxima of n nominal episodes

Sources: Vovk et al. 2005 and Angelopoulos and Bates 2023 (split conformal prediction).
"""

from __future__ import annotations

import math
from typing import NamedTuple, Self

import numpy as np
from scipy.special import betaincinv

from asm_gym.detection.base import Array
from asm_gym.validation import check_number, short_repr

EPISODE, HOUR = "episode", "hour"
"""Units of a rate of false alarms."""

LEAST_RATE = 1e-15  # rates are not taken to be smaller, as the inverse of the smallest floats is infinite
CONFIDENCE = 0.95  # share of calibrations in which ``Promise.at_most`` holds


def conformal_episodes(rate: float) -> int:
    """Return the least number of nominal episodes that a false-alarm rate needs: ⌈1/rate⌉ - 1."""
    check_number("false_alarm_rate", rate, above=0.0, below=1.0)
    return math.ceil(1.0 / max(rate, LEAST_RATE) - 1e-9) - 1


def conformal_threshold(maxima: Array, rate: float) -> float:
    """Return the q that the maximum of a fresh nominal episode exceeds with a probability of at most ``rate``.

    The guarantee is over the draw of the calibration episodes and the fresh one, which must be exchangeable.

    Args:
        maxima: (n,) the largest value in each nominal episode.
        rate: P(any alarm in a nominal episode).

    Raises:
        ValueError: no numbers, or too few for this rate.
    """
    try:
        found = np.asarray(maxima)
    except ValueError:  # rows of several lengths
        found = np.array(None)
    if found.ndim != 1 or found.dtype.kind not in "iuf" or np.isnan(found).any():
        raise ValueError(f"maxima must be numbers in the shape (n,), got {short_repr(maxima)}")
    n, needed = len(found), conformal_episodes(rate)
    if n < needed:
        raise ValueError(
            f"a false alarm rate of {rate} needs at least {needed} nominal episodes, got {n}, which can promise "
            f"{math.ceil(1e3 / (n + 1)) / 1e3:g} at best"
        )
    rank = math.ceil((n + 1) * (1.0 - rate) - 1e-9)  # (n + 1)(1 - rate) is often whole, but not in floating point
    return float(np.sort(found)[rank - 1])


class Promise(NamedTuple):
    """The promise of a threshold set on nominal episodes.

    If k of n maxima exceed the threshold, the share of fresh episodes (or blocks, by the hour) that alarm is
    Beta(k + 1, n - k)-distributed (Vovk 2012, continuous maxima).
    """

    episodes: int  # that it was set on
    rate: float  # of alarms, mean over calibrations: (k + 1)/(n + 1) an episode, or (k + 1)/hours an hour
    at_most: float  # upper bound of the rate in 95 % of calibrations
    per: str = EPISODE  # or ``HOUR``
    hours: float = 0.0  # of the blocks; 0 by the episode

    @classmethod
    def of(cls, maxima: Array, threshold: float) -> Self:
        """Return the promise by the episode, from the maxima (n,) of nominal ones."""
        n, beyond = len(maxima), int((maxima > threshold).sum())
        return cls(n, (beyond + 1) / (n + 1), surely_below(beyond, n))


def surely_below(beyond: int, n: int) -> float:
    """Return the bound on the share of fresh maxima above a threshold that ``beyond`` of n exceed."""
    return float(betaincinv(beyond + 1, n - beyond, CONFIDENCE)) if beyond < n else 1.0
