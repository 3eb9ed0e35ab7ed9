"""A hold that holds: under every controller, every robot and every wrapper order, with the joints' motion as oracle."""

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.vector import AsyncVectorEnv, SyncVectorEnv

import asm_gym  # noqa: F401
from asm_gym.detection.contact_limits import ContactLimits
from asm_gym.envs.controllers import YIELDS_AT
from asm_gym.envs.robosuite_backend import CONTROLLERS
from asm_gym.envs.robots import robot_named
from asm_gym.faults import Push
from asm_gym.tasks import ROBOTS
from asm_gym.wrappers import FaultInjection, NeuralASMSafety, VectorNeuralASMSafety
from tests.fakes import CueMonitor, FadingMonitor

AT = 8
"""The control step from which the robot is held, at full speed."""


def joints(env):
    """Angles [rad] and speeds [rad/s]."""
    inner = env.unwrapped
    data, robots = inner.simulation.data, inner.robosuite_env.robots
    places = [
        np.concatenate([getattr(robot, f"_ref_joint_{what}_indexes") for robot in robots])
        for what in ("pos", "vel")
    ]
    return data.qpos[places[0]].copy(), data.qvel[places[1]].copy()


def motion(env, held=30):
    """How fast the joints were when they were held, how far they then went, and how fast they are at last."""
    env.reset(seed=1)
    action = np.sign(np.random.default_rng(1).standard_normal(env.action_space.shape)).astype(
        np.float32
    )
    for _ in range(AT):
        env.step(action)
    (start, speed), farthest = joints(env), 0.0
    for _ in range(held):
        info = env.step(action)[4]
        assert info["asm"]["intervened"]
        assert not info["asm"]["failure"]
        farthest = max(farthest, float(np.abs(joints(env)[0] - start).max()))
    return float(np.abs(speed).max()), farthest, float(np.abs(joints(env)[1]).max())


def made(robot="Panda", controller="OSC_POSE", **more):
    return gym.make("asm_gym/Lift-v0", robot=robot, controller=controller, horizon=500, **more)


def guarded(env, **more):
    """Without contact limits, which would stop an arm at its joints' stops before it is told to stay."""
    monitor = CueMonitor(range(AT - 1, 500), spec=env.get_wrapper_attr("stream_spec"))
    return NeuralASMSafety(env, monitor, contact_limits=None, **more)


def assert_stays(speed, farthest, last):
    # Critically damped at ω a joint goes v₀/(e ω) further; the wrist's motors are at their limit meanwhile, 12 N m for
    # 0.9 kg m² of their own, which is v₀²/27 rad.
    assert farthest < 0.01 + 0.05 * speed + speed**2 / 20
    assert last < 0.02


@pytest.mark.parametrize("controller", CONTROLLERS)
@pytest.mark.parametrize(
    "robot", [r if r == "Panda" else pytest.param(r, marks=pytest.mark.slow) for r in ROBOTS]
)
def test_held_at_speed_the_joints_stop_where_they_are(robot, controller):
    if controller == "IK_POSE" and not robot_named(robot).has_inverse_kinematics:
        with pytest.raises(ValueError, match=f"IK_POSE is for Panda, Sawyer, and not for {robot}"):
            made(robot, controller)
        return
    env = guarded(made(robot, controller))
    assert_stays(*motion(env))
    env.close()


class Halved(gym.ActionWrapper):
    def action(self, action):
        return 0.5 * action + 0.5


class Stubborn(gym.Wrapper):
    """Drives on at full scale whatever it is told, and is no ActionWrapper."""

    def step(self, action):
        return self.env.step(np.ones_like(action))


INSIDE = {
    "rescaled": lambda e: gym.wrappers.RescaleAction(e, np.float32(0.0), np.float32(1.0)),
    "sticky": lambda e: gym.wrappers.StickyAction(e, 0.9),
    "shifted": Halved,
    "clipped": gym.wrappers.ClipAction,
    "stubborn": Stubborn,
    "faults": lambda e: FaultInjection(e, []),
}


@pytest.mark.parametrize("wrapper", INSIDE.values(), ids=INSIDE)
def test_whatever_wrapper_is_inside_the_robot_stays(wrapper, lift):
    assert_stays(*motion(guarded(wrapper(lift))))
    if wrapper is INSIDE["rescaled"]:
        assert_stays(*motion(wrapper(guarded(lift))))


