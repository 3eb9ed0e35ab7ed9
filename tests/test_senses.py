"""What the memory senses of a row: values, changes, and what is judged; and that evidence is bounded."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from asm_gym.detection import bounded
from asm_gym.memory.senses import FARTHEST, Senses
from asm_gym.stream import MOTOR, Channel, StreamSpec

SPEC = StreamSpec((Channel("slow", 1), Channel("fast", 2), Channel("action", 1, group=MOTOR)), dt=0.05)


@pytest.fixture
def streams():
    rng = np.random.default_rng(0)
    made = []
    for _ in range(3):
        slow = np.cumsum(rng.normal(0, 0.1, (200, 1)), axis=0)
        made.append(np.hstack([slow, rng.standard_normal((200, 3))]).astype(np.float32))
    return made


def test_slow_channels_are_judged_by_their_change_and_fast_ones_by_their_value(streams):
    senses = Senses.fit(SPEC, streams)
    assert senses.slow.tolist() == [0]
    assert senses.size == 4
    assert senses.judged.tolist() == [3, 1, 2]


def test_values_and_changes_are_standardised_by_hand(streams):
    senses = Senses.fit(SPEC, streams)
    row, before = np.array([[1.0, 2.0, 3.0, 0.5]]), np.array([[0.9, 0.0, 0.0, 0.0]])
    reading = senses.read(row, before)
    rows = np.concatenate(streams).astype(np.float64)
    steps = np.concatenate([np.diff(s.astype(np.float64), axis=0) for s in streams])
    expected = [*((row[0, :3] - rows.mean(0)[:3]) / rows.std(0)[:3]), 0.1 / steps[:, 0].std()]
    np.testing.assert_allclose(reading.senses[0], expected, rtol=1e-5)
    np.testing.assert_allclose(reading.commands[0], [(0.5 - rows.mean(0)[3]) / rows.std(0)[3], 1.0], rtol=1e-5)
    assert reading.seen.all()


def test_a_gap_hides_the_value_and_the_changes_on_both_its_sides(streams):
    senses = Senses.fit(SPEC, streams)
    good, gap = np.ones((1, 4)), np.array([[np.nan, 1.0, 1.0, 1.0]])
    assert senses.read(gap, good).seen[0].tolist() == [0, 1, 1, 0]
    assert senses.read(good, gap).seen[0].tolist() == [1, 1, 1, 0]
    assert senses.read(gap, good).finite[0].tolist() == [False, True, True, True]


def test_huge_numbers_are_cut_off_and_stay_finite(streams):
    senses = Senses.fit(SPEC, streams)
    reading = senses.read(np.full((1, 4), 1.7e308), np.full((1, 4), -1.7e308))
    assert (reading.senses == FARTHEST).all()
    assert reading.seen.all()


@given(st.floats(0.1, 1e6), st.floats(1.0, 100.0))
def test_no_step_counts_more_than_the_bound_and_small_ones_count_in_full(size, bound):
    direction = np.array([[3.0, -4.0, 0.0]]) / 5.0
    pulled = bounded(size * direction, bound)
    assert (pulled**2).sum() <= bound * 3 * (1 + 1e-12)
    np.testing.assert_allclose(pulled / np.linalg.norm(pulled), direction, atol=1e-12)
    np.testing.assert_allclose(bounded(1e-6 * direction, bound), 1e-6 * direction, rtol=1e-9)
