"""The running threshold: its bound on any sequence, the rate it keeps under drift, and what it does not learn."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from asm_gym.detection import AdaptiveThreshold


def alarms_of(how: AdaptiveThreshold, maxima: np.ndarray, start: float = 1.0) -> np.ndarray:
    """(K,) which episodes of these maxima alarm."""
    running, alarms = how.start(start), []
    for largest in maxima:
        alarms.append(largest > running.value)
        running.follow(largest)
    return np.array(alarms)


@given(
    maxima=st.lists(st.floats(0.01, 3.999), min_size=1, max_size=300),
    rate=st.floats(0.01, 0.5),
    step=st.floats(0.05, 2.0),
)
@settings(max_examples=200, deadline=None)
def test_whatever_the_episodes_are_no_more_alarm_than_the_bound(maxima, rate, step):
    how = AdaptiveThreshold(rate, step, ceiling=4.0)
    assert alarms_of(how, np.array(maxima)).sum() <= rate * len(maxima) + math.log(4.0) / step + 1 + 1e-9


def test_an_adversary_who_knows_the_threshold_reaches_the_bound_and_no_more():
    how, running, alarms = AdaptiveThreshold(0.05, 0.1), AdaptiveThreshold(0.05, 0.1).start(1.0), 0
    for _ in range(400):
        worst = min(running.value * 1.0001, running.ceiling)
        alarms += worst > running.value
        running.follow(worst)
    bound = 0.05 * 400 + math.log(how.ceiling) / how.step + 1
    assert bound - 2 <= alarms <= bound


@pytest.mark.parametrize("rate", [0.02, 0.1])
def test_the_rate_is_kept_where_a_policy_changes_in_a_step_and_slowly(rate):
    rng = np.random.default_rng(0)
    usual = rng.lognormal(0.0, 0.3, size=4000)
    step = usual * np.where(np.arange(4000) < 2000, 1.0, 2.5)
    slow = usual * np.exp(np.linspace(0.0, math.log(2.5), 4000))
    start = float(np.quantile(usual, 1 - rate))
    fixed = float((step[2000:] > start).mean())
    assert fixed > 5 * rate  # what the calibrated threshold would come to
    for maxima in (usual, step, slow):
        alarms = alarms_of(AdaptiveThreshold(rate, 0.1, ceiling=10.0), maxima, start)
        assert alarms[1000:].mean() == pytest.approx(rate, rel=0.4)  # 3 standard deviations of 3000 draws at 2 %


def test_a_policy_that_calms_down_is_watched_more_closely():
    rng = np.random.default_rng(1)
    calm = rng.lognormal(-1.0, 0.2, size=3000)
    running = AdaptiveThreshold(0.05, 0.1).start(1.0)
    for largest in calm:
        running.follow(largest)
    assert running.value == pytest.approx(np.quantile(calm, 0.95), rel=0.2)


def test_faults_above_the_ceiling_alarm_for_ever_and_teach_nothing():
    running = AdaptiveThreshold(0.01, 0.5, ceiling=3.0).start(1.0)
    for _ in range(1000):
        assert running.value < 3.1
        running.follow(3.1)
    assert running.value == pytest.approx(1.0)
    assert math.isnan(running.level)
    running.follow(math.inf)
    running.follow(math.nan)
    assert running.value == pytest.approx(1.0)


def test_what_was_confirmed_teaches_nothing_and_what_was_not_does():
    running = AdaptiveThreshold(0.01, 0.5).start(1.0)
    running.follow(2.0, confirmed=True)
    assert running.value == pytest.approx(1.0)
    running.follow(2.0)
    assert running.value == pytest.approx(math.exp(0.5 * 0.99))
    assert running.level == 1.0
    running.follow(1.0, confirmed=True)  # nothing alarmed, so that there was nothing to confirm
    assert running.level == 0.5


def test_an_episode_is_judged_by_the_threshold_that_it_began_with():
    running = AdaptiveThreshold(0.1, 0.5).start(1.0)
    for _ in range(3):  # three side by side
        running.follow(1.2, judged_by=1.0)
    assert running.level == 1.0


@pytest.mark.parametrize("wrong", [{"rate": 0.0}, {"rate": 1.0}, {"step": 0.0}, {"ceiling": 1.0}, {"step": math.nan}])
def test_settings_that_mean_nothing_are_refused_by_name(wrong):
    with pytest.raises(ValueError, match=next(iter(wrong))):
        AdaptiveThreshold(**wrong)