def test_a_hold_keeps_the_grip_whatever_wrapper_is_inside(lift):
    env = guarded(INSIDE["rescaled"](lift))
    env.reset(seed=0)
    for _ in range(AT + 2):
        stream = env.step(np.ones(7, np.float32))[4]["stream"]
    commanded = stream[lift.unwrapped.stream_spec.slices["action"]]
    np.testing.assert_array_equal(commanded, [0, 0, 0, 0, 0, 0, 1])


def test_held_within_a_step_the_robot_stays_too():
    env = made(controller="IK_POSE", stream_freq=100)
    monitor = CueMonitor(range(5 * AT - 3, 2500), spec=env.unwrapped.stream_spec)
    env = NeuralASMSafety(env, monitor, contact_limits=None)
    assert_stays(*motion(env))
    env.close()


def pushed(controller, newtons, steps=30):
    """How far the joints of an arm that is held are pushed by a force at its hand for half a second, and stay [rad]."""
    push = Push(
        body="robot0_right_hand",
        newtons=newtons,
        direction=(0.0, 1.0, 0.0),
        onset=AT + 10,
        duration=10,
    )
    inner = FaultInjection(made(controller=controller), [push])
    env = guarded(inner)
    env.reset(seed=0)
    for _ in range(AT + 10):
        env.step(np.zeros(env.action_space.shape, np.float32))
    start, moved = joints(env)[0], []
    for _ in range(steps):
        env.step(np.zeros(env.action_space.shape, np.float32))
        moved.append(np.abs(joints(env)[0] - start).max())
    env.close()
    return max(moved), moved[-1]


@pytest.mark.parametrize("controller", ["OSC_POSE", "JOINT_POSITION", "IK_POSE"])
def test_an_arm_that_is_held_resists_a_push_comes_back_and_yields_to_more_than_it_is_said_to(
    controller,
):
    farthest, after = pushed(controller, 40.0)
    assert farthest < 0.1
    assert after < 0.005
    # it gives way, and stays where it was pushed to
    assert pushed(controller, 4 * YIELDS_AT)[1] > 0.1


def test_a_flag_left_behind_is_forgotten_by_reset_and_used_up_by_a_step(lift):
    env = lift.unwrapped
    action = np.full(7, 0.5, np.float32)
    at = env.stream_spec.slices["action"]
    env.reset(seed=0)
    env.holding = True
    env.reset(seed=0)
    assert env.step(action)[4]["stream"][at][0] == 0.5
    env.holding = True
    assert env.step(action)[4]["stream"][at][0] == 0.0
    assert env.step(action)[4]["stream"][at][0] == 0.5


def test_what_pressed_in_an_episode_before_changes_no_bit_of_a_hold_in_the_next_one():
    env = gym.make("asm_gym/Stack-v0").unwrapped  # Lift loads its model anew

    def held_at_once():
        env.reset(seed=3)
        env.holding = True
        return np.stack([env.step(np.zeros(7, np.float32))[4]["stream"] for _ in range(4)])

    expected = held_at_once()
    env.reset(seed=5)
    env.contact_limits = ContactLimits(wrist_force=0.01, external_torque=0.01)
    assert env.step(np.zeros(7, np.float32))[4]["contact_load"] > 1.0
    np.testing.assert_array_equal(held_at_once(), expected)
    env.close()


@pytest.mark.slow
@pytest.mark.parametrize("many", [SyncVectorEnv, AsyncVectorEnv])
def test_in_many_environments_those_that_are_held_stay_and_the_others_go_on(many):
    def make():
        return INSIDE["rescaled"](made(controller="IK_POSE"))

    class Second(FadingMonitor):
        def observe(self, state, stream):
            state, surprise = super().observe(state, stream)
            value = np.where(np.arange(2) == 1, 10.0, 0.0) * (state.steps > 3)
            return state, surprise._replace(value=value)

    inner = many([make, make])
    env = VectorNeuralASMSafety(
        inner, Second(spec=inner.get_attr("stream_spec")[0]), contact_limits=None
    )
    env.reset(seed=0)
    at = env.monitor.spec.slices["joint_position"]
    streams = np.stack(
        [env.step(np.ones((2, 7), np.float32))[4]["stream"][:, at] for _ in range(25)]
    )
    # since it was held; motors at their limits overshoot first
    moved = np.abs(streams[-1] - streams[3]).max(axis=1)
    assert moved[1] < 0.05
    assert moved[0] > 0.2
    env.close()
