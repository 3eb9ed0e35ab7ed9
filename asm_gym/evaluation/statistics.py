"""Statistics of proportions, ranks and resampled means: pure functions of numbers."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from statistics import NormalDist
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.special import betaln, gammainccinv, gammaincinv

from asm_gym.validation import check_number, shown

Floats = NDArray[np.floating[Any]]

RESAMPLES = 2000
"""Of a bootstrap."""


class Share(NamedTuple):
    """``k`` of ``n``."""

    k: int
    n: int

    @property
    def value(self) -> float:
        return self.k / self.n if self.n else math.nan

    @property
    def interval(self) -> tuple[float, float]:
        """95 % Wilson interval."""
        return wilson_interval(self.k, self.n)

    @classmethod
    def of(cls, outcomes: Sequence[bool]) -> Share:
        return cls(sum(map(bool, outcomes)), len(outcomes))


class Rate(NamedTuple):
    """``k`` events in so many ``hours``."""

    k: int
    hours: float

    @property
    def value(self) -> float:
        """An hour; NaN without any time."""
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
        """Of one value a seed; a single one has no deviation, NaN."""
        return cls(float(np.mean(values)), float(np.std(values, ddof=1)) if len(values) > 1 else math.nan)

    def text(self, scale: float = 1.0, digits: int = 3) -> str:
        """``mean ± sd``, each times ``scale``; the mean alone where there is no deviation."""
        if math.isnan(self.sd):
            return f"{scale * self.mean:.{digits}f}"
        return f"{scale * self.mean:.{digits}f} ± {scale * self.sd:.{digits}f}"


def wilson_interval(k: int, n: int, confidence: float = 0.95) -> tuple[float, float]:
    """The score interval of a proportion of ``k`` in ``n`` (Wilson 1927); (0, 1) where ``n`` is 0.

    ``(p + z²/2n ± z √(p(1-p)/n + z²/4n²)) / (1 + z²/n)``
    """
    check_number("n", n, low=0, whole=True)
    check_number("k", k, low=0, high=n, whole=True)
    if n == 0:
        return 0.0, 1.0
    z = NormalDist().inv_cdf(0.5 + _check_confidence(confidence) / 2)
    p, shrink = k / n, 1 + z * z / n
    centre = (p + z * z / (2 * n)) / shrink
    half = z * math.sqrt(p * (1 - p) / n + z * z / (4 * n * n)) / shrink
    # At the ends the bound is exact; rounding would leave 1e-17.
    return (0.0 if k == 0 else centre - half), (1.0 if k == n else centre + half)


def binomial_interval(n: int, p: float, confidence: float = 0.95) -> tuple[int, int]:
    """Counts (lo, hi) that ``n`` trials of probability ``p`` stay within, equal tails: P(k < lo), P(k > hi) <= (1-c)/2.

    For checking a calibration: alarms in n nominal episodes at the false-alarm rate p.
    """
    check_number("p", p, low=0, high=1)
    check_number("n", n, low=0, high=1e7, whole=True)
    tail = (1 - _check_confidence(confidence)) / 2
    if p in (0.0, 1.0):
        return round(n * p), round(n * p)
    log_mass = [
        math.lgamma(n + 1) - math.lgamma(k + 1) - math.lgamma(n - k + 1) + k * math.log(p) + (n - k) * math.log1p(-p)
        for k in range(n + 1)
    ]
    mass = np.exp(log_mass)  # (n + 1,)
    below, above = np.cumsum(mass), np.cumsum(mass[::-1])[::-1]  # P(K <= k), P(K >= k)
    return int(np.argmax(below > tail)), int(n - np.argmax(above[::-1] > tail))


def poisson_interval(k: int, confidence: float = 0.95) -> tuple[float, float]:
    """The exact interval of the mean of a Poisson variable that came to ``k`` (Garwood 1936).

    ``P(K >= k; low) = P(K <= k; high) = (1 - c)/2``, and low = 0 for k = 0. At least a share c of such intervals holds
    the mean. Events that come in clusters are no Poisson variable: count each cluster once.
    """
    check_number("k", k, low=0, high=1e9, whole=True)
    tail = (1 - _check_confidence(confidence)) / 2
    return (float(gammaincinv(k, tail)) if k else 0.0), float(gammainccinv(k + 1, tail))


def chance_of_alarms(k: int, n: int, beyond: int, calibrated: int) -> float:
    """P of at least ``k`` alarms in ``n`` fresh episodes, if ``beyond`` of those ``calibrated`` on exceed a threshold.

    Which share of fresh ones exceeds one of the maxima that it was set on is itself drawn, from Beta(beyond + 1,
    calibrated - beyond): the count is beta-binomial. Takes continuous and exchangeable maxima, and nothing else.
    """
    check_number("beyond", beyond, low=0, high=calibrated - 1, whole=True)
    a, b, j = beyond + 1, calibrated - beyond, np.arange(k, n + 1)
    return float(np.exp(betaln(j + a, n - j + b) - betaln(a, b) - betaln(j + 1, n - j + 1) - math.log(n + 1)).sum())


def auroc(scores_pos: ArrayLike, scores_neg: ArrayLike) -> float:
    """The probability that a positive scores higher than a negative, ties counted half (Mann-Whitney).

    Takes infinite scores, refuses NaN.
    """
    pos, neg = _scores("scores_pos", scores_pos), _scores("scores_neg", scores_neg)
    if not pos.size or not neg.size:
        raise ValueError(f"scores_pos and scores_neg must hold some each, got {pos.size} and {neg.size}")
    neg = np.sort(neg)
    lower, not_higher = np.searchsorted(neg, pos, "left"), np.searchsorted(neg, pos, "right")  # (P,)
    return float((lower + not_higher).sum() / (2 * pos.size * neg.size))


def bootstrap(
    statistic: Callable[[Floats], Floats], pairs: Floats, rng: np.random.Generator, resamples: int = RESAMPLES
) -> Estimate:
    """Percentile interval over resampled episodes (Efron and Tibshirani 1993, ch. 13).

    Args:
        statistic: from (…, n, 2) to (…).
        pairs: (n, 2) what was measured with the policy alone, and with the reflex.
    """
    drawn = statistic(pairs[rng.integers(len(pairs), size=(resamples, len(pairs)))])
    low, high = np.nanquantile(drawn, [0.025, 0.975])
    return Estimate(float(statistic(pairs)), float(low), float(high))


def _scores(name: str, values: ArrayLike) -> NDArray[np.float64]:
    """(n,) numbers, infinite ones too."""
    try:
        scores: NDArray[Any] = np.asarray(values)
    except ValueError:  # rows of several lengths
        scores = np.array(None)
    if scores.ndim != 1 or scores.dtype.kind not in "biuf":
        raise ValueError(f"{name} must be numbers in the shape (n,), got {shown(values)}")
    if np.isnan(scores).any():
        raise ValueError(f"{name} must not be NaN, got {shown(values)}")
    return scores.astype(np.float64)


def _check_confidence(confidence: Any) -> float:
    return check_number("confidence", confidence, above=0, below=1)
