"""What stated probabilities are worth: how often what was stated so is right."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from asm_gym.evaluation.statistics import Estimate, Floats, bootstrap


class Reliability(NamedTuple):
    """How often statements are right, by their probability.

    Attributes:
        stated: (B,) mean probability in each bin; NaN where there are no rows.
        right: for each bin the share that is right; NaN where there are no rows.
        rows, episodes: (B,) how many.
        error: expected calibration error: the mean over rows of how far the share and the mean of their bin are apart.
    """

    stated: NDArray[np.float64]
    right: list[Estimate]
    rows: NDArray[np.intp]
    episodes: NDArray[np.intp]
    error: Estimate


def reliability(
    stated: Floats, right: NDArray[np.bool_], episodes: NDArray[np.int_], edges: Sequence[float]
) -> Reliability:
    """Of N statements in E episodes, which are resampled whole, for rows of one are much alike.

    Args:
        stated: (N,) probabilities.
        right: (N,) what came of it.
        episodes: (N,) of which episode each is.
        edges: (B + 1,) of the bins, rising; each holds its lower edge, and the last one both.

    Raises:
        ValueError: there are none, or one outside of all bins.
    """
    if not stated.size or stated.min() < edges[0] or stated.max() > edges[-1]:
        raise ValueError(f"statements must be some, of {edges[0]} to {edges[-1]}, got {stated}")
    own, episode = np.unique(episodes, return_inverse=True)
    which = np.minimum(np.searchsorted(edges, stated, "right"), len(edges) - 1) - 1
    sums = np.zeros((len(own), len(edges) - 1, 3))
    np.add.at(sums, (episode, which), np.stack([np.ones(len(stated)), stated, right], axis=1))

    def share(of: Floats) -> Floats:
        return np.asarray(of[..., 2].sum(axis=-1) / of[..., 0].sum(axis=-1))

    def error(of: Floats) -> Floats:
        total = of.sum(axis=-3)
        return np.asarray(np.abs(total[..., 1] - total[..., 2]).sum(axis=-1) / total[..., 0].sum(axis=-1))

    rng = np.random.default_rng(0)
    in_bins = [of[of[:, 0] > 0] for of in np.moveaxis(sums, 1, 0)]
    shares = [bootstrap(share, of, rng) if len(of) else Estimate(math.nan, math.nan, math.nan) for of in in_bins]
    rows, probabilities, _ = sums.sum(axis=0).T
    with np.errstate(invalid="ignore"):
        means = probabilities / rows
    return Reliability(
        means, shares, rows.astype(np.intp), np.array([len(of) for of in in_bins]), bootstrap(error, sums, rng)
    )
