"""A band on what the arms feel, looked at in every physics substep."""

import gymnasium as gym
import numpy as np
import pytest

from asm_gym.faults import Push
from asm_gym.wrappers import FaultInjection

ACTION = np.array([0.4, 0.2, -0.3, 0.1, 0.0, 0.2, -1.0], np.float32)
WIDE = 1e6


@pytest.fixture(scope="module")
def free():
    """An arm that moves freely, in steps of 25 substeps."""
    env = gym.make("asm_gym/Lift-v0", horizon=100)
    yield env
    env.close()


def begin(env, steps=5):
    env.reset(seed=3)
    for _ in range(steps):
        env.step(ACTION)
    return env.unwrapped


def test_what_is_felt_is_what_the_stream_says_the_mean_of(free):
    robot = begin(free)
    felt, row = robot.felt, robot.measured
    assert felt.shape == (25, 10)
    at = robot.measured_spec.slices
    means = np.concatenate([row[at[c.name]] for c in robot.felt_channels])
    noise = np.concatenate([[c.noise] * c.size for c in robot.felt_channels])
    assert [c.size for c in robot.felt_channels] == [7, 3]
    np.testing.assert_allclose(felt.mean(axis=0), means, atol=6 * noise.max())


def test_a_band_that_is_not_left_changes_nothing(free):
    robot = begin(free)
    free.step(ACTION)
    alone = robot.simulation.data.qpos.copy()
    robot = begin(free)
    robot.expect(np.full(10, -WIDE), np.full(10, WIDE))
    free.step(ACTION)
    assert robot.left_band_s is None
    np.testing.assert_array_equal(robot.simulation.data.qpos, alone)


@pytest.mark.parametrize("number", range(10))
def test_leaving_it_in_any_number_is_known_in_that_substep_and_counts_for_one_step(free, number):
    robot = begin(free)
    free.step(ACTION)
    felt = robot.felt[:, number].copy()
    robot = begin(free)
    low, high = np.full(10, -WIDE), np.full(10, WIDE)
    middle = np.median(felt)
    beyond = felt > middle
    high[number] = middle
    robot.expect(low, high, stays=False)
    free.step(ACTION)
    assert robot.left_band_s == (pytest.approx(0.002 * (1 + np.argmax(beyond))) if beyond.any() else None)
    free.step(ACTION)
    assert robot.left_band_s is None


@pytest.mark.parametrize("controller", ["OSC_POSE", "JOINT_POSITION", "JOINT_TORQUE"])
def test_the_arm_stays_from_the_next_substep_on_whatever_its_controller(controller):
    env = gym.make("asm_gym/Lift-v0", horizon=100, controller=controller)
    action = np.zeros(env.action_space.shape, np.float32)
    action[:2], action[-1] = 0.5, 1.0

    def travelled(stays, holds):
        robot = begin(env, 0)
        for _ in range(5):
            env.step(action)
        joints = robot.simulation.data.qpos[:7].copy()
        robot.expect(np.zeros(10), np.zeros(10), stays)
        *_, info = env.step(action)
        assert robot.left_band_s == 0.002
        said = info["stream"][env.unwrapped.stream_spec.motor]
        for _ in range(3):
            robot.holding = holds
            env.step(action)
        return np.abs(robot.simulation.data.qpos[:7] - joints).max(), said

    went, said = travelled(False, holds=False)
    np.testing.assert_array_equal(said, action)
    held, _ = travelled(False, holds=True)
    stayed, said = travelled(True, holds=True)
    assert stayed < held < went
    assert not said[:2].any()  # what was done last
    assert said[-1] == 1.0
    env.close()


def test_a_push_of_20_newtons_is_felt_within_two_substeps(free):
    robot = begin(free)
    usual = robot.felt
    low, high = usual.min(axis=0) - 2.0, usual.max(axis=0) + 2.0
    pushed = FaultInjection(free, [Push(body="robot0_link5", newtons=20.0, onset=6, duration=4)])
    robot = begin(pushed, 6)
    robot.expect(low, high)
    pushed.step(ACTION)
    assert robot.left_band_s <= 0.004
    pushed.undo_faults()


@pytest.mark.parametrize(
    ("low", "high"),
    [(np.zeros(9), np.ones(9)), (np.ones(10), np.zeros(10)), (np.full(10, np.nan), np.ones(10))],
)
def test_a_band_that_is_none_is_refused(free, low, high):
    with pytest.raises(ValueError, match="a band needs"):
        begin(free, 0).expect(low, high)
