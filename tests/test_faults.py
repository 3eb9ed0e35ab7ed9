"""Faults change the simulation while they act, nothing before, and nothing after a reset."""

from contextlib import ExitStack

import gymnasium as gym
import numpy as np
import pytest

from asm_gym import faults, register_fault
from asm_gym.envs.undoable_edits import SimulatorEdits
from asm_gym.faults import Bias, FrozenEncoder, Push, WeakJoint
from asm_gym.faults.suite import (
    GROUPS,
    KINDS,
    kinds_of,
    possible,
    suite_fault,
)
from asm_gym.policies import make_policy
from asm_gym.wrappers import FaultInjection
from tests.fakes import FakeEnv

ONSET, STEPS = 60, 78
"""In the middle of carrying the cube, and until well after."""
INVISIBLE = {"smoother_object"}
"""Of two surfaces the rougher counts, so a smoother cube changes nothing."""


@pytest.fixture(scope="module")
def stack():
    """Stack, whose resets are fast, with all that can be measured in the stream."""
    groups = ("joint", "torque", "hand", "wrench", "gripper", "action", "contact", "object")
    env = gym.make("asm_gym/Stack-v0", stream=groups)
    yield env
    env.close()


@pytest.fixture(scope="module")
def course(stack):
    """The actions of an expert, played back whatever happens, and the healthy episode they make."""
    expert, state, actions = make_policy("scripted", stack, seed=3), None, []
    observation, _ = stack.reset(seed=3)
    for _ in range(STEPS):
        action, state = expert.predict(observation, state)
        actions.append(action)
        observation = stack.step(action)[0]
    return actions, play(stack, actions)[0]


def play(env, actions, seed=3):
    """(T, D) stream of given actions, and what was said to be active."""
    env.reset(seed=seed)
    infos = [env.step(action)[4] for action in actions]
    return np.array([i["stream"] for i in infos]), [i.get("fault", ()) for i in infos]


def every(env):
    """Each kind at its strongest."""
    return {k: suite_fault(k, env.unwrapped, "strong", ONSET, seed=4) for k in KINDS}


@pytest.mark.parametrize("kind", list(KINDS))
def test_a_fault_acts_on_time_and_only_then(stack, course, kind):
    actions, healthy = course
    fault = every(stack)[kind]
    stream, active = play(FaultInjection(stack, [fault]), actions)
    onset = fault.onset
    np.testing.assert_array_equal(stream[:onset], healthy[:onset])
    assert active == [(fault.name,) if fault.active(t) else () for t in range(STEPS)]
    changed = not np.array_equal(stream[onset:], healthy[onset:])
    assert changed is (kind not in INVISIBLE)
    labels = fault.labels(stack.unwrapped)
    where = [i for i, label in enumerate(stack.unwrapped.stream_spec.labels) if label in labels]
    assert np.abs(stream - healthy)[onset:, where].max() > 0
    # Nothing is left of it: the same episode once more, with a soft reset between.
    again, _ = play(stack, actions)
    np.testing.assert_array_equal(again, healthy)
    inner = stack.unwrapped
    assert (len(inner.edits), inner.corruptions, inner.deliveries, inner.substep_hooks) == (
        0,
        [],
        [],
        [],
    )


@pytest.mark.parametrize("fault", [Push(onset=4), WeakJoint(onset=4), faults.Payload(onset=4)])
def test_after_a_hard_reset_the_environment_is_as_new(lift, fault):
    def second_episode(env):
        """The episode after one that was cut short while the fault was active, up to its next onset."""
        env.reset(seed=1)
        for _ in range(8):
            env.step(np.zeros(7, np.float32))
        env.reset(seed=2)
        return np.array([env.step(np.full(7, 0.2, np.float32))[4]["stream"] for _ in range(4)])

    fresh = gym.make("asm_gym/Lift-v0")
    np.testing.assert_array_equal(
        second_episode(FaultInjection(lift, [fault])), second_episode(fresh)
    )
    fresh.close()


def test_every_kind_of_the_suite_is_in_one_group_and_another_kind_moves_none():
    development, test = GROUPS["development"], GROUPS["test"]
    assert sorted((*development, *test)) == sorted(KINDS)
    try:
        register_fault("mine", lambda drawn, severity: Push(onset=drawn.onset))
        assert kinds_of(["development", "test"]) == (*development, *test)
        assert kinds_of(["test", "mine", "push"]) == (*test, "mine", "push")
    finally:
        del KINDS["mine"]
    with pytest.raises(ValueError, match=r"'flood'.*push"):
        kinds_of(["flood"])


def test_edits_of_one_number_compose_and_end_in_any_order():
    ledger, array = SimulatorEdits(), np.array([0.3, 5.0])
    nominal, first, second = array.copy(), ExitStack(), ExitStack()
    double, add = (
        first.enter_context(ledger.edit(array, 0)),
        second.enter_context(ledger.edit(array, 0)),
    )
    double(lambda v: 2 * v)
    add(lambda v: v + 0.1)
    assert array[0] == 2 * 0.3 + 0.1
    first.close()
    assert array[0] == 0.3 + 0.1
    add(lambda v: v + 0.7)
    assert array[0] == 0.3 + 0.7
    second.close()
    np.testing.assert_array_equal(array, nominal)
    assert len(ledger) == 0


