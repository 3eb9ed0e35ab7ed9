"""Promises by the hour: kept on fresh operation, counted as is said, and refused where they cannot be made."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import stats

from asm_gym.detection import Blocks, Promise, alarms_in, hourly_promise, hourly_threshold
from asm_gym.detection.hourly import MINUTE

DT = 0.05
ROWS = round(MINUTE / DT)


def operation(rng: np.random.Generator, hours: float, mean_s: float = 9.0) -> list[np.ndarray]:
    """Values of episodes of very different lengths whose rows hang together: bursts, and a level of each episode."""
    found: list[np.ndarray] = []
    left = hours * 3600 / DT
    while left > 0:
        steps = max(10, int(rng.exponential(mean_s / DT)))
        burst = np.convolve(rng.standard_t(4, steps + 20), np.ones(20) / 4, "valid")[:steps]
        found.append(np.exp(0.5 * burst + rng.normal(0, 0.5)))
        left -= steps
    return found


def test_a_threshold_is_the_hand_computed_rank():
    blocks = Blocks(np.array([5.0, 1.0, 9.0, 3.0, 7.0]), np.full(5, 0.5))  # 2.5 hours
    assert hourly_threshold(blocks, 0.4) == 9.0  # none may exceed it: 0 + 1 <= 0.4 * 2.5
    assert hourly_threshold(blocks, 0.79) == 9.0
    assert hourly_threshold(blocks, 0.8) == 7.0  # one may: 1 + 1 <= 0.8 * 2.5
    assert hourly_threshold(blocks, 1.2) == 5.0
    assert hourly_threshold(blocks, 100.0) == 1.0


def test_episodes_are_blocks_and_longer_ones_are_cut_into_minutes():
    long = np.zeros(2 * ROWS + 10)
    long[[3, ROWS - 1, ROWS, 2 * ROWS + 5]] = [1.0, 4.0, 2.0, 3.0]
    blocks = Blocks.of([np.array([0.5, 0.2]), long], DT)
    assert blocks.maxima.tolist() == [0.5, 4.0, 2.0, 3.0]
    np.testing.assert_allclose(blocks.hours * 3600, [2 * DT, MINUTE, MINUTE, 10 * DT])
    assert blocks.total == pytest.approx((len(long) + 2) * DT / 3600)


def test_an_alarm_that_persists_or_comes_back_within_a_minute_is_one():
    value = np.zeros(5 * ROWS)
    assert alarms_in(value, 1.0, DT) == 0
    value[10 : 3 * ROWS] = 2.0
    assert alarms_in(value, 1.0, DT) == 1
    value[3 * ROWS + ROWS // 2] = 2.0  # half a minute after
    assert alarms_in(value, 1.0, DT) == 1
    value[-1] = np.inf
    assert alarms_in(value, 1.0, DT) == 2


@pytest.mark.parametrize("seed", range(5))
def test_there_are_never_more_alarms_than_blocks_in_alarm(seed):
    rng = np.random.default_rng(seed)
    for value in (rng.exponential(size=7 * ROWS + 13) for _ in range(20)):
        for q in np.quantile(value, [0.5, 0.99, 0.9998]):
            assert alarms_in(value, q, DT) <= (Blocks.of([value], DT).maxima > q).sum()


@pytest.mark.parametrize(("rate", "hours"), [(1.0, 4.0), (5.0, 1.5), (20.0, 0.6)])
def test_fresh_operation_alarms_no_more_an_hour_than_was_promised(rate, hours):
    rng = np.random.default_rng(7)
    fresh = Blocks.of(operation(rng, 60.0), DT)
    realised, promised = [], []
    for _ in range(60):
        episodes = operation(rng, hours)
        blocks = Blocks.of(episodes, DT)
        q = hourly_threshold(blocks, rate)
        promise = hourly_promise(blocks, q, len(episodes))
        assert promise.rate <= rate
        realised.append((fresh.maxima > q).sum() / fresh.total)
        promised.append(promise.at_most)
    spread = np.std(realised) / np.sqrt(len(realised))
    assert np.mean(realised) <= rate + 3 * spread
    assert np.mean(realised) >= 0.6 * rate  # nor is the threshold so high that the promise is empty
    assert np.mean(np.array(realised) <= promised) >= 0.85  # 95 %, of 60


def test_a_promise_says_by_what_it_counts():
    blocks = Blocks(np.arange(40.0), np.full(40, 0.1))  # 4 hours
    promise = hourly_promise(blocks, 38.0, 12)
    assert promise == Promise(12, pytest.approx(2 / 4), promise.at_most, "hour", pytest.approx(4))
    assert stats.binom.cdf(1, 40, promise.at_most / 10) == pytest.approx(0.05)  # one block is above, of 10 an hour


@pytest.mark.parametrize(
    ("rate", "hours", "message"),
    [
        (
            1.0,
            0.25,
            r"1 false alarms an hour need at least 1 hours .*, got 0.25: record 0.75 hours more, or promise 4$",
        ),
        (0.1, 3.7, r"0.1 false alarms an hour need at least 10 hours .*: record 6.3 hours more, or promise 0.271$"),
    ],
)
def test_too_few_hours_are_refused_with_how_many_more_it_takes(rate, hours, message):
    with pytest.raises(ValueError, match=message):
        hourly_threshold(Blocks(np.ones(10), np.full(10, hours / 10)), rate)


@pytest.mark.parametrize("rate", [0.0, -1.0, np.nan, np.inf, 1e308, "1", None, True])
def test_a_rate_that_is_none_is_refused(rate):
    with pytest.raises(ValueError, match="false_alarms_per_hour must be"):
        hourly_threshold(Blocks(np.ones(3), np.ones(3)), rate)


def test_as_many_hours_as_are_asked_for_are_enough():
    for rate in (0.1, 0.3, 1.0, 3.0, 7.0):
        assert hourly_threshold(Blocks(np.arange(10.0), np.full(10, 1.0 / rate / 10)), rate) == 9.0


def test_a_promise_to_each_group_is_the_one_that_needs_most():
    values = [np.full(round(360 / DT), v) for v in range(40)]  # 0.1 hours each, cut into six blocks
    blocks = Blocks.of(values, DT, ["Lift"] * 20 + ["Door"] * 20)
    assert hourly_threshold(blocks, 10.0) == 36.0  # of Door's 2 hours 19 blocks may exceed it: six of 39, 38, 37 each
    assert hourly_threshold(Blocks(*blocks[:2]), 10.0) == 33.0  # 39 of all 4 hours'
    assert Blocks.restored(blocks.array).apart[1].maxima.tolist() == blocks.maxima[120:].tolist()
    promise = hourly_promise(blocks, 37.0, 40)
    assert (promise.rate, promise.hours) == (pytest.approx(13 / 2), pytest.approx(4))


def test_hours_that_one_group_lacks_are_refused():
    blocks = Blocks.of([np.ones(ROWS)] * 61, DT, ["Lift"] * 60 + ["Door"])
    with pytest.raises(ValueError, match=r"got 0\.0167"):
        hourly_threshold(blocks, 1.0)
