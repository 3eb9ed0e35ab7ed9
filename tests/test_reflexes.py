"""Reflexes by name: what each does, and which robots cannot do it."""

import gymnasium as gym
import numpy as np
import pytest

from asm_gym.guard.motion import Motions
from tests.arms import reflexes_of
from tests.fakes import FakeEnv


def moved(reflexes, name, row=None, executed=(), count=1):
    """What a reflex does after the policy has executed some, and the row was felt."""
    robots = reflexes.robots
    motions = Motions(robots, reflexes, (), lambda robot: None, lambda *_: None)
    everyone, row = np.ones(1, bool), np.zeros(reflexes.torques.max() + 1) if row is None else row
    for action in executed:
        motions.feel(row[None].astype(np.float32), np.array(action, np.float32)[None], ~everyone, everyone)
    return [reflexes.move(0, name).action for _ in range(count)]


def test_retract_undoes_the_newest_first_then_stays(lift):
    done = [np.full(7, x, np.float32) for x in (0.1, 0.2, 0.3)]
    found = moved(reflexes_of(lift, "retract"), "retract", executed=done, count=4)
    np.testing.assert_allclose([a[0] for a in found], [-0.3, -0.2, -0.1, 0.0], rtol=1e-6)


@pytest.mark.parametrize("controller", ["OSC_POSE", "JOINT_POSITION"])
def test_comply_moves_the_joints_the_way_they_are_pressed(controller):
    env = gym.make("asm_gym/Lift-v0", controller=controller).unwrapped
    env.reset(seed=0)
    row = np.zeros(env.stream_spec.size)
    row[env.stream_spec.slices["external_torque"].start + 3] = 60.0
    still = np.zeros(env.action_space.shape, np.float32)
    before = env.measured[env.measured_spec.slices["joint_position"]].copy()
    (action,) = moved(reflexes_of(env, "comply"), "comply", row, [still])
    for _ in range(5):
        env.step(action)
    after = env.measured[env.measured_spec.slices["joint_position"]]
    assert after[3] - before[3] > 0.01
    env.close()


def test_what_is_always_carried_is_not_yielded_to(lift):
    spec = lift.get_wrapper_attr("stream_spec")
    row = np.zeros(spec.size)
    row[spec.slices["external_torque"]] = 5.0
    (action,) = moved(reflexes_of(lift, "comply"), "comply", row, [np.zeros(7)] * 100)
    assert not action.any()


def test_reflexes_that_need_changes_refuse_other_actions():
    for name in ("retract", "comply"):
        with pytest.raises(ValueError, match=r"OSC_POSE or JOINT_POSITION.*safe_action"):
            reflexes_of(FakeEnv(), name)
    env = gym.make("asm_gym/Lift-v0", stream=("joint", "hand"))
    with pytest.raises(ValueError, match="external_torque"):
        reflexes_of(env, "comply")
    env.close()
