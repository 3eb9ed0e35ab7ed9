"""Statistics of proportions, counts and ranks: pure functions of numbers."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import stats

from asm_gym.validation import check_number, short_repr

Floats = NDArray[np.floating[Any]]

RESAMPLES = 2000
"""Resamples of a bootstrap."""


class Share(NamedTuple):
    """``k`` of ``n``."""

    k: int
    n: int

    @property
    def value(self) -> float:
        """The proportion; NaN for none of none."""
        return self.k / self.n if self.n else math.nan

    @property
    def interval(self) -> tuple[float, float]:
        """95 % Wilson interval."""
        return wilson_interval(self.k, self.n)

    @classmethod
    def of(cls, outcomes: Sequence[bool]) -> Share:
        """Count the true outcomes."""
        return cls(sum(map(bool, outcomes)), len(outcomes))


class Rate(NamedTuple):
    """``k`` events in so many ``hours``."""

    k: int
    hours: float

    @property
    def value(self) -> float:
        """Events per hour; NaN without any time."""
        return self.k / self.hours if self.hours else math.nan

    @property
    def interval(self) -> tuple[float, float]:
        """95 % exact Poisson interval [1/h]."""
        low, high = poisson_interval(self.k)
        return (low / self.hours, high / self.hours) if self.hours else (0.0, math.inf)

    @property
    def text(self) -> str:
        """``value (low to high)``; empty without any time."""
        return f"{self.value:.1f} ({self.interval[0]:.1f} to {self.interval[1]:.1f})" if self.hours else ""


class Estimate(NamedTuple):
    """A number and its 95 % bootstrap interval."""

    value: float
    low: float
    high: float

    def percent(self, undefined: str = "") -> str:
        """``value % (low to high)``; ``undefined`` where there is no value."""
        if math.isnan(self.value):
            return undefined
        return f"{100 * self.value:.0f} % ({100 * self.low:.0f} to {100 * self.high:.0f})"


class Spread(NamedTuple):
    """Mean and standard deviation over seeds."""

    mean: float
    sd: float

    @classmethod
    def of(cls, values: Sequence[float]) -> Spread:
        """Summarise one value per seed; the deviation of a single one is NaN."""
        return cls(float(np.mean(values)), float(np.std(values, ddof=1)) if len(values) > 1 else math.nan)

    def text(self, scale: float = 1.0, digits: int = 3) -> str:
        """``mean ± sd``, each times ``scale``; the mean alone without a deviation."""
        deviation = "" if math.isnan(self.sd) else f" ± {scale * self.sd:.{digits}f}"
        return f"{scale * self.mean:.{digits}f}{deviation}"


def wilson_interval(k: int, n: int, confidence: float = 0.95) -> tuple[float, float]:
    """Return the score interval of the proportion ``k`` in ``n`` (Wilson 1927); (0, 1) where ``n`` is 0."""
    check_number("n", n, low=0, whole=True)
    check_number("k", k, low=0, high=n, whole=True)
    check_number("confidence", confidence, above=0, below=1)
    if n == 0:
        return 0.0, 1.0
    found = stats.binomtest(k, n).proportion_ci(confidence, method="wilson")
    return float(found.low), float(found.high)


def binomial_interval(n: int, p: float, confidence: float = 0.95) -> tuple[int, int]:
    """Return the counts (low, high) that ``n`` trials of probability ``p`` stay within, with equal tails.

    Checks a calibration: alarms in n nominal episodes at the false-alarm rate p.
    """
    check_number("p", p, low=0, high=1)
    check_number("n", n, low=0, high=1e7, whole=True)
    check_number("confidence", confidence, above=0, below=1)
    low, high = stats.binom.interval(confidence, n, p)
    return int(low), int(high)


def poisson_interval(k: int, confidence: float = 0.95) -> tuple[float, float]:
    """Return the exact interval of the mean of a Poisson variable that came to ``k`` (Garwood 1936).

    Events that come in clusters are not Poisson: count each cluster once.
    """
    check_number("k", k, low=0, high=1e9, whole=True)
    tail = (1 - check_number("confidence", confidence, above=0, below=1)) / 2
    low = stats.gamma.ppf(tail, k) if k else 0.0
    return float(low), float(stats.gamma.isf(tail, k + 1))


def chance_of_alarms(k: int, n: int, beyond: int, calibrated: int) -> float:
    """Return P(at least ``k`` alarms in ``n`` fresh episodes) for a threshold set on ``calibrated`` maxima.

    ``beyond`` of the maxima exceed the threshold. The share of fresh ones that exceed it is itself drawn, from
    Beta(beyond + 1, calibrated - beyond), so the count is beta-binomial. Assumes continuous and exchangeable maxima.
    """
    check_number("beyond", beyond, low=0, high=calibrated - 1, whole=True)
    return float(stats.betabinom.sf(k - 1, n, beyond + 1, calibrated - beyond))


def auroc(scores_pos: ArrayLike, scores_neg: ArrayLike) -> float:
    """Return the probability that a positive scores higher than a negative, ties counted half (Mann-Whitney).

    Raises:
        ValueError: a score is NaN (infinite ones are fine), or one of the two holds none.
    """
    pos, neg = _scores("scores_pos", scores_pos), _scores("scores_neg", scores_neg)
    if not pos.size or not neg.size:
        raise ValueError(f"scores_pos and scores_neg must hold some each, got {pos.size} and {neg.size}")
    neg = np.sort(neg)
    lower, not_higher = np.searchsorted(neg, pos, "left"), np.searchsorted(neg, pos, "right")  # (P,)
    return float((lower + not_higher).sum() / (2 * pos.size * neg.size))


def _scores(name: str, values: ArrayLike) -> NDArray[np.float64]:
    """Return (n,) numbers, infinite ones too."""
    try:
        scores: NDArray[Any] = np.asarray(values)
    except ValueError:  # rows of several lengths
        scores = np.array(None)
    if scores.ndim != 1 or scores.dtype.kind not in "biuf":
        raise ValueError(f"{name} must be numbers in the shape (n,), got {short_repr(values)}")
    if np.isnan(scores).any():
        raise ValueError(f"{name} must not be NaN, got {short_repr(values)}")
    return scores.astype(np.float64)
