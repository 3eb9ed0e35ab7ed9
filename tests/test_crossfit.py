"""Cross-fitting: each row is judged by what has not learned from it, and precision is that of rows to come."""

from __future__ import annotations

import numpy as np
import pytest

from asm_gym.memory.association import ALL_TICKS, complete, hidden_units, learn_association
from asm_gym.memory.crossfit import THIRDS, crossfit, thirds
from asm_gym.memory.precision import log_variance


def test_thirds_are_of_whole_episodes_and_of_about_as_many_each():
    lengths = [5, 9, 1, 7, 30, 2, 4, 8]
    third = thirds(sum(lengths), lengths, np.random.default_rng(0))
    whole = np.split(third, np.cumsum(lengths)[:-1])
    assert all(len(set(rows)) == 1 for rows in whole)
    assert sorted(np.bincount([rows[0] for rows in whole])) == [2, 3, 3]


def test_episodes_that_take_turns_do_not_leave_a_skill_in_one_third():
    skill = np.arange(60) % THIRDS
    third = thirds(60, [1] * 60, np.random.default_rng(0))
    assert all(len(set(third[skill == s])) == THIRDS for s in range(THIRDS))


@pytest.mark.parametrize("lengths", [(), (10,), (3, 7)])
def test_with_fewer_than_three_episodes_thirds_are_rows_that_follow_each_other(lengths):
    found = thirds(10, lengths, np.random.default_rng(0))
    assert found.tolist() == [0, 0, 0, 0, 1, 1, 1, 2, 2, 2]


def test_no_row_is_expected_by_who_learned_from_it():
    rng = np.random.default_rng(1)
    truth = rng.normal(size=(60, 2)).astype(np.float32)
    third = thirds(60, [6] * 10, rng)

    def mean(learned_from, asked):
        assert not (learned_from & asked).any()
        assert (learned_from | asked).all()
        return np.repeat(truth[learned_from].mean(axis=0, keepdims=True), asked.sum(), axis=0)

    found = crossfit(mean, third, 2)
    by_hand = np.array([truth[third != third[n]].mean(axis=0) for n in range(60)])
    np.testing.assert_allclose(found, by_hand, atol=1e-6)


def lesson(rng: np.random.Generator, episodes: int, steps: int) -> tuple[np.ndarray, np.ndarray]:
    """Inputs and changes of two groups; each episode bends what ties them in a way of its own, as skills do."""
    rows = []
    for _ in range(episodes):
        cause, own = rng.normal(size=(steps, 2)), rng.normal(size=2)
        bent = np.sin(2 * cause) + 0.5 * np.cos(3 * cause + own) + 0.05 * rng.normal(size=cause.shape)
        rows.append(np.hstack([cause, bent]))
    delta = np.concatenate(rows).astype(np.float32)
    return np.hstack([delta, np.ones((len(delta), 1), np.float32)]), delta


def test_precision_is_that_of_rows_that_were_never_learned():
    rng = np.random.default_rng(2)
    layout = np.array([0, 0, 1, 1]), slice(0, 4), 64
    inputs, delta = lesson(rng, 12, 50)
    ticks = []
    w = learn_association(inputs, delta, *layout, rng, lambda: ticks.append(1), passes=400, lengths=[50] * 12)
    assert len(ticks) == ALL_TICKS

    def squared(inputs, delta):
        f = hidden_units(inputs, w.V)
        error = (delta - complete(f, inputs, w.U, w.D)) / w.remainder
        return np.mean(error**2 * np.exp(-log_variance(f, w.W_S, w.b_S, w.span_S)))

    fresh = squared(*lesson(rng, 100, 50))
    assert 0.6 < fresh < 1.7  # 1: errors are as large as was said


def test_what_units_know_by_heart_alone_is_not_believed():
    rng = np.random.default_rng(3)
    delta = rng.normal(size=(600, 4)).astype(np.float32)
    inputs = np.hstack([delta, np.ones((600, 1), np.float32)])
    groups = np.array([0, 0, 1, 1])
    w = learn_association(inputs, delta, groups, slice(0, 4), 128, rng, passes=400, lengths=[20] * 30)
    expected = complete(hidden_units(inputs, w.V), inputs, w.U, w.D)
    assert np.abs(expected).max() < 0.3 * np.abs(delta).max()
    np.testing.assert_allclose(np.sqrt(np.mean((delta - expected) ** 2, axis=0)), delta.std(axis=0), rtol=0.1)