def test_two_weaknesses_of_one_joint_multiply_across_wrappers(lift):
    env = FaultInjection(lift, [WeakJoint(joint=3, strength=0.5, onset=0, duration=3)])
    env = FaultInjection(env, [WeakJoint(joint=3, strength=0.5, onset=1), Push(onset=1)])
    env.reset(seed=0)
    gear, seen = lift.unwrapped.simulation.model.actuator_gear, []
    for _ in range(4):
        info = env.step(np.zeros(7, np.float32))[4]
        seen.append(gear[3, 0])
    assert seen == [0.5, 0.25, 0.25, 0.5]
    assert info["fault"] == ("WeakJoint", "Push")
    env.reset(seed=0)
    assert gear[3, 0] == 1.0


def test_the_stream_carries_the_action_as_commanded(lift):
    env = FaultInjection(lift, [faults.SignFlip(axis=0, onset=0)])
    env.reset(seed=0)
    forth, spec = np.array([1, 0, 0, 0, 0, 0, 0], np.float32), lift.unwrapped.stream_spec
    streams = np.array([env.step(forth)[4]["stream"] for _ in range(6)])
    np.testing.assert_array_equal(streams[:, spec.motor], np.tile(forth, (6, 1)))
    x = streams[:, spec.slices["hand_position"]][:, 0]
    assert x[-1] < x[0] - 0.005
    env.reset()


def test_faults_of_the_other_arm_are_numbered_on():
    env = gym.make("asm_gym/TwoArmLift-v0", sensor_noise=0.0)
    for fault, label in (
        (FrozenEncoder(joint=9, onset=0), "robot1_joint_position[2]"),
        (WeakJoint(joint=7, onset=0), "robot1_measured_torque[0]"),
    ):
        assert label in fault.labels(env.unwrapped)
        FaultInjection(env, [fault])
    for kind in KINDS:
        if possible(kind, env.unwrapped):
            FaultInjection(env, [suite_fault(kind, env.unwrapped, "medium", 3, 0)])
    with pytest.raises(ValueError, match=r"0, 13.*14"):
        FaultInjection(env, [WeakJoint(joint=14)])
    env.close()


@pytest.mark.parametrize("task", ["Wipe", "Door", "NutAssembly"])
def test_a_task_has_the_faults_that_it_can_have(task):
    env = gym.make(f"asm_gym/{task}-v0")
    env.reset(seed=0)
    can = {kind for kind in KINDS if possible(kind, env.unwrapped)}
    loose = {"slip", "snatch", "teleport", "heavy_object", "missing_object"}
    expected = {"Wipe": loose | {"gripper_opens", "weak_gripper"}, "Door": loose}.get(task, set())
    assert set(KINDS) == can | expected
    assert not can & expected
    env.close()


@pytest.mark.parametrize(
    ("fault", "message"),
    [
        (Push(body="robot0_tail"), "'robot0_tail'.*robot0_link5"),
        (WeakJoint(joint=7), "0, 6.*7"),
        (FrozenEncoder(joint=-1), "0, 6.*-1"),
        (Push(onset=100), "horizon of 100"),
        (Bias(channel="smell"), "'smell'.*joint_position"),
        (Bias(element=9), "0, 6.*got 9"),
        (faults.ActionBias(axis=6), "0, 5.*got 6"),
        (faults.Slip(object="anvil"), "'anvil'.*cube"),
    ],
)
def test_a_fault_that_the_robot_cannot_have_is_refused(lift, fault, message):
    with pytest.raises(ValueError, match=message):
        FaultInjection(lift, [fault])


@pytest.mark.parametrize(
    ("kind", "bad"),
    [
        *(
            (Push, bad)
            for bad in ({"onset": -1}, {"onset": 2.5}, {"duration": 0}, {"newtons": float("nan")})
        ),
        *(
            (Push, bad)
            for bad in (
                {"newtons": "a"},
                {"direction": (0, 0, 0)},
                {"direction": (float("inf"), 0, 0)},
            )
        ),
        *((WeakJoint, bad) for bad in ({"joint": 1.5}, {"strength": 1.5})),
        *[
            (faults.Payload, {"kilograms": 0}),
            (faults.Spikes, {"probability": 2}),
            (faults.Delay, {"steps": 0}),
        ],
    ],
)
def test_a_bad_description_is_refused(kind, bad):
    with pytest.raises(ValueError, match=next(iter(bad))):
        kind(**bad)


def test_faults_need_one_of_our_environments(lift):
    with pytest.raises(ValueError, match="robosuite environment"):
        FaultInjection(FakeEnv(), [Push()])
    with pytest.raises(TypeError, match="push"):
        FaultInjection(lift, ["push"])
    with pytest.raises(TypeError, match="Sequence"):
        FaultInjection(lift, Push())
