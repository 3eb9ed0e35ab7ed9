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
    def of(cls, outcomes: Sequence[bool] | NDArray[np.bool_]) -> Share:
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
        """95 % exact Poisson interval [1/h] (Garwood 1936); events that come in clusters count once."""
        low = stats.gamma.ppf(0.025, self.k) if self.k else 0.0
        high = stats.gamma.isf(0.025, self.k + 1)
        return (float(low / self.hours), float(high / self.hours)) if self.hours else (0.0, math.inf)

    @property
    def text(self) -> str:
        """``value (low to high)``; empty without any time."""
        return f"{self.value:.1f} ({self.interval[0]:.1f} to {self.interval[1]:.1f})" if self.hours else ""


class Estimate(NamedTuple):
    """A number and its 95 % bootstrap interval."""

    value: float
    low: float
    high: float


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


def wilson_interval(k: int, n: int) -> tuple[float, float]:
    """Return the 95 % score interval of the proportion ``k`` in ``n`` (Wilson 1927); (0, 1) where ``n`` is 0."""
    check_number("k", k, low=0, high=n, whole=True)
    if n == 0:
        return 0.0, 1.0
    found = stats.binomtest(k, n).proportion_ci(method="wilson")
    return float(found.low), float(found.high)


def auroc(scores_pos: ArrayLike, scores_neg: ArrayLike) -> float:
    """Return the probability that a positive scores higher than a negative, ties counted half (Mann-Whitney).

    Raises:
        ValueError: a score is NaN (infinite ones are fine), or one of the two holds none.
    """
    pos, neg = np.asarray(scores_pos, np.float64), np.asarray(scores_neg, np.float64)
    for name, scores in (("scores_pos", pos), ("scores_neg", neg)):
        if scores.ndim != 1 or not scores.size or np.isnan(scores).any():
            raise ValueError(f"{name} must be numbers in the shape (n,), some and none NaN, got {short_repr(scores)}")
    ranks = stats.rankdata(np.concatenate([pos, neg]))[: pos.size]
    return float((ranks.sum() - pos.size * (pos.size + 1) / 2) / (pos.size * neg.size))
