"""The compiled speed limit scales actions as the same written plainly in NumPy does."""

import gymnasium as gym
import numpy as np
import pytest

from asm_gym.detection.contact_limits import ContactLimits
from asm_gym.detection.hand_speed import cell_near
from asm_gym.detection.hand_speed_map import HandSpeedMap
from asm_gym.envs.arm_brake import BESIDE_BASE
from asm_gym.monitors import NeuralASM
from tests.hand_motion import hand_momentum, hand_speed, joint_twist

STILL = 1e-9
SLACK = np.array([0.03, 0.03, 0.03, 0.15, 0.15, 0.15])


def share_of(limits, arm, place, twist, momentum, upright=1.0):
    """Return the share that a hand may have of a motion."""
    own = limits.speed_limit()
    usual = min(
        limits.hand_speed / max(hand_speed(twist), STILL), own.momentum / max(momentum, STILL)
    )
    if limits.pace is None or upright < limits.pace.least_upright:
        return usual
    along, against = limits.pace.fastest_near(arm, place).astype(float)
    healthy = 1.25 * np.where(twist > 0.0, along, against) + SLACK
    known = (healthy / np.maximum(np.abs(twist), STILL)).min()
    down = min(max(1.05 * against[2], 0.03), limits.hand_speed)
    known = min(known, down / max(-twist[2], STILL), own.pace_momentum / max(momentum, STILL))
    return max(usual, known)


def asked_twist(env, arm, action):
    """Return the twist that a controller comes to which is asked for an action again and again."""
    simulation = env.simulation
    controller, part = simulation.controllers[arm], simulation.moves[arm]
    low, high = env.robosuite_env.action_spec
    command = 0.5 * (high + low) + 0.5 * (high - low) * action
    change = controller.scale_action(command[part].copy())
    velocity = change * (controller.kp / controller.kd)[: len(change)]
    if controller.name == "JOINT_POSITION":
        return joint_twist(simulation, arm, velocity)
    frame = simulation.data.site(
        f"{controller.naming_prefix}{controller.part_name}_center"
    ).xmat.reshape(3, 3)
    twist = np.zeros(6)
    twist[: len(velocity)] = velocity
    return np.concatenate([frame @ twist[:3], frame @ twist[3:]])


def slowed(env, action, limits):
    """Return the action, and the speed from which on each arm is braked."""
    simulation = env.simulation
    action, brakes = action.astype(float), []
    for arm, (controller, part) in enumerate(
        zip(simulation.controllers, simulation.moves, strict=True)
    ):
        place = simulation.data.site_xpos[simulation.arms.site[arm]]
        base = simulation.data.xpos[simulation.arms.root[arm]]
        own = limits
        if np.linalg.norm((place - base)[:2]) < BESIDE_BASE:
            momentum = limits.speed_limit().momentum / 2
            own = ContactLimits(hand_speed=limits.hand_speed / 2, momentum=momentum)
        brakes.append(own.hand_speed)
        if controller.name == "IK_POSE":
            continue
        asked = asked_twist(env, arm, action)
        upright = -simulation.data.site_xmat[simulation.arms.site[arm], 8]
        momentum = hand_momentum(simulation, arm, asked)
        share = share_of(own, arm, place, asked, momentum, upright)
        brakes[-1] = max(own.hand_speed, hand_speed(asked) * share)
        if share < 1.0:
            action[part] *= share  # an action of 0 changes nothing
    return action, np.array(brakes)


@pytest.fixture(scope="module")
def maps():
    """No map, and the map of a task, and of all tasks together for two arms."""
    pace = NeuralASM.pretrained("panda").pace_
    both = [cells + arm * np.eye(16)[0] for cells in pace.values() for arm in (0, 1)]
    return None, HandSpeedMap.of(pace, "Lift"), HandSpeedMap(np.concatenate(both))


CASES = [
    ("Lift", "OSC_POSE", None),
    ("Lift", "OSC_POSITION", None),
    ("Lift", "JOINT_POSITION", None),
    ("Lift", "IK_POSE", None),
    ("Lift", "OSC_POSE", "Sawyer"),
    ("TwoArmLift", "OSC_POSE", ("Panda", "Sawyer")),
    ("TwoArmLift", "OSC_POSITION", None),
    ("TwoArmHandover", "JOINT_POSITION", None),
]


@pytest.mark.parametrize(("task", "controller", "robot"), CASES)
def test_actions_are_slowed_as_the_equation_says(task, controller, robot, maps):
    env = gym.make(
        f"asm_gym/{task}-v0", controller=controller, robot=robot, disable_env_checker=True
    )
    env.reset(seed=0)
    arm, rng = env.unwrapped, np.random.default_rng(0)
    towards_base = np.zeros(env.action_space.shape, np.float32)
    towards_base[arm.simulation.moves[0].start] = -1.0
    slower = 0
    for step in range(40):
        action = (rng.uniform(-1, 1, env.action_space.shape) * rng.choice([0.0, 0.2, 1.0])).astype(
            np.float32
        )
        for speed_map in maps:
            arm.contact_limits = ContactLimits(
                1e6, 1e6, rng.choice([0.02, 0.1, 0.3]), pace=speed_map
            )
            expected, brakes = slowed(arm, action, arm.contact_limits)
            np.testing.assert_allclose(arm._slowed(action), expected, atol=2e-6)
            np.testing.assert_allclose(arm.simulation.speed_limits, brakes, rtol=1e-6)
            slower += bool(np.abs(expected).sum() < 0.999 * np.abs(action).sum())
        arm.contact_limits = None
        env.step(towards_base if step > 20 else action)
    env.close()
    assert slower > 5 or controller == "IK_POSE"


def test_without_a_limit_of_speed_an_action_stays_and_no_arm_is_braked(lift):
    lift.reset(seed=0)
    arm, action = lift.unwrapped, np.ones(7, np.float32)
    arm.contact_limits = ContactLimits(hand_speed=np.inf)
    np.testing.assert_array_equal(arm._slowed(action), action)
    assert np.isinf(arm.simulation.speed_limits).all()


@pytest.mark.parametrize(
    "place", [np.full(3, np.nan), np.full(3, np.inf), np.full(3, 1e30), np.full(3, -9.0)]
)
def test_nothing_is_known_of_a_place_outside_the_map(place):
    speed_map = HandSpeedMap(np.array([[1, 0, 0, 0, *[0.1] * 12]]))
    assert cell_near(speed_map.grid, speed_map.low, 1, np.array([0.01, 0.01, 0.01])) >= 0
    assert cell_near(speed_map.grid, speed_map.low, 0, np.array([0.01, 0.01, 0.01])) == -1
    assert cell_near(speed_map.grid, speed_map.low, 1, place) == -1
    assert not speed_map.fastest_near(1, place).any()
