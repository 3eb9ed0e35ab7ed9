"""The promise of a false-alarm rate: the law of how many of exchangeable episodes alarm (Vovk 2012, Proposition 2)."""

import numpy as np
import pytest
from scipy.stats import betabinom

from asm_gym.detection import conformal_threshold

RATES = (0.01, 0.05, 0.2)


def surprise(rng: np.random.Generator, episodes: int) -> np.ndarray:
    """(episodes,) the largest of some heavy-tailed, dependent values in each."""
    walks = rng.standard_t(2, size=(episodes, 30)).cumsum(axis=1)
    return np.abs(walks).max(axis=1)


@pytest.mark.parametrize("rate", RATES)
def test_the_number_of_alarms_is_beta_binomial_whatever_the_surprise(rate):
    rng, n, fresh = np.random.default_rng(0), 199, 300
    counts = []
    for _ in range(1500):
        threshold = conformal_threshold(surprise(rng, n), rate)
        counts.append(int((surprise(rng, fresh) > threshold).sum()))
    law = betabinom(fresh, rate * (n + 1), (1 - rate) * (n + 1))
    spread = law.std() / np.sqrt(len(counts))
    assert np.mean(counts) / fresh == pytest.approx(rate, abs=4 * spread / fresh)
    for quantile in (0.1, 0.5, 0.9):
        at_most = np.mean(np.array(counts) <= law.ppf(quantile))
        assert at_most == pytest.approx(law.cdf(law.ppf(quantile)), abs=4 * np.sqrt(0.25 / len(counts)))
