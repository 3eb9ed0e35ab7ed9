"""The ideal observer against simulation and closed forms."""

import numpy as np
import pytest

from asm_gym.evaluation.ideal import auroc_bound, earliest, noise_floor, power_bound, separation
from asm_gym.evaluation.statistics import auroc


def test_the_bounds_are_what_the_likelihood_ratio_reaches():
    """A known signal in white noise, drawn many times: AUROC and power of its log likelihood ratio."""
    rng = np.random.default_rng(0)
    signal, noise = np.array([[0.4, -0.2], [0.1, 0.3], [0.5, 0.0]]), np.array([0.5, 0.2])
    twin = np.zeros((3, 2))
    S = separation(signal, twin, noise, onset=0)
    assert S[-1] == pytest.approx(((signal / noise) ** 2).sum())
    draws = rng.standard_normal((2, 40_000, 3, 2)) * noise
    ratio = [((x * signal - signal**2 / 2) / noise**2).sum(axis=(1, 2)) for x in (draws[0], draws[1] + signal)]
    assert ratio[1].mean() == pytest.approx(S[-1] / 2, rel=0.03)
    assert auroc(ratio[1], ratio[0]) == pytest.approx(float(auroc_bound(S[-1])), abs=0.005)
    threshold = np.quantile(ratio[0], 0.95)
    assert (ratio[1] > threshold).mean() == pytest.approx(float(power_bound(S[-1], 0.05)), abs=0.01)


def test_what_changes_nothing_cannot_be_seen():
    x = np.random.default_rng(0).standard_normal((5, 3))
    S = separation(x, x.copy(), np.ones(3), onset=2)
    np.testing.assert_array_equal(S, 0.0)
    assert auroc_bound(S)[-1] == 0.5
    assert power_bound(S, 0.01)[-1] == pytest.approx(0.01)
    assert earliest(S) is None


def test_the_earliest_step_is_where_the_power_suffices():
    """√S must reach z(0.99) + z(0.95) = 3.971, which steps of √S = 2, 2.83, 3.46, 4 do at the fourth."""
    twin = np.zeros((9, 1))
    faulty = twin.copy()
    faulty[3:] = 2.0
    assert earliest(separation(faulty, twin, np.ones(1), onset=3)) == 3


def test_a_broken_reading_is_seen_at_once():
    twin = np.zeros((4, 2))
    faulty = twin.copy()
    faulty[2, 1] = np.nan
    S = separation(faulty, twin, np.ones(2), onset=1)
    assert S[0] == 0
    assert np.isinf(S[1:]).all()
    assert auroc_bound(S)[-1] == 1.0
    assert earliest(S) == 1


def test_an_episode_that_ends_early_is_compared_as_long_as_it_lasts():
    assert len(separation(np.zeros((6, 1)), np.zeros((9, 1)), np.ones(1), onset=2)) == 4


def test_episodes_of_different_seeds_are_no_twins():
    with pytest.raises(ValueError, match="not twins"):
        separation(np.ones((4, 1)), np.zeros((4, 1)), np.ones(1), onset=2)


def test_channels_without_noise_get_a_thousandth_of_their_spread():
    stream = np.column_stack([np.tile([-1.0, 1.0], 50), np.tile([-1.0, 1.0], 50), np.zeros(100)])
    np.testing.assert_allclose(noise_floor(np.array([0.5, 0.0, 0.0]), [stream]), [0.5, 1e-3, 1e-9])
