"""Control steps of the compiled loop against robosuite's own."""

import itertools

import gymnasium as gym
import mujoco
import numpy as np
import pytest

import asm_gym  # noqa: F401
from asm_gym.envs import robosuite_backend
from asm_gym.tasks import task


def pair(name, controller="OSC_POSE"):
    """Our environment and robosuite's own, at the start of the same episode."""
    ours = gym.make(
        f"asm_gym/{name}-v0", controller=controller, sensor_noise=0.0, horizon=10_000
    ).unwrapped
    theirs = robosuite_backend.make(task(name), ours.robots, controller, 20, reward_shaping=True)
    ours.reset(seed=4)
    for env in (theirs, ours.robosuite_env):
        env.rng.bit_generator.state = np.random.default_rng(9).bit_generator.state
        env.hard_reset = True
        env.reset()
    ours._bind()
    return ours, theirs


def gentle(size, steps, seed=0):
    """Smooth movements about where the arm starts, the gripper opening and closing."""
    t = np.arange(steps)[:, None] / 20.0
    rng = np.random.default_rng(seed)
    return 0.25 * np.sin(
        2 * np.pi * rng.uniform(0.1, 0.5, size) * t + rng.uniform(0, 2 * np.pi, size)
    )


def hands(env):
    return np.array([env.sim.data.site_xpos[r.eef_site_id[a]] for r in env.robots for a in r.arms])


@pytest.mark.parametrize(
    "name", ["Lift", "Stack", "Door", "NutAssemblySquare", "Wipe", "TwoArmLift"]
)
def test_the_hand_moves_as_under_robosuites_own_step(name):
    ours, theirs = pair(name)
    assert ours.simulation.compiled
    start = hands(theirs)
    apart = moved = 0.0
    for action in gentle(theirs.action_dim, 200).astype(np.float32):
        _, reward, *_ = ours.step(action)
        expected = theirs.step(action.astype(np.float64))[1]
        apart = max(apart, np.abs(hands(theirs) - hands(ours.robosuite_env)).max())
        moved = max(moved, np.abs(hands(theirs) - start).max())
        assert reward == pytest.approx(expected, abs=1e-6)
    assert apart < 1e-6
    assert moved > 0.05
    ours.close()


@pytest.mark.parametrize(
    ("controller", "compiled"),
    [
        ("JOINT_POSITION", True),
        ("OSC_POSITION", False),
        ("JOINT_TORQUE", False),
        ("IK_POSE", False),
    ],
)
def test_other_controllers_move_as_under_robosuites_own_step(controller, compiled):
    ours, theirs = pair("Lift", controller)
    assert ours.simulation.compiled is compiled
    for action in gentle(theirs.action_dim, 50).astype(np.float32):
        ours.step(action)
        theirs.step(ours._delivered(action))
    np.testing.assert_allclose(hands(theirs), hands(ours.robosuite_env), atol=1e-6)
    ours.close()


def test_wipes_reward_follows_the_force_that_robosuite_remembers():
    """Its reward reads buffers that robosuite fills within a step, pressing on the table included."""
    ours, theirs = pair("Wipe")
    down = np.array([0.1, 0.0, -0.3, 0, 0, 0], np.float32)
    rewards = [(ours.step(down)[1], theirs.step(down.astype(np.float64))[1]) for _ in range(60)]
    np.testing.assert_allclose(*zip(*rewards, strict=True), atol=1e-6)
    ours.close()


@pytest.mark.parametrize("name", ["PickPlace", "TwoArmHandover"])
def test_contacts_and_grasps_are_robosuites_own(name):
    from robosuite.utils.sim_utils import check_contact as robosuite_contact

    env = gym.make(f"asm_gym/{name}-v0").unwrapped
    env.reset(seed=0)
    theirs, model = env.robosuite_env, env.simulation.model
    rng, names = np.random.default_rng(0), [n for n in theirs.sim.model.geom_names if n]
    robot = theirs.robots[0]
    groups = [
        robot.robot_model,
        robot.gripper["right"],
        *theirs.model.mujoco_objects[:3],
        names[0],
        names[:20],
    ]
    touched = 0
    for _ in range(20):
        env.step(env.action_space.sample())
        for contact in env.simulation.data.contact:  # at random, so that groups do touch
            contact.geom[:] = contact.geom1, contact.geom2 = rng.integers(model.ngeom, size=2)
        for one, other in itertools.product(groups, [*groups, None]):
            expected = robosuite_contact(theirs.sim, one, other)
            assert theirs.check_contact(one, other) == expected
            touched += expected
        grippers, thing = robot.gripper, theirs.model.mujoco_objects[0]
        assert theirs._check_grasp(grippers, thing) == type(theirs)._check_grasp(
            theirs, grippers, thing
        )
    assert touched
    env.close()


