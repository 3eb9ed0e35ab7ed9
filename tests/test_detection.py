"""Whitening, evidence, calibration, adaptive thresholds and repetitions, against closed forms and Monte Carlo."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import stats

from asm_gym.detection import (
    AdaptiveThreshold,
    Blocks,
    alarms_in,
    conformal_episodes,
    conformal_threshold,
)
from asm_gym.detection.alarm_rule import MINUTE
from asm_gym.detection.conformal import Promise, episode_threshold, hourly_promise, hourly_threshold
from asm_gym.detection.detector import USUAL_QUANTILE, habituate, usual_levels
from asm_gym.detection.evidence import (
    CONTEXT_GAIN,
    POWER,
    TAIL_INDEX,
    Evidence,
    accumulated,
    pool,
    whitening,
    worst_case,
)
from asm_gym.detection.repetition import (
    MOST_BEYOND,
    REPETITION_OFFSET,
    Repetition,
    RepetitionWeights,
    count_repetitions,
    evidence_steps,
)
from asm_gym.monitors import NeuralASM
from tests.streams import frozen, sine_episodes, sine_spec


def accumulate(evidence, whitened, context, gains):
    """The equation of ``evidence``, the oracle of ``accumulated`` and of the compiled step."""
    return evidence._replace(
        vector=evidence.vector + gains[:, None] * (whitened[:, None, :] - evidence.vector),
        context=evidence.context + CONTEXT_GAIN * (context - evidence.context),
        steps=evidence.steps + 1,
    )


def usual(found, context):
    """log ŝ (N,) in contexts (N, C), the oracle of the compiled step."""
    return np.clip(context @ found[0][:-1] + found[0][-1], *found[1])


def correlated(seed: int, n: int = 4000, size: int = 5) -> np.ndarray:
    rng = np.random.default_rng(seed)
    return rng.normal(size=(n, size)) @ rng.normal(size=(size, size))


def test_whitened_errors_have_the_identity_as_covariance_by_a_symmetric_matrix():
    errors = correlated(0)
    M = whitening(errors, shrinkage=0.0)
    np.testing.assert_allclose((errors @ M).T @ (errors @ M) / len(errors), np.eye(5), atol=1e-9)
    np.testing.assert_allclose(M, M.T, atol=1e-12)
    assert np.linalg.eigvalsh(M)[0] > 0
    independent = np.array([[2.0, 0.0], [-2.0, 0.0], [0.0, 0.5], [0.0, -0.5]]) * np.sqrt(2)
    np.testing.assert_allclose(whitening(independent, 0.0), [[0.5, 0], [0, 2]], atol=1e-12)


@pytest.mark.parametrize("steps", [1, 2, 40])
def test_the_evidence_of_a_whole_episode_is_that_of_its_rows(steps):
    rng, gains = np.random.default_rng(steps), np.array([0.5, 0.1, 1.0])
    whitened, contexts = rng.normal(size=(steps, 4)), rng.normal(size=(steps, 3))
    evidence, vectors, running = Evidence.start(1, 3, 4, context=3), [], []
    for e, c in zip(whitened, contexts, strict=True):
        evidence = accumulate(evidence, e[None], c[None], gains)
        vectors.append(evidence.vector[0])
        running.append(evidence.context[0])
    together = accumulated(whitened, contexts, gains)
    for found, wanted in zip(together, (vectors, running), strict=True):
        np.testing.assert_array_equal(found, wanted)


def test_pooling_is_the_norm_and_its_parts_add_up():
    ratios = np.array([[3.0, 4.0, 0.0], [0.0, 0.0, 0.0]])
    pooled, parts = pool(ratios)
    np.testing.assert_allclose(pooled, np.linalg.norm(ratios, POWER, axis=1), atol=1e-300)
    np.testing.assert_allclose(parts.sum(axis=1), pooled, atol=1e-300)
    np.testing.assert_allclose(parts[0, 0] / parts[0, 1], 0.75**POWER)
    huge, parts = pool(np.array([[1e200, 1e-200]]))
    assert huge[0] == pytest.approx(1e200)
    assert parts.sum() == pytest.approx(1e200)


def test_the_tail_of_the_maxima_is_that_of_their_distribution():
    rng, index = np.random.default_rng(3), np.array([0.1, 0.6, 1.2])
    maxima = 5.0 * (1.0 - rng.random((100_000, 3))) ** -index  # Pareto: P(v > q) = (q/5)^(-1/ξ)
    ceiling, tail = worst_case(maxima)
    np.testing.assert_allclose(ceiling, 5.0 * 0.1**-index, rtol=0.03)
    np.testing.assert_allclose(tail, np.minimum(1.0, TAIL_INDEX / index), rtol=0.03)
    rare = np.quantile((maxima / ceiling) ** tail, 0.999, axis=0)
    assert rare[1] == pytest.approx(rare[2], rel=0.1)
    assert rare[0] < rare[1]
    ceiling, tail = worst_case(np.zeros((1, 2, 3)))  # constant maxima have no tail
    assert (ceiling > 0).all()
    assert (tail == 1.0).all()


def test_habituation_finds_the_quantile_of_each_context_and_no_more_than_nominal_ones():
    rng = np.random.default_rng(0)
    context = np.repeat(np.eye(2, dtype=np.float32), 20_000, axis=0)
    level = rng.normal(size=40_000) + np.where(context[:, 0] > 0, 0.6, -0.6)
    found = habituate(context, level, rng)
    for which in (0, 1):
        below = (level < context @ found[:2] + found[2])[context[:, which] > 0].mean()
        assert below == pytest.approx(USUAL_QUANTILE, abs=0.015)
    contexts = [rng.normal(size=(100, 40)).astype(np.float32) for _ in range(90)]
    limited = usual_levels(contexts, [2.0 * c[:, 0] + rng.normal(size=100) for c in contexts], rng)
    nominal, wild = usual(limited, np.concatenate(contexts)), usual(limited, 1e3 * contexts[0])
    assert (wild.min(), wild.max()) == (nominal.min(), nominal.max())
    assert nominal.max() < 2.0 * 3.5 + 2.0


@pytest.mark.parametrize(
    ("rate", "episodes"), [(0.5, 1), (0.1, 9), (0.05, 19), (0.01, 99), (0.07, 14), (0.001, 999)]
)
def test_a_rate_needs_its_inverse_in_episodes_less_one(rate, episodes):
    assert conformal_episodes(rate) == episodes
    conformal_threshold(np.arange(episodes), rate)
    with pytest.raises(
        ValueError, match=f"at least {episodes} nominal episodes, got {episodes - 1}"
    ):
        conformal_threshold(np.arange(episodes - 1), rate)


def test_threshold_is_the_hand_computed_rank():
    maxima = np.array([5.0, 1.0, 9.0, 3.0, 7.0, 2.0, 8.0, 4.0, 6.0])
    assert [conformal_threshold(maxima, rate) for rate in (0.1, 0.25, 0.3)] == [9.0, 8.0, 7.0]
    blocks = Blocks(np.array([5.0, 1.0, 9.0, 3.0, 7.0]), np.full(5, 0.5))  # 2.5 hours
    # at 0.8 one may exceed it: 1 + 1 <= 0.8 * 2.5
    rates = {
        0.4: 9.0,
        0.79: 9.0,
        0.8: 7.0,
        1.2: 5.0,
        100.0: 1.0,
    }
    assert [hourly_threshold(blocks, rate) for rate in rates] == list(rates.values())


@pytest.mark.parametrize(("n", "rate"), [(19, 0.05), (50, 0.05), (99, 0.01), (30, 0.2)])
def test_a_fresh_episode_exceeds_the_threshold_as_rarely_as_promised(n, rate):
    rng, trials = np.random.default_rng(n), 20_000
    draws = rng.exponential(size=(trials, n + 1))
    rank = np.array([d[-1] > conformal_threshold(d[:-1], rate) for d in draws])
    # the rank of the fresh one is uniform
    exact = (n + 1 - np.ceil((n + 1) * (1 - rate) - 1e-9)) / (n + 1)
    assert exact <= rate
    assert rank.mean() == pytest.approx(exact, abs=4 * np.sqrt(exact * (1 - exact) / trials))


def test_the_tail_of_few_maxima_is_that_of_hill_and_weissman():
    # 10 of 100 above 4
    maxima = np.concatenate([np.linspace(1.0, 4.0, 90), 4.0 * np.exp(np.arange(1, 11) / 10.0)])
    hill = np.mean(np.arange(1, 11) / 10.0)
    expected = 4.0 * (10 / 1.0) ** (hill * (1 + 0.6 / np.sqrt(10)))  # one of 100, as 0.01 allows
    assert episode_threshold(maxima, 0.01) == pytest.approx(expected)
    assert hourly_threshold(Blocks(maxima, np.full(100, 0.01)), 1.0) == pytest.approx(expected)
    promise = Promise.of(maxima, episode_threshold(maxima, 0.01))
    assert promise.modelled
    assert promise.rate == pytest.approx(0.01)
    for sample, rate in (
        (maxima, 0.05),
        (maxima[:40], 0.05),
        (np.ones(100), 0.01),
    ):  # enough; too few; no tail
        assert episode_threshold(sample, rate) == conformal_threshold(sample, rate)
        assert not Promise.of(sample, episode_threshold(sample, rate)).modelled
    with pytest.raises(ValueError, match="at least 99 nominal episodes, got 80"):
        episode_threshold(maxima[:80], 0.01)


@pytest.mark.parametrize(
    "law", [stats.pareto(3.0), stats.lognorm(0.5), stats.gamma(4.0)], ids=lambda law: law.dist.name
)
@pytest.mark.parametrize("n", [100, 150, 300])
def test_a_modelled_threshold_keeps_the_rate_and_varies_less_than_a_counted_one(law, n):
    draws = law.rvs(size=(2000, n), random_state=n)
    modelled, counted = (
        law.sf([how(d, 0.01) for d in draws]) for how in (episode_threshold, conformal_threshold)
    )
    assert modelled.mean() <= 0.01
    assert modelled.std() < counted.std()


DT = 0.05
ROWS = round(MINUTE / DT)


def operation(rng: np.random.Generator, hours: float) -> list[np.ndarray]:
    """Values of episodes of very different lengths with correlated rows: bursts, and a level of each episode."""
    found: list[np.ndarray] = []
    left = hours * 3600 / DT
    while left > 0:
        steps = max(10, int(rng.exponential(9.0 / DT)))
        burst = np.convolve(rng.standard_t(4, steps + 20), np.ones(20) / 4, "valid")[:steps]
        found.append(np.exp(0.5 * burst + rng.normal(0, 0.5)))
        left -= steps
    return found


def test_an_alarm_that_persists_or_returns_within_a_minute_is_one():
    value = np.zeros(5 * ROWS)
    counts = [alarms_in(value, 1.0, DT)]
    for part in (
        slice(10, 3 * ROWS),
        slice(3 * ROWS + ROWS // 2, 3 * ROWS + ROWS // 2 + 1),
        slice(-1, None),
    ):
        value[part] = 2.0
        counts.append(alarms_in(value, 1.0, DT))
    assert counts == [0, 1, 1, 2]
    rng = np.random.default_rng(0)
    for value in (rng.exponential(size=7 * ROWS + 13) for _ in range(50)):
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
        assert promise.rate <= rate * (1 + 1e-9)
        realised.append((fresh.maxima > q).sum() / fresh.total)
        promised.append(promise.at_most)
    assert 0.6 * rate <= np.mean(realised) <= rate + 3 * np.std(realised) / np.sqrt(len(realised))
    assert np.mean(np.array(realised) <= promised) >= 0.85  # 95 %, of 60


@pytest.mark.parametrize(
    ("rate", "hours", "message"),
    [
        (1.0, 0.25, r"at least 1 hours .*, got 0.25: record 0.75 hours more, or promise 4$"),
        (0.1, 3.7, r"at least 10 hours .*: record 6.3 hours more, or promise 0.271$"),
    ],
)
def test_too_few_hours_are_refused_with_the_hours_missing(rate, hours, message):
    with pytest.raises(ValueError, match=message):
        hourly_threshold(Blocks(np.ones(10), np.full(10, hours / 10)), rate)


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
def test_no_sequence_of_episodes_has_more_alarms_than_the_bound(maxima, rate, step):
    how = AdaptiveThreshold(rate, step, ceiling=4.0)
    assert (
        alarms_of(how, np.array(maxima)).sum()
        <= rate * len(maxima) + math.log(4.0) / step + 1 + 1e-9
    )


def test_faults_above_the_ceiling_and_confirmed_alarms_do_not_move_it():
    running = AdaptiveThreshold(0.01, 0.5, ceiling=3.0).start(1.0)
    for largest in (*[3.1] * 1000, math.inf, math.nan):
        assert running.value < 3.1
        running.follow(largest)
    running.follow(2.0, confirmed=True)
    assert running.value == pytest.approx(1.0)
    assert math.isnan(running.level)
    running.follow(2.0)
    assert running.value == pytest.approx(math.exp(0.5 * 0.99))
    assert running.level == 1.0
    running.follow(1.0, confirmed=True)  # nothing alarmed, so nothing was confirmed
    assert running.level == 0.5
    side_by_side = AdaptiveThreshold(0.1, 0.5).start(1.0)
    for _ in range(3):
        side_by_side.follow(1.2, judged_by=1.0)
    assert side_by_side.level == 1.0


def repetitions(rows: np.ndarray, counted: np.ndarray, most: float = np.inf) -> list[Repetition]:
    state, states = Repetition.start(1, rows.shape[1]), []
    weights = RepetitionWeights(
        columns=np.arange(rows.shape[1]),
        steps=evidence_steps(counted[:2]),
        most=np.full(rows.shape[1], most),
        offset=np.zeros(rows.shape[1]),
        carried=np.full(rows.shape[1], -1),
    )
    for row in rows:
        state = state.followed_by(row[None], weights)
        states.append(state)
    return states


def test_repetitions_are_counted_after_a_change_and_after_a_repetition():
    # Repeated: no, no, yes, yes, no, no: after a change 1 in 3, after a repetition 1 in 2.
    found = count_repetitions([np.array([1.0, 2, 3, 3, 3, 4, 5])[:, None]], np.array([True]))
    first = (1 + 0.5) / (3 + 1)
    np.testing.assert_allclose(np.exp(-found[:2, 0]), [first, (1 + first) / (2 + 1)])


def test_a_sense_that_was_stuck_for_long_is_believed_again_soon():
    p, rows = np.full((2, 1), 1e-4), np.concatenate([np.ones(5000), np.arange(20)])[:, None]
    states = repetitions(rows, -np.log(p), REPETITION_OFFSET + MOST_BEYOND)
    n = np.array([s.unlikely[0, 0] for s in states])
    assert n.max() == n[4999] == REPETITION_OFFSET + MOST_BEYOND
    assert n[5015] < REPETITION_OFFSET


@pytest.fixture(scope="module")
def asm() -> NeuralASM:
    noisy = replace(
        sine_spec(), channels=tuple(replace(c, noise=0.5) for c in sine_spec().channels)
    )
    fit, others = (sine_episodes(30, seed=seed, spec=noisy, noise=0.5) for seed in (0, 1))
    return (
        NeuralASM(noisy, hidden_size=16, association_size=40, epochs=2)
        .fit(fit)
        .calibrate(others, 0.05)
    )


def test_a_frozen_sense_alarms_within_four_rows_however_poor_the_prediction(asm):
    for n, episode in enumerate(sine_episodes(12, seed=2, spec=asm.spec, noise=0.5)):
        surprise = asm.score(frozen(episode, n, onset=20))
        np.testing.assert_allclose(surprise.attribution.sum(axis=1), surprise.value)
        assert surprise.value[24] > asm.threshold
        assert surprise.attribution[23].argmax() == n
    state, row = asm.initial_state(1), sine_episodes(1, spec=asm.spec)[0].stream[:1]
    for _ in range(3):
        state, _ = asm.observe(state, row)
    assert state.detection.repetition.unlikely.any()
    assert not asm.reset_evidence(state).detection.repetition.unlikely.any()
