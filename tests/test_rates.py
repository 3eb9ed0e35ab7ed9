"""A rate is refused where chance would hardly leave so few successes, and seldom where it holds."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.stats import binom

from tests.rates import CHANCE, failures, too_few


@pytest.mark.parametrize(("n", "rate", "least"), [(10, 0.95, 6), (10, 0.9, 5), (100, 0.95, 87), (30, 0.5, 7)])
def test_the_bound_is_the_lower_tail_of_the_binomial_distribution(n, rate, least):
    assert binom.cdf(least - 1, n, rate) < CHANCE <= binom.cdf(least, n, rate)
    assert too_few(least - 1, n, rate)
    assert not too_few(least, n, rate)


def test_where_the_first_few_succeed_the_others_are_not_tried():
    tried = []
    assert failures(lambda seed: tried.append(seed) or "", range(10), 0.95) == []
    assert tried == [0, 1]


def test_what_fails_once_is_tried_on_all_seeds_and_what_fails_often_is_named():
    tried = []
    assert failures(lambda seed: tried.append(seed) or "dropped" * (seed == 0), range(10), 0.95) == []
    assert tried == list(range(10))
    assert failures(lambda seed: "dropped", range(4, 14), 0.95)[:2] == ["seed 4: dropped", "seed 5: dropped"]


def test_a_rate_that_holds_is_refused_as_seldom_as_promised():
    rng = np.random.default_rng(0)
    refused = sum(bool(failures(lambda _: "no" * (rng.random() > 0.8), range(10), 0.8)) for _ in range(5000))
    assert refused <= 5000 * CHANCE + 4 * np.sqrt(5000 * CHANCE)
