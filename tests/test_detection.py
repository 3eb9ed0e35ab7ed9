"""Whitening, accumulation and conformal thresholds against closed forms and Monte Carlo."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from asm_gym.detection import (
    Detector,
    ModelOutput,
    accumulate,
    accumulated,
    bounded,
    conformal_episodes,
    conformal_threshold,
    no_evidence,
    pool,
    strength,
    whitening,
    worst_case,
)
from asm_gym.detection.habituation import STEPS_PER_NUMBER, USUAL, Habituation, habituate, usual, usual_levels
from asm_gym.detection.tails import TAIL_INDEX


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


def test_evidence_of_white_noise_has_mean_one_from_the_first_step_on():
    rng, streams, size, gains = np.random.default_rng(0), 4000, 3, np.array([0.2, 0.05, 1.0])
    evidence = no_evidence(streams, 3, size)
    for _ in range(12):
        evidence = accumulate(evidence, rng.normal(size=(streams, size)), np.zeros((streams, 0)), gains)
        # variance of a chi-square over its 3 degrees of freedom is 2/3
        for value in strength(evidence, gains).mean(axis=2).T:
            assert value.mean() == pytest.approx(1.0, abs=5 * np.sqrt(2 / size / streams))


def test_evidence_is_the_hand_computed_moving_average():
    half, first = np.array([0.5]), no_evidence(1, 1, 2, context=1)
    one = accumulate(first, np.array([[1.0, 2.0]]), np.array([[5.0]]), half)
    two = accumulate(one, np.array([[3.0, 0.0]]), np.array([[0.0]]), half)
    np.testing.assert_allclose(two.vector, [[[1.75, 0.5]]])
    np.testing.assert_allclose(two.context, [[0.8]])  # 5 × 0.2 × 0.8
    # variance of each: 0.5 / 1.5 * (1 - 0.5 ** 4) = 0.3125
    np.testing.assert_allclose(strength(two, half), [[[1.75**2 / 0.3125, 0.25 / 0.3125]]])
    assert first.steps[0] == 0
    assert not first.vector.any()


@pytest.mark.parametrize("steps", [1, 2, 40])
def test_the_evidence_of_a_whole_episode_is_that_of_its_steps_to_the_bit(steps):
    rng, gains = np.random.default_rng(steps), np.array([0.5, 0.1, 1.0])
    whitened, contexts = rng.normal(size=(steps, 4)), rng.normal(size=(steps, 3))
    evidence, vectors, lately = no_evidence(1, 3, 4, context=3), [], []
    for e, c in zip(whitened, contexts, strict=True):
        evidence = accumulate(evidence, e[None], c[None], gains)
        vectors.append(evidence.vector[0])
        lately.append(evidence.context[0])
    whole = accumulated(whitened, contexts, gains)
    np.testing.assert_array_equal(whole[0], vectors)
    np.testing.assert_array_equal(whole[1], lately)


def test_a_lasting_shift_adds_up_while_noise_averages_out():
    gains, evidence = np.array([0.2]), no_evidence(1, 1, 4)
    values = []
    for _ in range(60):
        evidence = accumulate(evidence, np.array([[1.0, 0, 0, 0]]), np.zeros((1, 0)), gains)
        values.append(strength(evidence, gains).sum())
    assert np.all(np.diff(values) > 0)
    assert values[-1] == pytest.approx((2 - 0.2) / 0.2, rel=1e-3)


@given(st.floats(-1e9, 1e9), st.floats(1.0, 100.0))
def test_no_error_counts_more_than_the_bound_and_small_ones_count_in_full(size, bound):
    pulled = bounded(np.array([[size, 1e-6 * size / (1 + abs(size))]]), bound)
    assert abs(pulled[0, 0]) <= bound * (1 + 1e-12)
    assert np.sign(pulled[0, 0]) == np.sign(size)
    np.testing.assert_allclose(pulled[0, 1], 1e-6 * size / (1 + abs(size)), rtol=1e-9)


def test_pooling_is_the_hand_computed_norm_and_its_parts_add_up():
    pooled, parts = pool(np.array([[3.0, 4.0, 0.0], [0.0, 0.0, 0.0]]), power=2)
    np.testing.assert_allclose(pooled, [5.0, 0.0], atol=1e-300)
    np.testing.assert_allclose(parts, [[5 * 9 / 25, 5 * 16 / 25, 0.0], [0.0, 0.0, 0.0]], atol=1e-300)
    huge, parts = pool(np.array([[1e200, 1e-200]]))
    assert huge[0] == pytest.approx(1e200)
    assert parts.sum() == pytest.approx(1e200)


def test_the_tail_of_the_maxima_is_that_of_the_distribution_they_come_from():
    rng, index = np.random.default_rng(3), np.array([0.1, 0.6, 1.2])
    maxima = 5.0 * (1.0 - rng.random((100_000, 3))) ** -index  # Pareto: P(v > q) = (q/5)^(-1/ξ)
    ceiling, tail = worst_case(maxima)
    np.testing.assert_allclose(ceiling, 5.0 * 0.1**-index, rtol=0.03)
    np.testing.assert_allclose(tail, np.minimum(1.0, TAIL_INDEX / index), rtol=0.03)
    # What is equally rare becomes the same ratio, in tails as heavy as TAIL_INDEX or heavier.
    rare = np.quantile((maxima / ceiling) ** tail, 0.999, axis=0)
    assert rare[1] == pytest.approx(rare[2], rel=0.1)
    assert rare[0] < rare[1]


def test_constant_maxima_have_no_tail():
    ceiling, tail = worst_case(np.zeros((1, 2, 3)))
    assert ceiling.shape == tail.shape == (2, 3)
    assert (ceiling > 0).all()
    assert (tail == 1.0).all()


def test_habituation_finds_the_quantile_of_each_context():
    rng = np.random.default_rng(0)
    context = np.repeat(np.eye(2, dtype=np.float32), 20_000, axis=0)
    level = rng.normal(size=40_000) + np.where(context[:, 0] > 0, 0.6, -0.6)
    found = habituate(context, level, rng)
    usual = context @ found[:2] + found[2]
    for which in (0, 1):
        below = (level < usual)[context[:, which] > 0].mean()
        assert below == pytest.approx(USUAL, abs=0.015)


def levels(rng: np.random.Generator, episodes: int, told: float) -> tuple[list[np.ndarray], list[np.ndarray]]:
    """Contexts (100, 40) and log s (100,), of which the first number of the context tells as much as ``told``."""
    contexts = [rng.normal(size=(100, 40)).astype(np.float32) for _ in range(episodes)]
    return contexts, [told * c[:, 0] + rng.normal(size=100) for c in contexts]


def test_no_context_excuses_more_than_nominal_ones_did():
    rng = np.random.default_rng(2)
    contexts, surprises = levels(rng, 90, 2.0)
    found = usual_levels(contexts, surprises, rng)
    nominal = usual(found, np.concatenate(contexts))
    wild = usual(found, 1e3 * contexts[0])
    assert wild.min() == nominal.min()
    assert wild.max() == nominal.max()
    assert nominal.max() < 2.0 * 3.5 + 2.0  # the largest of so many normal numbers, and the quantile of the noise


def runs(rng: np.random.Generator, count: int, steps: int = 200) -> list[ModelOutput]:
    """Errors four times as large in one of two contexts, between which an episode goes to and fro."""
    made = []
    for _ in range(count):
        rough = (np.arange(steps) // 50 + rng.integers(2)) % 2
        errors = rng.normal(size=(steps, 3)) * np.where(rough, 4.0, 1.0)[:, None]
        made.append(ModelOutput(errors, np.stack([rough, 1 - rough], axis=1).astype(np.float32)))
    return made


def judged(detector: Detector, run: ModelOutput) -> np.ndarray:
    evidence, values = detector.start(1), []
    for e, c in zip(run.errors, run.contexts, strict=True):
        evidence, value, parts = detector.step(evidence, e[None], c[None])
        np.testing.assert_allclose(parts.sum(), value[0])
        values.append(value[0])
    return np.array(values)


def test_what_is_usual_in_a_context_alarms_no_more_than_elsewhere():
    rng = np.random.default_rng(0)
    detector = Detector.fit(runs(rng, 40), runs(rng, 40), [0.8, 0.2], 10.0, 1e-3, rng)
    rough, calm = [], []
    for run in runs(rng, 20):
        value = judged(detector, run)
        settled = np.arange(len(value)) % 50 >= 25  # the evidence of the last context has gone
        rough.append(value[settled & (run.contexts[:, 0] > 0)])
        calm.append(value[settled & (run.contexts[:, 0] == 0)])
    a, b = (np.quantile(np.concatenate(v), 0.95) for v in (rough, calm))
    assert 0.6 < a / b < 1.7  # 16 without habituation, for the evidence is squared


def test_what_is_usual_in_a_context_is_left_out_where_few_steps_tell_of_it():
    few, enough = 4 * STEPS_PER_NUMBER - 1, 4 * STEPS_PER_NUMBER  # two numbers, now and lately
    rng = np.random.default_rng(3)
    for steps, learned in ((few, False), (enough, True)):
        nominal = runs(rng, 1, steps)
        how = nominal, [], [0.8, 0.2], 10.0, 1e-3, np.random.default_rng(0)
        found, without = Detector.fit(*how), Detector.fit(*how, habituates=False)
        assert found.context_quantile[:-1].any() == learned
        same = np.array_equal(judged(found, nominal[0]), judged(without, nominal[0]))
        assert same != learned


def test_a_fault_in_a_calm_error_is_not_drowned_by_a_wild_one():
    rng = np.random.default_rng(1)

    def episode() -> ModelOutput:
        errors = rng.normal(size=(100, 2))
        errors[rng.integers(100), 0] = 40.0  # one knock in every episode, in the first error only
        return ModelOutput(errors, np.zeros((100, 0)))

    detector = Detector.fit([episode() for _ in range(60)], [episode() for _ in range(60)], [0.8, 0.2], 10.0, 1e-3, rng)
    threshold = np.quantile([judged(detector, episode()).max() for _ in range(100)], 0.95)
    faulty = episode()
    faulty.errors[50:, 1] += 3.0
    assert judged(detector, faulty)[50:].max() > threshold


@pytest.mark.parametrize(("rate", "episodes"), [(0.5, 1), (0.1, 9), (0.05, 19), (0.01, 99), (0.07, 14), (0.001, 999)])
def test_a_rate_needs_its_inverse_in_episodes_less_one(rate, episodes):
    assert conformal_episodes(rate) == episodes
    conformal_threshold(np.arange(episodes), rate)
    with pytest.raises(ValueError, match=f"at least {episodes} nominal episodes, got {episodes - 1}"):
        conformal_threshold(np.arange(episodes - 1), rate)


@pytest.mark.parametrize("rate", [0.0, 1.0, -0.1, 1.5, np.nan, True, None, "0.1", 10**400])
def test_a_rate_that_is_no_probability_is_refused(rate):
    with pytest.raises(ValueError, match=r"false_alarm_rate must be a number in \(0, 1\), got"):
        conformal_episodes(rate)


@pytest.mark.parametrize("rate", [5e-324, 2.2250738585e-313, 1e-300])
def test_the_smallest_rates_there_are_need_more_episodes_than_there_are(rate):
    with pytest.raises(ValueError, match=r"needs at least \d{15} nominal episodes, got 20"):
        conformal_threshold(np.arange(20.0), rate)


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


def test_the_compiled_step_is_the_same_equations_put_together():
    rng = np.random.default_rng(2)
    detector = Detector.fit(runs(rng, 8), runs(rng, 8), [0.8, 0.2], 5.0, 1e-3, rng)
    gains, evidence, plain = detector.gains, detector.start(2), no_evidence(2, 2, 3, 2)
    for _ in range(30):
        errors, context = 4.0 * rng.normal(size=(2, 3)), rng.random((2, 2))
        evidence, value, parts = detector.step(evidence, errors, context)
        plain = accumulate(plain, bounded(errors, 5.0) @ detector.whitening, context, gains)
        ratios = (strength(plain, gains) / detector.ceiling) ** detector.tail
        pooled, _ = pool(ratios.reshape(2, -1))
        habituated = Habituation(detector.context_quantile, detector.context_range)
        log_usual = usual(habituated, np.hstack([context, plain.context]))
        np.testing.assert_allclose(value, pooled / np.exp(log_usual), rtol=1e-9)
        np.testing.assert_allclose(parts.sum(axis=1), value, rtol=1e-9)
        for a, b in zip(evidence, plain, strict=True):
            np.testing.assert_allclose(a, b, rtol=1e-9, atol=1e-12)
