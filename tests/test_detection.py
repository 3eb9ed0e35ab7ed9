"""Whitening, accumulation and conformal thresholds against closed forms and Monte Carlo."""

from __future__ import annotations

import numpy as np
import pytest

from asm_gym.detection import accumulate, conformal_episodes, conformal_threshold, no_evidence, shares, whitening


def correlated(rng: np.random.Generator, n: int = 4000, size: int = 5) -> np.ndarray:
    return rng.normal(size=(n, size)) @ rng.normal(size=(size, size))


def test_whitened_errors_have_the_identity_as_covariance():
    errors = correlated(np.random.default_rng(0))
    white = errors @ whitening(errors, shrinkage=0.0)
    np.testing.assert_allclose(white.T @ white / len(white), np.eye(5), atol=1e-9)


def test_whitening_is_symmetric_and_positive():
    M = whitening(correlated(np.random.default_rng(1)))
    np.testing.assert_allclose(M, M.T, atol=1e-12)
    assert np.linalg.eigvalsh(M)[0] > 0


def test_whitening_of_independent_channels_only_scales_them():
    errors = np.array([[2.0, 0.0], [-2.0, 0.0], [0.0, 0.5], [0.0, -0.5]]) * np.sqrt(2)
    np.testing.assert_allclose(whitening(errors, 0.0), [[0.5, 0], [0, 2]], atol=1e-12)


def test_full_shrinkage_only_divides_by_the_mean_spread():
    errors = np.array([[2.0, 0.0], [-2.0, 0.0], [0.0, 0.0], [0.0, 0.0]])  # variances 2 and 0
    np.testing.assert_allclose(whitening(errors, 1.0), np.eye(2), atol=1e-12)


def test_shrinkage_bounds_what_duplicated_and_constant_channels_are_blown_up_by():
    errors = correlated(np.random.default_rng(2))
    errors = np.column_stack([errors, errors[:, 0], np.zeros(len(errors))])
    scale = np.trace(errors.T @ errors / len(errors)) / errors.shape[1]
    assert np.linalg.norm(whitening(errors, 0.01), 2) <= 1 / np.sqrt(0.01 * scale) + 1e-9
    assert np.array_equal(whitening(np.zeros((9, 3)), 0.5) > 0, np.eye(3) > 0)


@pytest.mark.parametrize("shrinkage", [-0.1, 1.1, np.nan])
def test_shrinkage_outside_the_unit_interval_is_refused(shrinkage):
    with pytest.raises(ValueError, match="shrinkage must be in"):
        whitening(np.eye(3), shrinkage)


@pytest.mark.parametrize("gain", [0.2, 0.05, 1.0])
def test_evidence_of_white_noise_has_mean_one_from_the_first_step_on(gain):
    rng, streams, size = np.random.default_rng(0), 4000, 3
    evidence = no_evidence(streams, size)
    for _ in range(12):
        evidence = accumulate(evidence, rng.normal(size=(streams, size)), gain)
        value = shares(evidence, gain).sum(axis=1)
        # variance of a chi-square over its 3 degrees of freedom is 2/3
        assert value.mean() == pytest.approx(1.0, abs=5 * np.sqrt(2 / size / streams))


def test_evidence_is_the_hand_computed_moving_average():
    first = no_evidence(1, 2)
    one = accumulate(first, np.array([[1.0, 2.0]]), 0.5)
    two = accumulate(one, np.array([[3.0, 0.0]]), 0.5)
    np.testing.assert_allclose(two.vector, [[1.75, 0.5]])
    # variance of each: 0.5 / 1.5 * (1 - 0.5 ** 4) = 0.3125
    np.testing.assert_allclose(shares(two, 0.5), [[1.75**2 / 0.625, 0.25 / 0.625]])
    assert first.steps[0] == 0
    assert not first.vector.any()


def test_a_lasting_shift_adds_up_while_noise_averages_out():
    evidence = no_evidence(1, 4)
    values = []
    for _ in range(60):
        evidence = accumulate(evidence, np.array([[1.0, 0, 0, 0]]), 0.2)
        values.append(shares(evidence, 0.2).sum())
    assert np.all(np.diff(values) > 0)
    assert values[-1] == pytest.approx((2 - 0.2) / 0.2 / 4, rel=1e-3)


@pytest.mark.parametrize(("rate", "episodes"), [(0.5, 1), (0.1, 9), (0.05, 19), (0.01, 99), (0.07, 14), (0.001, 999)])
def test_a_rate_needs_its_inverse_in_episodes_less_one(rate, episodes):
    assert conformal_episodes(rate) == episodes
    conformal_threshold(np.arange(episodes), rate)
    with pytest.raises(ValueError, match=f"at least {episodes} nominal episodes, got {episodes - 1}"):
        conformal_threshold(np.arange(episodes - 1), rate)


@pytest.mark.parametrize("rate", [0.0, 1.0, -0.1, 1.5, np.nan])
def test_a_rate_that_is_no_probability_is_refused(rate):
    with pytest.raises(ValueError, match="false_alarm_rate must be in"):
        conformal_episodes(rate)


def test_threshold_is_the_hand_computed_rank():
    maxima = np.array([5.0, 1.0, 9.0, 3.0, 7.0, 2.0, 8.0, 4.0, 6.0])
    assert conformal_threshold(maxima, 0.1) == 9.0  # ceil(10 * 0.9) = 9
    assert conformal_threshold(maxima, 0.25) == 8.0  # ceil(10 * 0.75) = 8
    assert conformal_threshold(maxima, 0.3) == 7.0  # ceil(10 * 0.7) = 7, though 10 * 0.7 is 7.000000000000001 or not


@pytest.mark.parametrize(("n", "rate"), [(19, 0.05), (50, 0.05), (99, 0.01), (30, 0.2)])
def test_a_fresh_episode_exceeds_the_threshold_as_rarely_as_promised(n, rate):
    rng, trials = np.random.default_rng(n), 20_000
    draws = rng.exponential(size=(trials, n + 1))
    rank = np.array([d[-1] > conformal_threshold(d[:-1], rate) for d in draws])
    exact = (n + 1 - np.ceil((n + 1) * (1 - rate) - 1e-9)) / (n + 1)  # the rank of the fresh one is uniform
    assert exact <= rate
    assert rank.mean() == pytest.approx(exact, abs=4 * np.sqrt(exact * (1 - exact) / trials))
