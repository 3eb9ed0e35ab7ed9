"""Limits on what the arms feel, looked at in every physics substep."""

import gymnasium as gym
import numpy as np
import pytest

from asm_gym.detection.contact_limits import ContactLimits

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


def limits(most, stays=True):
    """Of each number by itself [N m], [N]; of speed none."""
    return ContactLimits(1e-9, 1e-9, np.inf, healthy=tuple(most), stays=stays)


def test_what_is_felt_is_what_the_stream_says_the_mean_of(free):
    robot = begin(free)
    felt, row = robot.simulation.felt, robot.measured
    assert felt.shape == (25, 10)
    at = robot.measured_spec.slices
    means = np.concatenate([row[at[c.name]] for c in robot.felt_channels])
    noise = np.concatenate([[c.noise] * c.size for c in robot.felt_channels])
    assert [c.size for c in robot.felt_channels] == [7, 3]
    np.testing.assert_allclose(felt.mean(axis=0), means, atol=6 * noise.max())


@pytest.mark.parametrize("number", range(10))
def test_passing_any_of_them_is_known_in_that_substep_and_counts_for_one_step(free, number):
    robot = begin(free)
    free.step(ACTION)
    felt = np.abs(robot.simulation.felt[:, number])
    robot = begin(free)
    most = np.full(10, WIDE)
    most[number] = np.median(felt)
    beyond = felt > most[number]
    robot.contact_limits = limits(most, stays=False)
    *_, info = free.step(ACTION)
    when = 0.002 * (1 + np.argmax(beyond)) if beyond.any() else np.inf
    assert info["contact_left_s"] == pytest.approx(when)
    robot.contact_limits = limits(np.full(10, WIDE), stays=False)
    *_, info = free.step(ACTION)
    assert info["contact_left_s"] == np.inf


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
        robot.contact_limits = limits(np.zeros(10), stays)
        *_, info = env.step(action)
        assert info["contact_left_s"] == 0.002
        robot.contact_limits = None
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
