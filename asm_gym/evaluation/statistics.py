"""Statistics of proportions, counts and ranks: pure functions of numbers."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import stats

Floats = NDArray[np.floating[Any]]


class Share(NamedTuple):
    """``k`` of ``n``."""

    k: int
    n: int

    @property
    def value(self) -> float:
        """The proportion; NaN for none of none."""
        if not self.n:
            return math.nan
        return self.k / self.n

    @property
    def interval(self) -> tuple[float, float]:
        """95 % Wilson score interval; (0, 1) for none of none."""
        if not self.n:
            return 0.0, 1.0
        low, high = stats.binomtest(self.k, self.n).proportion_ci(method="wilson")
        return float(low), float(high)

    @classmethod
    def of(cls, outcomes: Sequence[bool] | NDArray[np.bool_]) -> Share:
        """Count the true outcomes."""
        return cls(int(np.count_nonzero(outcomes)), len(outcomes))

    @classmethod
    def total(cls, shares: Sequence[Share]) -> Share:
        """Add the counts of several shares."""
        return cls(sum(share.k for share in shares), sum(share.n for share in shares))


class Rate(NamedTuple):
    """``k`` events in so many ``hours``."""

    k: int
    hours: float

    @property
    def value(self) -> float:
        """Events per hour; NaN without any time."""
        if not self.hours:
            return math.nan
        return self.k / self.hours

    @property
    def interval(self) -> tuple[float, float]:
        """95 % exact Poisson interval [1/h] (Garwood 1936); events that come in clusters count once."""
        if not self.hours:
            return 0.0, math.inf
        low = 0.0
        if self.k:
            low = float(stats.gamma.ppf(0.025, self.k) / self.hours)
        return low, float(stats.gamma.isf(0.025, self.k + 1) / self.hours)

    @property
    def text(self) -> str:
        """``value (low to high)``; empty without any time."""
        if not self.hours:
            return ""
        low, high = self.interval
        return f"{self.value:.1f} ({low:.1f} to {high:.1f})"


class Estimate(NamedTuple):
    """A number and its 95 % interval, of a bootstrap or of Student's t."""

    value: float
    low: float
    high: float

    @classmethod
    def of_mean(cls, values: Sequence[float]) -> Estimate:
        """Return the mean of one value a seed, with the interval of Student's t; NaN for that of a single one."""
        mean = float(np.mean(values))
        if len(values) < 2:
            return cls(mean, math.nan, math.nan)
        error = float(np.std(values, ddof=1)) / math.sqrt(len(values))
        half = float(stats.t.ppf(0.975, len(values) - 1)) * error
        return cls(mean, mean - half, mean + half)

    def text(self, digits: int = 1) -> str:
        """``value (low to high)``; the value alone without an interval."""
        value = f"{self.value:,.{digits}f}"
        if math.isnan(self.low):
            return value
        return f"{value} ({self.low:,.{digits}f} to {self.high:,.{digits}f})"


class Spread(NamedTuple):
    """Mean and standard deviation over seeds."""

    mean: float
    sd: float

    @classmethod
    def of(cls, values: Sequence[float]) -> Spread:
        """Summarise one value per seed; the deviation of a single one is NaN."""
        deviation = math.nan
        if len(values) > 1:
            deviation = float(np.std(values, ddof=1))
        return cls(float(np.mean(values)), deviation)

    def text(self, digits: int = 3) -> str:
        """``mean ± sd``; the mean alone without a deviation."""
        if math.isnan(self.sd):
            return f"{self.mean:.{digits}f}"
        return f"{self.mean:.{digits}f} ± {self.sd:.{digits}f}"


def auroc(positive: Floats, negative: Floats) -> float:
    """Return the probability that a positive (n,) scores higher than a negative (m,), ties counted half."""
    test = stats.mannwhitneyu(positive, negative, method="asymptotic", nan_policy="raise")
    return float(test.statistic / (len(positive) * len(negative)))
