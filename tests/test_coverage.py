"""The promise of a false-alarm rate: kept where episodes are exchangeable, and seen to be broken where they are not."""

import numpy as np
import pytest
from scipy.stats import betabinom

from asm_gym.detection import conformal_threshold
from asm_gym.scripts.benchmark.coverage import CONFIDENCE, CoverageCheck, covered

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


@pytest.mark.parametrize("rate", RATES)
def test_a_promise_that_is_kept_is_called_kept_and_one_that_is_broken_is_not(rate):
    rng = np.random.default_rng(1)
    kept = [covered(surprise(rng, 200), surprise(rng, 1000), rate, rng).kept for _ in range(60)]
    assert np.mean(kept) >= CONFIDENCE - 4 * np.sqrt(CONFIDENCE * (1 - CONFIDENCE) / 60)
    broken = covered(surprise(rng, 200), 10 * surprise(rng, 1000), rate, rng)
    assert not broken.kept
    assert broken.alarms.k > broken.interval[1]


def test_on_average_over_calibration_sets_the_promise_holds_exactly():
    rng = np.random.default_rng(2)
    found = covered(surprise(rng, 199), surprise(rng, 1000), 0.05, rng)
    assert found.redrawn == pytest.approx(0.05, abs=0.004)


def test_a_rate_that_the_calibration_episodes_cannot_promise_is_refused():
    with pytest.raises(ValueError, match=r"a rate of 0\.001 needs 999 calibration_episodes, got 200"):
        CoverageCheck(rates=(0.001,))
