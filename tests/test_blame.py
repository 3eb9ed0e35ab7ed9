"""Blame: the channel at fault is found by what explains a row, and the more surely the larger the fault."""

from __future__ import annotations

from functools import cache

import gymnasium as gym
import numpy as np
import pytest

from asm_gym.memory.completion import Completion, usual_readings
from asm_gym.monitors.blame import Blame, FollowedBlame
from asm_gym.policies import make_policy
from asm_gym.scaling import StreamScaler
from asm_gym.synthetic_arm import JOINTS, SyntheticArm

SPEC = SyntheticArm.stream_spec
D = SPEC.size
ROW = 250  # in which a fault begins


def motion(seed: int) -> np.ndarray:
    env = gym.make("asm_gym/SyntheticArm-v0")
    policy = make_policy("scripted", env, seed)
    observation, _ = env.reset(seed=seed)
    rows = []
    for _ in range(400):
        observation, *_, info = env.step(policy.predict(observation)[0])
        rows.append(info["stream"])
    return np.array(rows, np.float32)


@cache
def learned() -> tuple[Blame, np.ndarray, np.ndarray]:
    """A blame, a healthy episode that it has not seen, and the width of each channel's range."""
    streams = [motion(seed) for seed in range(30)]
    completion = Completion.fit(StreamScaler.fit(SPEC, streams), streams)
    assert completion is not None
    return Blame(completion), motion(99), np.ptp(np.concatenate(streams), axis=0)


def misled(column: int) -> np.ndarray:
    """Shares of which a channel of another joint has nearly all."""
    shares = np.full(D, 0.01)
    shares[(column + 3) % JOINTS] = 1.0
    return shares


@pytest.mark.parametrize("size", [-10.0, -1.0, 1.0, 10.0])
def test_the_channel_that_is_shifted_is_blamed_however_far_it_is(size):
    blame, healthy, width = learned()
    right = []
    for column in range(D):
        rows = healthy[: ROW + 1].copy()
        rows[ROW, column] += size * width[column]
        right.append(blame(rows, misled(column))[0] == column)
    assert np.mean(right) >= 0.95


def test_a_small_shift_is_found_among_the_channels_that_surprise():
    blame, healthy, width = learned()
    right = []
    for column in range(D):
        rows = healthy[: ROW + 1].copy()
        rows[ROW, column] += 0.05 * width[column]
        joint = np.zeros(D)
        joint[column % JOINTS :: JOINTS] = 1.0
        right.append(blame(rows, joint)[0] == column)
    assert np.mean(right) >= 0.8


def test_an_angle_that_wraps_and_a_reading_that_repeats_are_blamed():
    blame, healthy, _ = learned()
    for joint in range(JOINTS):
        wrapped = healthy[: ROW + 1].copy()
        wrapped[ROW, joint] += 2 * np.pi
        assert blame(wrapped, misled(joint))[0] == joint
    for column in range(D):
        frozen = healthy[: ROW + 4].copy()
        frozen[ROW:, column] = frozen[ROW, column]
        assert blame(frozen, misled(column))[0] == column


def test_two_channels_at_fault_are_both_blamed():
    blame, healthy, width = learned()
    rows = healthy[: ROW + 1].copy()
    rows[ROW, [1, 18]] += width[[1, 18]]
    assert set(blame(rows, misled(1))) >= {1, 18}


def test_a_row_that_lacks_a_number_is_left_to_the_missing_number():
    blame, healthy, _ = learned()
    rows = healthy[: ROW + 1].copy()
    rows[ROW, 3] = np.nan
    assert blame(rows, misled(3)) == ()
    rows[ROW - 1, 3] = np.nan
    rows[ROW] = healthy[ROW]
    rows[ROW, 9] += 100.0
    assert blame(rows, misled(9))[0] == 9


def test_shares_change_in_the_first_row_of_an_alarm_alone():
    blame, healthy, width = learned()
    rows = healthy.copy()
    rows[ROW:, 2] += 5 * width[2]
    shares = np.tile(misled(2), (len(rows), 1))
    alarm = np.arange(len(rows)) >= ROW

    class Monitor:
        blame_ = blame

    followed = FollowedBlame(Monitor())
    by_row = [followed.shares(*now) for now in zip(rows, alarm, shares, strict=True)]
    assert by_row[ROW].argmax() == 2
    assert by_row[ROW].sum() == pytest.approx(shares[ROW].sum())
    np.testing.assert_array_equal(np.delete(by_row, ROW, 0), np.delete(shares, ROW, 0))


def test_a_monitor_that_cannot_blame_keeps_its_shares():
    shares = misled(0)
    followed = FollowedBlame(object())
    assert followed.shares(np.zeros(D), True, shares) is shares


def test_what_a_memory_saves_blames_the_same():
    blame, healthy, width = learned()
    again = Completion.found(blame.completion.named(), blame.completion.senses)
    assert again is not None
    np.testing.assert_array_equal(again.usual, blame.completion.usual)
    rows = healthy[: ROW + 1].copy()
    rows[ROW, 5] += 10 * width[5]
    assert Blame(again)(rows, misled(5))[0] == 5


def test_ranges_and_repeats_are_those_of_all_episodes():
    first = np.array([[0.0, 1.0], [2.0, 1.0], [2.0, 1.0], [1.0, 3.0]])
    second = np.array([[5.0, 1.0], [5.0, 2.0], [5.0, 2.0]])
    np.testing.assert_array_equal(
        usual_readings([first, second]), [[0.0, 1.0], [5.0, 3.0], [3.0, 3.0]]
    )


def test_a_value_out_of_its_range_does_not_poison_what_is_predicted_from_it():
    """A second channel that is slightly wrong is found beside one that is far out of range."""
    blame, healthy, width = learned()
    rows = healthy[: ROW + 1].copy()
    rows[ROW, 0] += 50 * width[0]
    rows[ROW, 20] += 0.5 * width[20]
    assert blame(rows, misled(0))[:2] == (0, 20)
