"""Statistics against published tables, scipy, and values worked out by hand."""

from __future__ import annotations

import math
from itertools import product

import numpy as np
import pytest
from scipy import stats

from asm_gym.evaluation.statistics import (
    Estimate,
    Rate,
    Spread,
    auroc,
    binomial_interval,
    bootstrap,
    poisson_interval,
    wilson_interval,
)


@pytest.mark.parametrize(
    ("k", "n", "low", "high"),
    [(81, 263, 0.2553, 0.3662), (15, 148, 0.0624, 0.1605), (0, 20, 0.0, 0.1611), (1, 29, 0.0061, 0.1718)],
)
def test_wilson_gives_the_intervals_of_newcombe_1998(k: int, n: int, low: float, high: float):
    assert wilson_interval(k, n) == pytest.approx((low, high), abs=5e-5)


def test_wilson_knows_nothing_from_no_trials_and_is_symmetric():
    assert wilson_interval(0, 0) == (0.0, 1.0)
    low, high = wilson_interval(3, 20)
    assert wilson_interval(17, 20) == pytest.approx((1 - high, 1 - low))
    assert wilson_interval(20, 20)[1] == 1.0


@pytest.mark.parametrize(
    ("k", "low", "high"),
    [(0, 0.0, 3.6889), (1, 0.0253, 5.5716), (5, 1.6235, 11.6683), (10, 4.7954, 18.3904), (100, 81.3640, 121.6268)],
)
def test_poisson_gives_the_intervals_of_garwood_1936(k: int, low: float, high: float):
    assert poisson_interval(k) == pytest.approx((low, high), abs=5e-5)


@pytest.mark.parametrize("confidence", [0.5, 0.95, 0.999])
@pytest.mark.parametrize("k", [0, 1, 7, 240])
def test_poisson_ends_are_where_a_tail_is_left(k: int, confidence: float):
    low, high = poisson_interval(k, confidence)
    tail = (1 - confidence) / 2
    assert stats.poisson.cdf(k, high) == pytest.approx(tail)
    assert (low == 0.0) if k == 0 else stats.poisson.sf(k - 1, low) == pytest.approx(tail)


def test_a_rate_is_by_the_hour_and_knows_nothing_from_no_time():
    assert Rate(37, 3.6).value == pytest.approx(37 / 3.6)
    assert Rate(5, 2.0).interval == pytest.approx((1.6235 / 2, 11.6683 / 2), abs=5e-5)
    assert Rate(5, 2.0).text == "2.5 (0.8 to 5.8)"
    assert Rate(0, 0.0).text == ""
    assert math.isnan(Rate(0, 0.0).value)
    assert Rate(0, 0.0).interval == (0.0, math.inf)


@pytest.mark.parametrize("k", [-1, 1.5, "3", math.inf])
def test_poisson_refuses_impossible_counts(k):
    with pytest.raises(ValueError, match="k must be a whole number"):
        poisson_interval(k)


def test_wilson_refuses_impossible_counts():
    with pytest.raises(ValueError, match=r"k must be a whole number in \[0, 2\], got 3"):
        wilson_interval(3, 2)
    with pytest.raises(ValueError, match=r"confidence must be a number in \(0, 1\), got 95"):
        wilson_interval(1, 2, confidence=95)


def test_binomial_interval_of_four_coins_by_hand():
    # P(0) = P(4) = 1/16: with tails of at most 5 % both stay in, with tails of at most 10 % both fall out.
    assert binomial_interval(4, 0.5, confidence=0.9) == (0, 4)
    assert binomial_interval(4, 0.5, confidence=0.8) == (1, 3)


@pytest.mark.parametrize(("n", "p", "confidence"), [*product((1, 30, 500), (0.01, 0.3, 0.87), (0.8, 0.95, 0.999))])
def test_binomial_interval_is_that_of_scipy(n: int, p: float, confidence: float):
    assert binomial_interval(n, p, confidence) == tuple(map(int, stats.binom.interval(confidence, n, p)))


def test_binomial_interval_of_certainty_is_a_point():
    assert binomial_interval(7, 0.0, 0.95) == (0, 0)
    assert binomial_interval(7, 1.0, 0.95) == (7, 7)
    assert binomial_interval(0, 0.5, 0.95) == (0, 0)


def test_auroc_counts_pairs_and_half_of_ties():
    # Of the six pairs 3 > 1, 3 > 2, 2 > 1 are won, 2 = 2 is tied, and 1 < 2 is lost and 1 = 1 tied: 4 of 6.
    assert auroc([3, 2, 1], [1, 2]) == pytest.approx(4 / 6)


def test_auroc_is_the_mann_whitney_statistic():
    rng = np.random.default_rng(0)
    pos, neg = rng.integers(0, 9, 40), rng.integers(0, 7, 60)
    assert auroc(pos, neg) == pytest.approx(stats.mannwhitneyu(pos, neg).statistic / (40 * 60))


def test_auroc_takes_infinity_and_refuses_nan_and_nothing():
    assert auroc([math.inf, math.inf], [1.0, math.inf]) == pytest.approx(0.75)
    with pytest.raises(ValueError, match="must not be NaN"):
        auroc([math.nan], [1.0])
    with pytest.raises(ValueError, match="scores_pos and scores_neg must hold some each, got 0 and 1"):
        auroc([], [1.0])
    with pytest.raises(ValueError, match=r"scores_neg must be numbers in the shape \(n,\), got \[\[1\], \[2, 3\]\]"):
        auroc([1.0], [[1], [2, 3]])


def gain(pairs):
    """Mean difference, second less first."""
    return pairs[..., 1].mean(axis=-1) - pairs[..., 0].mean(axis=-1)


def test_the_bootstrap_interval_of_a_mean_is_about_the_normal_one():
    rng = np.random.default_rng(0)
    pairs = np.stack([np.zeros(400), rng.normal(1.0, 2.0, 400)], axis=1)
    estimate = bootstrap(gain, pairs, rng)
    half = 1.96 * pairs[:, 1].std() / 20
    assert estimate.value == pytest.approx(pairs[:, 1].mean())
    assert estimate.low == pytest.approx(estimate.value - half, abs=0.03)
    assert estimate.high == pytest.approx(estimate.value + half, abs=0.03)


def test_a_spread_is_mean_and_sample_deviation():
    assert Spread.of([1.0, 2.0, 3.0]) == (2.0, 1.0)
    assert Spread.of([0.5]).text(100, 1) == "50.0"
    assert Spread.of([1.0, 2.0, 3.0]).text(digits=1) == "2.0 ± 1.0"


def test_an_estimate_is_told_in_percent_where_there_is_one():
    assert Estimate(0.5, 0.25, 0.75).percent() == "50 % (25 to 75)"
    assert Estimate(math.nan, math.nan, math.nan).percent("none") == "none"
