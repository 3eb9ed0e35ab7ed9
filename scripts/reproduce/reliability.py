"""How often statements with a stated probability are right."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from asm_gym.evaluation.statistics import RESAMPLES, Estimate, Floats


class Reliability(NamedTuple):
    """How often statements are right, by their probability.

    Attributes:
        stated: (B,) mean probability in each bin; NaN without rows.
        right: for each bin the share that is right; NaN without rows.
        rows, episodes: (B,) how many.
        error: expected calibration error: the mean over rows of the difference of both in their bin.
    """

    stated: NDArray[np.float64]
    right: list[Estimate]
    rows: NDArray[np.intp]
    episodes: NDArray[np.intp]
    error: Estimate


def reliability(
    stated: Floats, right: NDArray[np.bool_], episodes: NDArray[np.int_], edges: Sequence[float]
) -> Reliability:
    """Bin N statements, with percentile intervals over resampled episodes (Efron and Tibshirani 1993, ch. 13).

    Args:
        stated: (N,) probabilities.
        right: (N,) whether each was right.
        episodes: (N,) the episode of each.
        edges: (B + 1,) of the bins, rising; each holds its lower edge, and the last one both.

    Raises:
        ValueError: there are none, or one outside of all bins.
    """
    if not stated.size or stated.min() < edges[0] or stated.max() > edges[-1]:
        raise ValueError(f"statements must be some, of {edges[0]} to {edges[-1]}, got {stated}")
    own, episode = np.unique(episodes, return_inverse=True)
    which = np.minimum(np.searchsorted(edges, stated, "right"), len(edges) - 1) - 1
    sums = np.zeros((len(own), len(edges) - 1, 3))  # rows, probabilities, right ones
    np.add.at(sums, (episode, which), np.stack([np.ones(len(stated)), stated, right], axis=1))
    rng = np.random.default_rng(0)
    bins = [part[part[:, 0] > 0] for part in np.moveaxis(sums, 1, 0)]
    shares = [_bootstrap(_share, part, rng) if len(part) else Estimate(*3 * [math.nan]) for part in bins]
    rows, probabilities, _ = sums.sum(axis=0).T
    with np.errstate(invalid="ignore"):
        means = probabilities / rows
    counts = np.array([len(part) for part in bins])
    return Reliability(means, shares, rows.astype(np.intp), counts, _bootstrap(_error, sums, rng))


def _share(sums: Floats) -> float:
    return float(sums[:, 2].sum() / sums[:, 0].sum())


def _error(sums: Floats) -> float:
    total = sums.sum(axis=0)
    return float(np.abs(total[:, 1] - total[:, 2]).sum() / total[:, 0].sum())


def _bootstrap(statistic: Callable[[Floats], float], sums: Floats, rng: np.random.Generator) -> Estimate:
    drawn = [statistic(sums[rng.integers(len(sums), size=len(sums))]) for _ in range(RESAMPLES)]
    low, high = np.quantile(drawn, [0.025, 0.975])
    return Estimate(statistic(sums), float(low), float(high))
