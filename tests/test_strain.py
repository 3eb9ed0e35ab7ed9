"""What strains an arm: contact force over time, joints at their stops, and a robot that touches itself."""

import gymnasium as gym
import mujoco
import numpy as np
import pytest

import asm_gym  # noqa: F401
from asm_gym.envs.arms import AT_STOP, bodies
from asm_gym.envs.strain import GRIPPER, LINK, self_contacts
from asm_gym.policies import make_policy, rollout

DOWN = np.array([0, 0, -1, 0, 0, 0, 1], np.float32)


def test_only_what_is_of_the_arm_and_no_gripper_counts_as_self_contact():
    kinds = np.array([0, GRIPPER, GRIPPER, LINK, LINK])
    pairs = np.array([(0, 3), (1, 2), (1, 3), (3, 4), (0, 1)], np.int32)
    assert self_contacts(pairs, kinds) == 2


@pytest.mark.parametrize("stream_freq", [None, 100])
def test_the_impulse_is_the_force_beyond_forty_newtons_in_every_substep(stream_freq):
    env = gym.make("asm_gym/Lift-v0", stream_freq=stream_freq)
    arm = env.unwrapped
    forces = []
    _, info = env.reset(seed=0)
    assert info["contact_impulse"] == 0.0
    arm.substep_hooks.append(lambda _: forces.append(arm.simulation.contact_forces[-1]))
    reported = sum(env.step(DOWN)[-1]["contact_impulse"] for _ in range(25))
    expected = np.maximum(np.array(forces) - 40.0, 0.0).sum() / 500
    assert expected > 1.0  # it rams the table
    assert reported == pytest.approx(expected)
    env.close()


def net_force_on(own, model, data):
    """Return the norm of the sum of all contact forces of bodies with others."""
    total = np.zeros(3)
    wrench = np.zeros(6)
    for number, contact in enumerate(data.contact):
        first, second = model.geom_bodyid[[contact.geom1, contact.geom2]]
        if (first in own) != (second in own):
            mujoco.mj_contactForce(model, data, number, wrench)
            force = wrench[:3] @ contact.frame.reshape(3, 3)
            total += force if second in own else -force
    return np.linalg.norm(total)


def test_what_the_gripper_and_a_cube_in_it_meet_counts_in_every_substep():
    env = gym.make("asm_gym/Lift-v0", horizon=300, terminate_on_success=False)
    arm = env.unwrapped
    policy = make_policy("scripted", env, seed=0)
    observation, info = env.reset(seed=0)
    state = None
    while not info["success"]:
        action, state = policy.predict(observation, state, np.array([state is None]))
        observation, *_, info = env.step(action)

    simulation = arm.simulation
    model = simulation.model
    data = simulation.data
    own = set(bodies(model, arm.robosuite_env.robots[0]).tolist())
    cube = model.body("cube_main").id
    table = model.body("table").id
    reported = []
    expected = []
    meets_table = []

    def compare(_):
        reported.append(simulation.contact_forces[-1])
        expected.append(net_force_on(own, model, data))
        pairs = model.geom_bodyid[data.contact.geom]
        meets_table.append(((pairs == cube).any(axis=1) & (pairs == table).any(axis=1)).any())

    arm.substep_hooks.append(compare)
    for _ in range(25):
        env.step(DOWN)
    env.close()
    np.testing.assert_allclose(reported, expected, atol=1e-6)
    assert max(np.array(reported)[meets_table]) > 100.0


def test_a_joint_at_its_stop_counts():
    env = gym.make("asm_gym/Lift-v0")
    env.reset(seed=0)
    simulation = env.unwrapped.simulation
    assert simulation.strain.read() == (0, 0)
    joint = env.unwrapped.robosuite_env.robots[0]._ref_joint_indexes[1]
    simulation.data.qpos[simulation.model.jnt_qposadr[joint]] = (
        simulation.model.jnt_range[joint, 1] - 0.5 * AT_STOP
    )
    assert simulation.strain.read().joint_stops == 1
    env.close()


@pytest.mark.slow
@pytest.mark.parametrize("robot", ["Panda", "Sawyer", "IIWA", "UR5e", "Kinova3", "Jaco"])
def test_a_robot_that_lifts_as_the_expert_does_not_touch_itself(robot):
    env = gym.make("asm_gym/Lift-v0", robot=robot)
    seen = []
    rollout(env, make_policy("scripted", env, seed=0), 0, seen.append)
    assert sum(info["self_contacts"] for info in seen) == 0
    env.close()
