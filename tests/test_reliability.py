"""What stated probabilities are worth."""

import numpy as np
import pytest

from asm_gym.scripts.reproduce.reliability import reliability

EDGES = (0.5, 0.75, 0.9, 1.0)


def test_bins_hold_what_was_stated_and_what_came_of_it():
    stated = np.array([0.5, 0.7, 0.75, 0.8, 1.0])
    found = reliability(stated, np.array([0, 1, 1, 1, 0], bool), np.array([7, 7, 7, 9, 9]), EDGES)
    np.testing.assert_allclose(found.stated, [0.6, 0.775, 1.0])
    np.testing.assert_array_equal(found.rows, [2, 2, 1])
    np.testing.assert_array_equal(found.episodes, [1, 2, 1])
    assert [r.value for r in found.right] == [0.5, 1.0, 0.0]
    assert found.error.value == pytest.approx((2 * 0.1 + 2 * 0.225 + 1.0) / 5)


def test_who_is_right_as_often_as_stated_has_no_error_and_who_is_too_sure_has_one():
    rng = np.random.default_rng(0)
    stated = rng.uniform(0.5, 1.0, 20_000)
    episodes = rng.integers(0, 500, len(stated))
    honest = reliability(stated, rng.random(len(stated)) < stated, episodes, EDGES)
    boaster = reliability(stated, rng.random(len(stated)) < stated - 0.2, episodes, EDGES)
    assert honest.error.value < 0.02
    assert boaster.error.value == pytest.approx(0.2, abs=0.02)
    assert all(r.low <= mean <= r.high for mean, r in zip(honest.stated, honest.right, strict=True))


def test_rows_of_one_episode_tell_little_and_so_the_interval_is_wide():
    right = np.repeat([True, False] * 5, 100)
    alike = reliability(np.full(1000, 0.8), right, np.repeat(np.arange(10), 100), EDGES).right[1]
    apart = reliability(np.full(1000, 0.8), right, np.arange(1000), EDGES).right[1]
    assert alike.high - alike.low > 5 * (apart.high - apart.low)


def test_an_empty_bin_has_no_share():
    found = reliability(np.array([0.6]), np.array([True]), np.array([0]), EDGES)
    assert np.isnan(found.stated[1])
    assert found.right[1].percent() == ""


@pytest.mark.parametrize("stated", [np.zeros(0), np.array([0.4]), np.array([1.1])])
def test_statements_that_are_in_no_bin_are_refused(stated):
    with pytest.raises(ValueError, match=r"0\.5 to 1\.0"):
        reliability(stated, np.ones(len(stated), bool), np.arange(len(stated)), EDGES)
