"""StreamScaler that say the same twice: counted in nominal streams, and held against how rare that was."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from asm_gym.detection.repetition import (
    FADING,
    REPETITION_OFFSET,
    Repetition,
    count_repetitions,
    improbability,
    repeated,
    unrepeated,
)
from asm_gym.detection.tails import TAIL_INDEX
from asm_gym.monitors import NeuralASM
from tests.streams import frozen, sine_episodes, sine_spec


def run(rows: np.ndarray, surprise: np.ndarray) -> list[Repetition]:
    state, states = unrepeated(1, rows.shape[1]), []
    for row in rows:
        state = Repetition(*repeated(*state, row[None], surprise))
        states.append(state)
    return states


def test_repetitions_are_counted_after_none_and_after_one():
    # Repeated:        no, no, yes, yes, no, no: after none 1 in 3, after one 1 in 2.
    stream = np.array([1.0, 2, 3, 3, 3, 4, 5])[:, None]
    found = count_repetitions([stream], np.array([True]))
    first = (1 + 0.5) / (3 + 1)
    np.testing.assert_allclose(np.exp(-found[:, 0]), [first, (1 + first) / (2 + 1)])


def test_a_sense_without_declared_noise_is_watched_unless_it_stood_still_before():
    streams = [np.random.default_rng(seed).normal(size=(100, 3)) for seed in range(2)]
    streams[1][50, 1] = streams[1][49, 1]
    found = count_repetitions(streams, np.array([True, False, False]))
    assert (found[:, [0, 2]] > 4.0).all()
    assert (found[:, 1] == 0.0).all()


def test_a_sense_read_at_half_the_rate_surprises_nobody_until_it_sticks():
    rng = np.random.default_rng(0)
    slow = np.repeat(rng.normal(size=500), 2)[:, None]
    surprise = count_repetitions([slow], np.array([True]))
    usual = max(s.unlikely.max() for s in run(slow[:100], surprise))
    stuck = run(np.full((8, 1), 0.5), surprise)[-1].unlikely.max()
    assert usual < 0.1
    assert stuck > 12.0


def test_what_was_repeated_adds_up_and_fades():
    surprise = np.array([[8.0], [3.0]])
    states = run(np.array([[1.0], [1.0], [1.0], [2.0], [np.nan], [np.nan]]), surprise)
    one, two = 8.0, 8.0 * (1 - FADING) + 3.0
    faded = two * (1 - FADING) ** np.arange(4)
    np.testing.assert_allclose([s.unlikely[0, 0] for s in states], [0.0, one, *faded])
    np.testing.assert_allclose(improbability(states[2]), np.exp(TAIL_INDEX * (two - REPETITION_OFFSET)))
    assert improbability(states[0]) == 0.0


@pytest.fixture(scope="module")
def asm() -> NeuralASM:
    noisy = replace(sine_spec(), channels=tuple(replace(c, noise=0.5) for c in sine_spec().channels))
    fit, others = (sine_episodes(30, seed=seed, spec=noisy, noise=0.5) for seed in (0, 1))
    return NeuralASM(noisy, hidden_size=16, association_size=40, epochs=2).fit(fit).calibrate(others, 0.05)


def test_a_frozen_sense_alarms_within_three_rows_however_poor_the_prediction(asm):
    for n, episode in enumerate(sine_episodes(12, seed=2, spec=asm.spec, noise=0.5)):
        surprise = asm.score(frozen(episode, n, onset=20))
        np.testing.assert_allclose(surprise.attribution.sum(axis=1), surprise.value)
        assert surprise.value[23] > asm.threshold
        assert surprise.attribution[23].argmax() == n


def test_what_was_reacted_to_is_forgotten(asm):
    state, row = asm.initial_state(1), sine_episodes(1, spec=asm.spec)[0].stream[:1]
    for _ in range(3):
        state, _ = asm.observe(state, row)
    assert state.detection.repetition.unlikely.any()
    assert not asm.reset_evidence(state).detection.repetition.unlikely.any()
