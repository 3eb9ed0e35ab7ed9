"""Laws of speed and accuracy, fitted by least squares.

    exponential   e = limit + gain exp(-n/τ)        n the time of inference
    fitts         e = gain exp(-n/τ)                Fitts' law, n = a + b log2 1/e
    power         e = limit + gain n^-exponent
    linear        e = start + slope v                     v the speed
    log           e = start + slope ln v                  errors as amplitude over time has them

Sources: Fitts 1954 (J. Exp. Psychol. 47(6)); Wickelgren 1977 (Acta Psychologica 41(1)); Schmidt et al. 1979
(Psychological Review 86(5)); Akaike 1974 for the comparison.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import curve_fit
from scipy.stats import t as student


class Fit(NamedTuple):
    """A law fitted to points by least squares."""

    law: str
    names: tuple[str, ...]
    values: tuple[float, ...]
    low: tuple[float, ...]  # ends of the 95 % intervals
    high: tuple[float, ...]
    aic: float  # Akaike's criterion; the smaller, the better

    @property
    def text(self) -> str:
        """Each parameter with its interval."""
        parts = zip(self.names, self.values, self.low, self.high, strict=True)
        return ", ".join(f"{n} = {v:.3g} ({lo:.3g} to {hi:.3g})" for n, v, lo, hi in parts)


LAWS: dict[str, tuple[Callable[..., Any], tuple[str, ...]]] = {
    "exponential": (lambda n, limit, gain, tau: limit + gain * np.exp(-n / tau), ("limit", "gain", "τ")),
    "fitts": (lambda n, gain, tau: gain * np.exp(-n / tau), ("gain", "τ")),
    "power": (lambda n, limit, gain, slope: limit + gain * n**-slope, ("limit", "gain", "exponent")),
    "linear": (lambda v, start, slope: start + slope * v, ("start", "slope")),
    "log": (lambda v, start, slope: start + slope * np.log(v), ("start", "slope")),
}


def fit(law: str, x: NDArray[np.float64], y: NDArray[np.float64]) -> Fit | None:
    """The law that is nearest to the points, with intervals from the curvature of the fit; None where there is none."""
    function, names = LAWS[law]
    first, last = float(y[0]), float(y[-1])
    guess = {
        "exponential": [last, first - last, 5.0],
        "fitts": [first, 5.0],
        "power": [last, first - last, 1.0],
        "linear": [first, 0.0],
        "log": [first, 0.0],
    }[law]
    free, ends = [np.inf] * (len(names) - 1), (-np.inf, np.inf) if law in ("linear", "log") else (1e-2, 1e3)
    bounds = [*(-x for x in free), ends[0]], [*free, ends[1]]
    try:
        values, covariance = curve_fit(function, x, y, p0=guess, bounds=bounds, maxfev=20_000)
    except RuntimeError:
        return None
    count, parameters = len(x), len(names)
    residual = max(float(np.sum((y - function(x, *values)) ** 2)), 1e-300)
    half = student.ppf(0.975, max(1, count - parameters)) * np.sqrt(np.diag(covariance))
    aic = count * math.log(residual / count) + 2 * (parameters + 1)
    return Fit(law, names, tuple(values), tuple(values - half), tuple(values + half), aic)
