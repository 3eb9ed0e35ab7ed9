"""Senses that say the same twice: counted in nominal streams, and held against how rare that was."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from asm_gym.detection import ModelOutput
from asm_gym.detection.repetition import (
    MOST_BEYOND,
    REPETITION_OFFSET,
    STUCK,
    Repetition,
    count_repetitions,
    evidence_steps,
    improbability,
    repeated,
    unrepeated,
)
from asm_gym.detection.tails import TAIL_INDEX
from asm_gym.monitors import NeuralASM
from tests.streams import frozen, sine_episodes, sine_spec


def run(rows: np.ndarray, counted: np.ndarray, most: float = np.inf) -> list[Repetition]:
    state, states = unrepeated(1, rows.shape[1]), []
    bound = np.full(rows.shape[1], most)
    for row in rows:
        state = Repetition(*repeated(*state, row[None], evidence_steps(counted[:2]), bound))
        states.append(state)
    return states


def test_repetitions_are_counted_after_none_and_after_one():
    # Repeated:        no, no, yes, yes, no, no: after none 1 in 3, after one 1 in 2.
    stream = np.array([1.0, 2, 3, 3, 3, 4, 5])[:, None]
    found = count_repetitions([stream], np.array([True]))
    first = (1 + 0.5) / (3 + 1)
    np.testing.assert_allclose(np.exp(-found[:2, 0]), [first, (1 + first) / (2 + 1)])


def test_where_no_noise_is_declared_a_sense_is_watched_unless_it_stood_still_before():
    streams = [np.random.default_rng(seed).normal(size=(100, 3)) for seed in range(2)]
    streams[1][50, 1] = streams[1][49, 1]
    found = count_repetitions(streams, np.zeros(3, np.bool_))
    assert (found[:2, [0, 2]] > 2.0).all()
    assert (found[:2, 1] == 0.0).all()


def test_a_command_at_its_limit_is_not_stuck_where_others_are_known_to_have_noise():
    streams = [np.random.default_rng(seed).normal(size=(100, 2)) for seed in range(2)]
    counted = count_repetitions(streams, np.array([True, False]))
    assert run(np.full((20, 2), 12.0), counted)[-1].unlikely[0, 1] == 0.0
    assert run(np.full((20, 2), 12.0), counted)[-1].unlikely[0, 0] > 12.0


def test_a_sense_read_at_half_the_rate_surprises_nobody_until_it_sticks():
    rng = np.random.default_rng(0)
    slow = np.repeat(rng.normal(size=500), 2)[:, None]
    surprise = count_repetitions([slow], np.array([True]))
    usual = max(s.unlikely.max() for s in run(slow[:100], surprise))
    stuck = run(np.full((8, 1), 0.5), surprise)[-1].unlikely.max()
    assert usual < 0.1
    assert stuck > 12.0


def test_evidence_for_a_stuck_sense_is_that_of_pages_test():
    p = np.array([[1e-4], [1e-2]])  # of a repetition after none, and after one
    states = run(np.array([[1.0], [1.0], [1.0], [2.0], [np.nan], [np.nan]]), -np.log(p))
    one, two = np.log(STUCK / p[0, 0]), np.log(STUCK / p[1, 0])
    change = np.log((1 - STUCK) / (1 - p[:, 0]))
    rest = np.cumsum([one + two, change[1], change[0], change[0]])
    np.testing.assert_allclose([s.unlikely[0, 0] for s in states], [0.0, one, *rest])
    ratio = improbability(states[2], np.array([REPETITION_OFFSET]))
    np.testing.assert_allclose(ratio, np.exp(TAIL_INDEX * (one + two - REPETITION_OFFSET)))
    assert improbability(states[0], np.array([REPETITION_OFFSET])) == 0.0


def quantised(steps: int, seed: int) -> np.ndarray:
    """(steps, 1) of a sensor at rest, whose noise is a bit more than its resolution: one reading of four repeats."""
    return np.rint(np.random.default_rng(seed).normal(scale=1.14, size=(steps, 1)))


def test_a_sensor_at_rest_may_repeat_itself_by_chance_and_is_found_all_the_same_once_it_sticks():
    counted = count_repetitions([quantised(100, seed) for seed in range(60)], np.array([True]))
    np.testing.assert_allclose(np.exp(-counted[:2, 0]), 0.24, atol=0.03)
    fresh = np.array([max(s.unlikely[0, 0] for s in run(quantised(100, seed), counted)) for seed in range(100, 400)])
    # Page's bound: the chance to come to n from where it last began is e^-n, and there are 100 beginnings.
    for n in (6.0, 8.0):
        assert (fresh >= n).mean() <= 100 * np.exp(-n) + 0.02
    assert (fresh < REPETITION_OFFSET).all()
    stuck = [s.unlikely[0, 0] for s in run(np.ones((20, 1)), counted)]
    assert np.argmax(np.array(stuck) > REPETITION_OFFSET) == pytest.approx(10, abs=1)


def test_what_was_stuck_for_long_is_believed_again_soon():
    p = np.full((2, 1), 1e-4)
    states = run(np.concatenate([np.ones(5000), np.arange(20)])[:, None], -np.log(p), REPETITION_OFFSET + MOST_BEYOND)
    n = np.array([s.unlikely[0, 0] for s in states])
    assert n.max() == n[4999] == REPETITION_OFFSET + MOST_BEYOND
    assert n[5015] < REPETITION_OFFSET


def test_nothing_is_held_against_a_sense_that_nominal_episodes_showed():
    still = np.concatenate([quantised(200, 0), np.ones((30, 1)), quantised(200, 1)])
    counted = count_repetitions([still], np.array([True]))
    reached = max(s.unlikely[0, 0] for s in run(still, counted))
    assert counted[2, 0] == reached > REPETITION_OFFSET


@pytest.fixture(scope="module")
def asm() -> NeuralASM:
    noisy = replace(sine_spec(), channels=tuple(replace(c, noise=0.5) for c in sine_spec().channels))
    fit, others = (sine_episodes(30, seed=seed, spec=noisy, noise=0.5) for seed in (0, 1))
    return NeuralASM(noisy, hidden_size=16, association_size=40, epochs=2).fit(fit).calibrate(others, 0.05)


def test_a_frozen_sense_alarms_within_four_rows_however_poor_the_prediction(asm):
    for n, episode in enumerate(sine_episodes(12, seed=2, spec=asm.spec, noise=0.5)):
        surprise = asm.score(frozen(episode, n, onset=20))
        np.testing.assert_allclose(surprise.attribution.sum(axis=1), surprise.value)
        assert surprise.value[24] > asm.threshold  # of so few episodes
        assert surprise.attribution[23].argmax() == n


def test_what_was_reacted_to_is_forgotten(asm):
    state, row = asm.initial_state(1), sine_episodes(1, spec=asm.spec)[0].stream[:1]
    for _ in range(3):
        state, _ = asm.observe(state, row)
    assert state.detection.repetition.unlikely.any()
    assert not asm.reset_evidence(state).detection.repetition.unlikely.any()


def test_a_memory_of_before_sensors_had_a_resolution_loads(asm):
    detection = asm.detection
    learned = detection.learned_ | {"repetition": detection.learned_["repetition"][:2]}
    old = type(detection)(asm.spec, gains=detection.gains).restore(learned)
    state, row = old.start(1, len(asm.spec.sensory)), np.ones((1, asm.spec.size))
    output = ModelOutput(np.zeros((1, len(asm.spec.sensory))), np.zeros((1, asm.hidden_size)))
    for _ in range(4):
        state, _ = old.attribute_step(state, output, row, lambda parts: np.zeros((1, asm.spec.size)))
    assert (state.repetition.unlikely > REPETITION_OFFSET).all()
    for damaged in (np.full((3, 2), -1.0), np.zeros((1, 2)), np.full((3, len(asm.spec.sensory)), np.nan)):
        with pytest.raises(ValueError, match="repetition of evidence"):
            old.restore(learned | {"repetition": damaged})


def test_an_arm_that_rests_repeats_its_digits_and_is_healthy():
    rng = np.random.default_rng(0)

    def moving(seed: int) -> np.ndarray:
        t = np.arange(400) / 50
        phase = np.random.default_rng(seed).uniform(0, 6)
        encoder = np.rint((np.sin(2 * t + phase) + 1e-5 * rng.normal(size=400)) / 1e-3) * 1e-3
        current = np.cos(2 * t + phase) + 0.05 * rng.normal(size=400)
        return np.stack([encoder, current], axis=1)

    counted = count_repetitions([moving(seed) for seed in range(10)], np.array([True, True]))
    rest = np.stack([np.full(500, 0.5), 0.05 * rng.normal(size=500)], axis=1)
    assert max(s.unlikely.max() for s in run(rest, counted)) < REPETITION_OFFSET
    stuck = rest.copy()
    stuck[:, 1] = 0.3  # what has noise does not rest
    assert run(stuck[:20], counted)[-1].unlikely[0, 1] > REPETITION_OFFSET


def test_the_fewer_episodes_never_rested_the_longer_a_rest_is_believed():
    def rows_until(episodes: int) -> int:
        streams = [np.random.default_rng(seed).normal(size=(100, 1)) for seed in range(episodes)]
        states = run(np.full((40, 1), 0.5), count_repetitions(streams, np.array([True])))
        return int(np.argmax([s.unlikely[0, 0] > REPETITION_OFFSET for s in states]))

    assert [rows_until(n) for n in (4, 12, 90)] == [5, 4, 2]  # 12 = 4.15 * log(0.9 * 20), 3.0 * log(54), 2 * log(405)