def test_a_substep_hook_runs_after_every_substep_reads_sensors_and_changes_nothing_by_itself(lift):
    env = lift.unwrapped
    forth = np.array([1, 0, 0, 0, 0, 0, 0], np.float32)

    def travel(*hooks):
        env.reset(seed=0)
        env.substep_hooks.extend(hooks)
        try:
            env.step(forth)
        finally:
            env.substep_hooks.clear()
        return hands(env.robosuite_env)

    called, rows = [], []
    np.testing.assert_array_equal(travel(), travel(called.append))
    travel(lambda k: rows.append(env.measure()))
    assert called == list(range(25))
    x = np.array(rows)[:, env.measured_spec.slices["hand_position"]][:, 0]
    assert x[-1] - x[0] > 5e-4


def test_a_substep_hook_can_take_over_at_once(lift):
    env = lift.unwrapped
    rest, forth = np.zeros(7, np.float32), np.array([1, 0, 0, 0, 0, 0, 0], np.float32)

    def travel(hook):
        env.reset(seed=0)
        before = hands(env.robosuite_env)[0, 0]
        env.substep_hooks.extend(hook)
        try:
            stream = env.step(forth)[4]["stream"]
        finally:
            env.substep_hooks.clear()
        for _ in range(4):
            env.step(rest)
        return hands(env.robosuite_env)[0, 0] - before, stream[env.stream_spec.motor]

    free, _ = travel([])
    stopped, commanded = travel([lambda k: env.command(rest) if k == 4 else None])
    assert stopped < 0.5 * free
    np.testing.assert_array_equal(commanded, rest)  # the efference copy is what was commanded last


def test_nobody_tells_the_robot_of_a_payload():
    """τ_ext = Jᵀ m (g - a): observer and controller go on with the masses they were built with."""
    env = gym.make("asm_gym/Lift-v0", sensor_noise=0.0, horizon=1000).unwrapped
    env.reset(seed=0)
    rest, data, model = np.zeros(7, np.float32), env.simulation.data, env.simulation.model
    hand = model.body("robot0_right_hand").id
    felt, jacobian, velocities = (
        env.stream_spec.slices["external_torque"],
        np.zeros((3, model.nv)),
        [np.zeros(3)],
    )
    before = [env.step(rest)[4]["stream"][felt] for _ in range(21)][-1]
    height = hands(env.robosuite_env)[0, 2]

    def momentum(k):
        mujoco.mj_jac(model, data, jacobian, None, data.xipos[hand], hand)
        velocities.append(jacobian @ data.qvel)

    model.body_mass[hand] += 1.0
    env.substep_hooks.append(momentum)
    after = [env.step(rest)[4]["stream"][felt] for _ in range(3)][-1]
    fall = (velocities[-1] - velocities[-26]) / 0.05
    expected = (jacobian.T @ ([0, 0, -9.81] - fall))[:7]
    np.testing.assert_allclose(after - before, expected, atol=0.15)
    assert np.abs(expected).max() > 1.0
    for _ in range(10):
        env.step(rest)
    assert height - hands(env.robosuite_env)[0, 2] > 0.01  # not compensated: the arm sags
    model.body_mass[hand] -= 1.0
    assert env.simulation.nominal.now() is env.simulation.nominal.unedited
    env.close()


