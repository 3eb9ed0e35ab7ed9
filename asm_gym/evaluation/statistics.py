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
        return self.k / self.n if self.n else math.nan

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
        return (
            (float(low / self.hours), float(high / self.hours)) if self.hours else (0.0, math.inf)
        )

    @property
    def text(self) -> str:
        """``value (low to high)``; empty without any time."""
        return (
            f"{self.value:.1f} ({self.interval[0]:.1f} to {self.interval[1]:.1f})"
            if self.hours
            else ""
        )


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
        return cls(
            float(np.mean(values)), float(np.std(values, ddof=1)) if len(values) > 1 else math.nan
        )

    def text(self, scale: float = 1.0, digits: int = 3) -> str:
        """``mean ± sd``, each times ``scale``; the mean alone without a deviation."""
        deviation = "" if math.isnan(self.sd) else f" ± {scale * self.sd:.{digits}f}"
        return f"{scale * self.mean:.{digits}f}{deviation}"


def auroc(positive: Floats, negative: Floats) -> float:
    """Return the probability that a positive (n,) scores higher than a negative (m,), ties counted half."""
    found = stats.mannwhitneyu(positive, negative, method="asymptotic", nan_policy="raise")
    return float(found.statistic / (len(positive) * len(negative)))
