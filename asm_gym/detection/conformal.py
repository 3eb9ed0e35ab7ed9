"""Conformal calibration: a threshold that a nominal episode exceeds no more often than was promised.

    alarm      value > the ⌈(n + 1)(1 - rate)⌉-th smallest of the maxima of n nominal episodes

Sources: Vovk et al. 2005 and Angelopoulos and Bates 2023 (split conformal prediction).
"""

from __future__ import annotations

import math
from typing import NamedTuple, Self

import numpy as np
from scipy.special import betaincinv

from asm_gym.detection.base import Array
from asm_gym.validation import check_number, shown

EPISODE, HOUR = "episode", "hour"
"""What a rate of false alarms may be counted by."""

LEAST_RATE = 1e-15
"""What needs more episodes than anybody records; of the smallest numbers there are, the inverse is infinite."""


def conformal_episodes(rate: float) -> int:
    """How many nominal episodes a false-alarm rate needs at least: ⌈1/rate⌉ - 1."""
    check_number("false_alarm_rate", rate, above=0.0, below=1.0)
    return math.ceil(1.0 / max(rate, LEAST_RATE) - 1e-9) - 1


def conformal_threshold(maxima: Array, rate: float) -> float:
    """The q that the maximum of a fresh nominal episode exceeds with a probability of at most ``rate``.

    The guarantee is over the draw of both the n calibration episodes and the fresh one, and needs no more than that
    they are exchangeable.

    Args:
        maxima: (n,) the largest value in each nominal episode.
        rate: P(any alarm in a nominal episode).
    """
    try:
        found = np.asarray(maxima)
    except ValueError:  # rows of several lengths
        found = np.array(None)
    if found.ndim != 1 or found.dtype.kind not in "iuf" or np.isnan(found).any():
        raise ValueError(f"maxima must be numbers in the shape (n,), got {shown(maxima)}")
    maxima = found
    n, needed = len(maxima), conformal_episodes(rate)
    if n < needed:
        raise ValueError(
            f"a false alarm rate of {rate} needs at least {needed} nominal episodes, got {n}, which can promise "
            f"{math.ceil(1e3 / (n + 1)) / 1e3:g} at best"
        )
    rank = math.ceil((n + 1) * (1.0 - rate) - 1e-9)  # (n + 1)(1 - rate) is often whole, but not in floating point
    return float(np.sort(maxima)[rank - 1])


class Promise(NamedTuple):
    """What a threshold that was set on nominal episodes promises of what comes next.

    By the episode: given n of them, the share of fresh ones that alarm is Beta(k + 1, n - k)-distributed where k of
    them exceed the threshold (Vovk 2012; of continuous maxima, and larger never). By the hour: the same of n blocks,
    of which there are n/hours in an hour.

    Attributes:
        episodes: that it was set on.
        rate: of alarms, on average over such calibrations: (k + 1)/(n + 1) an episode, or (k + 1)/hours an hour.
        at_most: which the rate stays below in 95 % of such calibrations.
        per: ``"episode"`` or ``"hour"``.
        hours: that they lasted; 0 where they are not what is counted by.
    """

    episodes: int
    rate: float
    at_most: float
    per: str = EPISODE
    hours: float = 0.0

    @classmethod
    def of(cls, maxima: Array, threshold: float) -> Self:
        """By the episode, of the maxima (n,) of nominal ones."""
        n, beyond = len(maxima), int((maxima > threshold).sum())
        return cls(n, (beyond + 1) / (n + 1), surely_below(beyond, n))


def surely_below(beyond: int, n: int) -> float:
    """What the share of fresh maxima above a threshold stays below in 95 % of calibrations, if ``beyond`` of n are."""
    return float(betaincinv(beyond + 1, n - beyond, SURELY)) if beyond < n else 1.0


SURELY = 0.95
"""Share of calibrations in which ``Promise.at_most`` holds."""