@pytest.mark.parametrize("controller", ["OSC_POSITION", "JOINT_TORQUE"])
def test_a_payload_is_felt_under_the_controllers_of_robosuite_too(controller):
    """The weight of 1 kg at the hand, by the nominal model at the live position, and not by a stale one."""
    env = gym.make("asm_gym/Lift-v0", controller=controller, sensor_noise=0.0).unwrapped
    env.reset(seed=0)
    felt = env.stream_spec.slices["external_torque"]
    rest = np.zeros(env.action_space.shape, np.float32)
    before = [env.step(rest)[4]["stream"][felt] for _ in range(5)][-1]
    model, data = env.simulation.model, env.simulation.data
    hand = model.body("robot0_right_hand").id
    model.body_mass[hand] += 1.0
    after = env.step(rest)[4]["stream"][felt]
    jacobian = np.zeros((3, model.nv))
    mujoco.mj_jac(model, data, jacobian, None, data.xipos[hand], hand)
    weight = (jacobian.T @ [0, 0, -9.81])[:7]
    assert np.abs(after - before).max() < 1.5 * np.abs(weight).max()
    if controller == "OSC_POSITION":  # the arm is held against the weight
        assert np.dot(after - before, weight) > 0.3 * np.dot(weight, weight)
    env.close()


def test_two_arms_give_two_sets_of_channels_and_move_alone():
    env = gym.make("asm_gym/TwoArmLift-v0", robot=("Panda", "UR5e"), sensor_noise=0.0)
    env.reset(seed=0)
    spec = env.unwrapped.stream_spec
    sizes = {c.name: c.size for c in spec.channels}
    assert (sizes["robot0_joint_position"], sizes["robot1_joint_position"]) == (7, 6)
    rest, second = np.zeros(14, np.float32), 0.5 * np.eye(14, dtype=np.float32)[7 + 2]  # upwards
    before = env.step(rest)[4]["stream"]
    stream = [env.step(second)[4]["stream"] for _ in range(8)][-1]
    moved = {
        n: np.abs(stream - before)[spec.slices[f"{n}_hand_position"]].max()
        for n in ("robot0", "robot1")
    }
    assert moved["robot1"] > 0.03 > 5 * moved["robot0"]
    env.close()


def noiseless(stream_freq):
    env = gym.make("asm_gym/Lift-v0", sensor_noise=0.0, stream_freq=stream_freq).unwrapped
    observations, infos = [env.reset(seed=0)[0]], []
    for t in range(40):  # down onto the table, for there to be a force
        action = np.array([0.2 * np.sin(t), 0.1, -1, 0, 0, 0.3, 1], np.float32)
        observation, *_, info = env.step(action)
        observations.append(observation)
        infos.append(info)
    spec = env.stream_spec
    env.close()
    return np.array(observations), infos, spec


def test_a_faster_stream_is_the_same_world_looked_at_more_often():
    slow_seen, slow, slow_spec = noiseless(None)
    fast_seen, fast, spec = noiseless(100)
    assert (slow_spec.dt, spec.dt) == (0.05, 0.01)
    np.testing.assert_allclose(slow_seen, fast_seen, atol=1e-6)
    assert max(i["contact_force"] for i in slow) > 5
    for a, b in zip(slow, fast, strict=True):
        assert "streams" not in a
        rows = b["streams"]
        assert rows.shape == (5, spec.size)
        np.testing.assert_array_equal(rows[-1], b["stream"])
        for name in ("external_torque", "wrist_force"):  # a step's mean is that of its rows
            of = spec.slices[name]
            np.testing.assert_allclose(
                rows[:, of].mean(axis=0), a["stream"][of], rtol=1e-4, atol=1e-3
            )
        of = spec.slices["wrist_force_peak"]
        np.testing.assert_allclose(
            np.abs(rows[:, of]).max(axis=0), np.abs(a["stream"][of]), rtol=1e-4, atol=1e-3
        )
        assert a["contact_force"] == pytest.approx(b["contact_force"], rel=1e-6, abs=1e-9)


def test_a_row_hook_can_take_over_within_the_step():
    env = gym.make("asm_gym/Lift-v0", stream_freq=100).unwrapped
    env.reset(seed=0)
    rest = np.zeros(7, np.float32)
    felt = []

    def stop(row):
        felt.append(row)
        if len(felt) == 2:
            env.command(rest)

    env.row_hooks.append(stop)
    rows = env.step(np.array([1, 0, 0, 0, 0, 0, 1], np.float32))[4]["streams"]
    env.close()
    np.testing.assert_array_equal(rows[:4], felt)  # the last row of a step is the step's own
    commanded = rows[:, env.stream_spec.slices["action"]]
    np.testing.assert_array_equal(commanded[:, 0], [1, 1, 0, 0, 0])
