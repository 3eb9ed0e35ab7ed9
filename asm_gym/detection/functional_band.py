"""A band in time: how high the score of an episode usually is after so many rows, and how far it strays from that.

    s_t                        mean over the last 5 rows of Σ_i ε_i²             as ``moving_mean`` has it
    μ_t                        mean over episodes of s_t
    h_t                        max over episodes k of |s_k,t - μ_t|              of all but those that stray farthest
    z_t = (s_t - μ_t)/h_t      value (1 + |z_t|)^sign(z_t)                       grows with z_t, and is never negative

A score leaves the upper band μ_t + q h_t where z_t > q, and the q of functional conformal prediction is the quantile
over other episodes of their greatest z_t. That is what every monitor's threshold is of its value, so this detection
gives μ and h alone, from nominal episodes that the model has not learned; calibration does the rest, on others.

A band has to know how far the task has come, and says nothing of which task it is: episodes of several share one band.
One that ends early keeps its last score, and rows later than all of them are judged by the last of the band.

Sources: Xu et al. 2025 (RSS), “Can we detect failures without failure data?”; Diquigiovanni, Fontana and Vantini 2022
(Journal of Multivariate Analysis 189) for h.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from asm_gym.detection.base import Arrays, ModelOutput, Nominal, Place
from asm_gym.detection.evidence import TINY
from asm_gym.detection.scores import WINDOW, MovingMean
from asm_gym.spec import StreamSpec
from asm_gym.validation import check_number, typed

NARROWEST = 1e-8
"""Lower bound of h: where a single episode is left, it strays from nothing."""


class BandState(NamedTuple):
    """What is carried from row to row."""

    recent: NDArray[np.float64]  # (B, WINDOW, X) squared errors
    rows: NDArray[np.int64]  # (B,) how many were seen


class FunctionalBand(MovingMean):
    """The moving mean of squared errors, over what it usually is after so many rows.

    Args:
        spec: the stream that is watched.
        trimmed: share of the episodes, those that stray farthest, that do not widen the band.
    """

    name = "band"
    arrays = ("band_mean", "band_width")

    @typed
    def __init__(self, spec: StreamSpec, trimmed: float = 0.05) -> None:
        super().__init__(spec)
        self.trimmed = check_number("trimmed", trimmed, low=0.0, below=1.0)

    def fit(self, nominal: Nominal, rng: np.random.Generator) -> Self:
        scores = padded([moving_score(self.parts(r)) for r in nominal.outputs(nominal.held_out)])
        mean, width = band(scores, self.trimmed)
        return self.restore({"band_mean": mean, "band_width": width})

    def restore(self, learned: Arrays) -> Self:
        mean, width = learned["band_mean"], learned["band_width"]
        if mean.ndim != 1 or mean.shape != width.shape or not len(mean) or not (width > 0.0).all():
            raise ValueError("a band must have a mean and a width above 0 for each row")
        return super().restore(learned)

    def start(self, batch: int, errors: int) -> Any:
        return BandState(super().start(batch, errors), np.zeros(batch, np.int64))

    def attribute_step(
        self, state: Any, output: ModelOutput, rows: NDArray[np.float64], place: Place
    ) -> tuple[BandState, NDArray[np.float64]]:
        recent, shares = super().attribute_step(state.recent, output, rows, place)
        score = shares.sum(axis=1)  # (B,)
        t = np.minimum(state.rows, len(self.learned_["band_mean"]) - 1)
        z = (score - self.learned_["band_mean"][t]) / self.learned_["band_width"][t]
        value = (1.0 + np.abs(z)) ** np.sign(z)
        return BandState(recent, state.rows + 1), shares * (value / np.maximum(score, TINY))[:, None]


def moving_score(squared: NDArray[np.float64]) -> NDArray[np.float64]:
    """s (T,) of the squared errors (T, X) of an episode: the mean of the last rows, of fewer at first."""
    total = np.concatenate([[0.0], np.cumsum(squared.sum(axis=1))])  # (T + 1,)
    ends = np.arange(1, len(total))
    starts = np.maximum(ends - WINDOW, 0)
    found: NDArray[np.float64] = (total[ends] - total[starts]) / (ends - starts)
    return found


def padded(scores: Sequence[NDArray[np.float64]]) -> NDArray[np.float64]:
    """(n, T) the scores of n episodes, each going on with its last to the end of the longest."""
    longest = max(map(len, scores))
    return np.array([np.pad(s, (0, longest - len(s)), mode="edge") for s in scores])


def band(scores: NDArray[np.float64], trimmed: float) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """μ (T,) and h (T,) of the scores (n, T) of nominal episodes.

    The width is that of the ⌈(n + 1)(1 - trimmed)⌉ episodes that stray least, or of all n where that is more.
    """
    mean = scores.mean(axis=0)
    strays = np.abs(scores - mean)  # (n, T)
    farthest = strays.max(axis=1)  # (n,)
    rank = min(math.ceil((len(scores) + 1) * (1.0 - trimmed) - 1e-9), len(scores))
    width = strays[farthest <= np.sort(farthest)[rank - 1]].max(axis=0)
    return mean, np.maximum(width, NARROWEST)
