"""What the memory reads of a row: values and changes, standardised."""

import numpy as np
import pytest

from asm_gym.scaling import FARTHEST_NUMBER, StreamScaler
from asm_gym.spec import MOTOR, Channel, StreamSpec

SPEC = StreamSpec(
    (Channel("slow", 1), Channel("fast", 2), Channel("action", 1, group=MOTOR)), dt=0.05
)


@pytest.fixture
def streams():
    rng = np.random.default_rng(0)
    made = []
    for _ in range(3):
        slow = np.cumsum(rng.normal(0, 0.1, (200, 1)), axis=0)
        made.append(np.hstack([slow, rng.standard_normal((200, 3))]).astype(np.float32))
    return made


def test_values_and_changes_are_standardised_by_hand(streams):
    senses = StreamScaler.fit(SPEC, streams)
    row, before, earlier = np.array(
        [[1.0, 2.0, 3.0, 0.5], [0.9, 0.0, 0.0, 0.0], [0.7, 9.0, 9.0, 9.0]]
    )[:, None]
    reading = senses.read(row, before, earlier)
    rows = np.concatenate(streams).astype(np.float64)
    steps = np.concatenate([np.diff(s.astype(np.float64), axis=0) for s in streams])
    expected = [*((row[0, :3] - rows.mean(0)[:3]) / rows.std(0)[:3]), 0.1 / steps[:, 0].std()]
    np.testing.assert_allclose(reading.senses[0], expected, rtol=1e-5)
    np.testing.assert_allclose(
        reading.commands[0], [(0.5 - rows.mean(0)[3]) / rows.std(0)[3], 1.0], rtol=1e-5
    )
    assert reading.seen.all()
    last = [
        *((before[0] - rows.mean(0)) / rows.std(0)),
        *((row[0, :3] - before[0, :3]) / steps.std(0)[:3]),
    ]
    lately = 0.2 / steps[:, 0].std()
    np.testing.assert_allclose(reading.inputs[0], [*last, lately, *reading.commands[0]], rtol=1e-4)
    assert senses.inputs == reading.inputs.shape[1]
    assert reading.whole.all()


def test_a_gap_hides_the_value_and_the_changes_on_both_its_sides(streams):
    senses = StreamScaler.fit(SPEC, streams)
    good, gap = np.ones((1, 4)), np.array([[np.nan, 1.0, 1.0, 1.0]])
    assert senses.read(gap, good, good).seen[0].tolist() == [0, 1, 1, 0]
    assert senses.read(good, gap, good).seen[0].tolist() == [1, 1, 1, 0]
    for rows in ((gap, good, good), (good, gap, good), (good, good, gap)):
        assert not senses.read(*rows).whole.any()
    assert senses.read(good, gap, good).inputs[0, [0, 4, 7]].tolist() == [0, 0, 0]
    assert senses.read(gap, good, good).finite[0].tolist() == [False, True, True, True]


def test_huge_numbers_are_cut_off_and_stay_finite(streams):
    senses = StreamScaler.fit(SPEC, streams)
    reading = senses.read(np.full((1, 4), 1.7e308), np.full((1, 4), -1.7e308), np.zeros((1, 4)))
    assert (reading.senses == FARTHEST_NUMBER).all()
    assert (reading.changes == FARTHEST_NUMBER).all()
    assert not reading.inputs[0, :-1].any()  # nothing is expected from them
    assert reading.seen.all()
