"""The environment's contract, on the real simulator."""

import os
import subprocess
import sys

import gymnasium as gym
import mujoco
import numpy as np
import pytest

from asm_gym.detection.channel_columns import handled_columns
from asm_gym.envs import robots
from asm_gym.envs.robosuite_backend import import_robosuite
from asm_gym.policies import make_policy
from asm_gym.spec import HANDLED, MOTOR
from asm_gym.tasks import ROBOTS, TASKS


def test_an_environment_runs_where_opencv_cannot_be_imported(tmp_path):
    (tmp_path / "cv2.py").write_text(
        "raise ImportError('libGL.so.1: cannot open shared object file')"
    )
    code = """
import sys, gymnasium, asm_gym
env = gymnasium.make("asm_gym/Lift-v0")
env.reset(seed=0)
assert "cv2" not in sys.modules, "the stand-in must not be left to others"
print(len(env.step(env.action_space.sample())))
"""
    environment = {**os.environ, "PYTHONPATH": str(tmp_path)}
    out = subprocess.run(
        [sys.executable, "-c", code], env=environment, capture_output=True, text=True, check=True
    )
    assert out.stdout.strip() == "5"


def test_unseeded_resets_go_on_from_the_seed(lift):
    def starts():
        lift.reset(seed=11)
        return [lift.reset()[0] for _ in range(3)]

    a, b = starts(), starts()
    np.testing.assert_array_equal(a, b)
    assert not np.array_equal(a[0], a[1])


def test_the_horizon_truncates_and_never_terminates():
    env = gym.make("asm_gym/Lift-v0", horizon=3)
    env.reset(seed=0)
    ends = [env.step(np.zeros(7, np.float32))[2:4] for _ in range(3)]
    assert ends == [(False, False), (False, False), (False, True)]
    with pytest.raises(gym.error.ResetNeeded):
        env.unwrapped.step(np.zeros(7, np.float32))
    env.close()
    env.close()


def test_the_stream_is_named_number_by_number(lift):
    _, info = lift.reset(seed=0)
    spec = lift.unwrapped.stream_spec
    assert info["stream"].shape == (spec.size,) == (len(spec.labels),)
    assert info["stream"].dtype == np.float32
    assert info["success"] is False
    stepped_info = lift.step(np.zeros(7, np.float32))[4]
    assert {name: np.shape(value) for name, value in info.items()} == {
        name: np.shape(value) for name, value in stepped_info.items()
    }
    assert spec.dt == pytest.approx(0.05)
    assert {c.group for c in spec.channels} == {
        "joint",
        "torque",
        "hand",
        "wrench",
        "gripper",
        HANDLED,
        MOTOR,
    }
    action = np.array([0.5, -0.25, 3.0, 0, 0, 0, -1], np.float32)
    np.testing.assert_array_equal(
        lift.step(action)[4]["stream"][spec.motor], np.clip(action, -1, 1)
    )


def test_without_noise_the_stream_reads_the_simulators_own_state():
    env = gym.make("asm_gym/Lift-v0", sensor_noise=0.0)
    env.reset(seed=0)
    stream = env.step(np.array([0.3, 0.1, -0.2, 0, 0, 0.1, 1], np.float32))[4]["stream"]
    slices, data = env.unwrapped.stream_spec.slices, env.unwrapped.robosuite_env.sim.data
    robot = env.unwrapped.robosuite_env.robots[0]
    np.testing.assert_allclose(stream[slices["joint_position"]], data.qpos[:7], rtol=1e-6)
    np.testing.assert_allclose(stream[slices["commanded_torque"]], data.ctrl[:7], rtol=1e-6)
    np.testing.assert_allclose(
        stream[slices["hand_position"]], data.site_xpos[robot.eef_site_id["right"]], rtol=1e-6
    )
    env.close()


def test_noise_has_the_standard_deviation_that_the_spec_names():
    env = gym.make("asm_gym/Lift-v0", horizon=1000)
    exact = gym.make("asm_gym/Lift-v0", horizon=1000, sensor_noise=0.0)
    rest = np.zeros(7, np.float32)
    env.reset(seed=0)
    exact.reset(seed=0)
    errors = np.array(
        [env.step(rest)[4]["stream"] - exact.step(rest)[4]["stream"] for _ in range(150)]
    )
    spec = env.unwrapped.stream_spec
    noise = spec.noise
    is_tracked = np.isin(np.arange(spec.size), handled_columns(spec))  # filtered: see test_handled
    white = (noise > 0) & ~is_tracked
    ratio = errors.std(axis=0)[white] / noise[white]
    # The standard deviation of a standard deviation of 150 draws is 6 %; 75 channels stay within 4 of those.
    np.testing.assert_allclose(ratio, 1.0, atol=0.25)
    assert not errors[:, noise == 0].any()
    env.close()
    exact.close()


def test_sensors_read_in_steps_of_their_resolution_and_never_finer():
    env = gym.make("asm_gym/Lift-v0", horizon=1000)
    env.reset(seed=0)
    rows = np.array([env.unwrapped.measure() for _ in range(400)])  # at rest
    spec = env.unwrapped.measured_spec
    counts = rows[:, spec.resolution > 0] / spec.resolution[spec.resolution > 0]
    np.testing.assert_allclose(counts, np.rint(counts), atol=1e-6)
    # At rest a Gaussian sensor of step q and noise σ repeats itself with probability q / (2 σ √π), for q up to about σ.
    again = (rows[1:] == rows[:-1]).mean(axis=0)
    for name in ("joint_position", "measured_torque", "wrist_force"):
        channel = next(c for c in spec.channels if c.name == name)
        expected = channel.resolution / (2 * np.sqrt(np.pi) * channel.noise)
        assert again[spec.slices[name]].mean() == pytest.approx(expected, rel=0.2)
    env.close()


def test_external_torque_is_the_force_on_a_body_seen_from_the_joints():
    """τ_ext = Jᵀ F for a force F on a link, the closed form that the channel estimates."""
    env = gym.make("asm_gym/Lift-v0", sensor_noise=0.0, horizon=1000)
    env.reset(seed=0)
    for _ in range(20):
        env.step(np.zeros(7, np.float32))
    model, data = env.unwrapped.simulation.model, env.unwrapped.simulation.data
    body, force, jacobian = (
        model.body("robot0_link5").id,
        np.array([3.0, 10.0, -5.0]),
        np.zeros((3, model.nv)),
    )
    data.xfrc_applied[body, :3] = force
    stream = env.step(np.zeros(7, np.float32))[4]["stream"]
    mujoco.mj_jac(model, data, jacobian, None, data.xipos[body], body)
    torque = stream[env.unwrapped.stream_spec.slices["external_torque"]]
    # joint friction is external too, 0.1 N m
    np.testing.assert_allclose(torque, (jacobian.T @ force)[:7], atol=0.15)
    env.close()


def test_a_dict_observation_holds_the_same_numbers_as_the_flat_one(lift):
    env = gym.make("asm_gym/Lift-v0", observation="dict")
    flat, named = lift.reset(seed=5)[0], env.reset(seed=5)[0]
    np.testing.assert_array_equal(np.concatenate(list(named.values())), flat)
    assert env.observation_space.contains(named)
    assert {"joint_position", "hand_position", "cube_pos"} <= set(named)
    env.close()


def test_an_unstable_simulation_ends_the_episode_and_says_so(lift):
    lift.reset(seed=0)
    lift.unwrapped.simulation.data.qvel[0] = 1e9
    observation, reward, terminated, truncated, info = lift.step(np.zeros(7, np.float32))
    assert info["unstable"]
    assert truncated
    assert not terminated
    assert lift.observation_space.contains(observation)
    assert (reward, info["success"]) == (0.0, False)
    assert np.isnan(info["stream"]).all()  # nothing that a monitor could take for a measurement
    assert not lift.reset(seed=0)[1]["unstable"]


@pytest.mark.parametrize(
    "action", [np.zeros(6), np.zeros((1, 7)), np.full(7, np.nan)], ids=["short", "batch", "nan"]
)
def test_a_bad_action_is_refused(lift, action):
    lift.reset(seed=0)
    with pytest.raises(ValueError, match="action"):
        lift.unwrapped.step(action)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"robot": "Pandora"}, "'Pandora'.*Panda, Sawyer"),
        ({"control_freq": 40}, "divide.*500.*40"),
        ({"stream_freq": 30}, "one of 20, 100, 500, got 30"),
        ({"horizon": 0}, "horizon.*0"),
        ({"stream": ("joint", "smell")}, "'smell'.*joint, torque"),
        ({"camera": "backview"}, "'backview'.*frontview"),
        ({"observation": "list"}, "'list'.*flat, dict"),
        ({"sensor_noise": -1.0}, "sensor_noise.*-1"),
        ({"robot": "panda"}, "'panda'.*did you mean 'Panda'"),
        ({"robot": ("Panda", "Panda")}, "Lift takes 1 robot, got Panda, Panda"),
        ({"controller": {"type": "OSC_POSE"}}, "controller"),
        ({"controller": "JOINT_VELOCITY"}, "'JOINT_VELOCITY'.*OSC_POSE"),
        ({"render_mode": "ansi"}, "'ansi'.*rgb_array"),
    ],
)
def test_a_bad_argument_is_refused_with_what_exists(arguments, message):
    with pytest.raises(ValueError, match=message):
        gym.make("asm_gym/Lift-v0", **arguments)


def test_success_ends_the_episode_where_asked():
    env = gym.make("asm_gym/Lift-v0", terminate_on_success=True, reward_shaping=False)
    expert, state = make_policy("scripted", env, seed=0), None
    observation, _ = env.reset(seed=0)
    terminated = False
    while not terminated:
        action, state = expert.predict(observation, state)
        observation, reward, terminated, truncated, info = env.step(action)
        assert not truncated
        assert reward == info["success"] == terminated
    env.close()


@pytest.mark.parametrize("mode", ["sync", "async", None])
def test_vectors_of_environments_agree_with_single_ones(lift, mode):
    vector = gym.make_vec("asm_gym/Lift-v0", num_envs=2, vectorization_mode=mode)
    observations, info = vector.reset(seed=[3, 4])
    np.testing.assert_array_equal(observations[1], lift.reset(seed=4)[0])
    action = np.full((2, 7), 0.2, np.float32)
    observations, rewards, *_, info = vector.step(action)
    observation, reward, *_, single = lift.step(action[1])
    np.testing.assert_array_equal(observations[1], observation)
    assert rewards[1] == reward
    np.testing.assert_array_equal(info["stream"][1], single["stream"])
    vector.close()


@pytest.mark.slow
def test_every_robot_that_tasks_list_has_a_file():
    assert tuple(robots.ROBOTS) == ROBOTS
    assert [name for name in ROBOTS if robots.robot_named(name).has_inverse_kinematics] == [
        "Panda",
        "Sawyer",
    ]
    with pytest.raises(ValueError, match="Panda"):
        robots.robot_named("Baxter")


@pytest.mark.parametrize("robot", ROBOTS)
@pytest.mark.parametrize("name", TASKS)
def test_every_robot_does_every_task(name, robot):
    env = gym.make(TASKS[name].id, robot=robot)
    env.reset(seed=0)
    env.action_space.seed(0)
    for _ in range(5):
        observation, *_, info = env.step(env.action_space.sample())
    assert env.observation_space.contains(observation)
    assert not info["unstable"]
    assert env.unwrapped.simulation.compiled
    env.close()


def test_overlapping_finger_links_touch_at_one_point_whatever_the_version_of_mujoco():
    env = gym.make("asm_gym/Lift-v0", robot="IIWA")
    env.reset(seed=0)
    simulation = env.unwrapped.simulation
    mesh = int(mujoco.mjtGeom.mjGEOM_MESH)
    types = simulation.model.geom_type
    touching = simulation.data.contact.geom
    pairs = [tuple(geoms) for geoms in touching if (types[geoms] == mesh).all()]
    env.close()
    assert len(pairs) > 2
    assert len(pairs) == len(set(pairs))


def test_joints_of_every_type_have_their_addresses_under_every_version_of_mujoco():
    import_robosuite()
    from robosuite.utils.binding_utils import MjSim

    kinds = ("free", "hinge", "ball", "slide")
    bodies = "".join(
        f'<body><joint name="{kind}" type="{kind}"/><geom size="0.1"/></body>' for kind in kinds
    )
    model = MjSim.from_xml_string(f"<mujoco><worldbody>{bodies}</worldbody></mujoco>").model
    positions = [model.get_joint_qpos_addr(kind) for kind in kinds]
    velocities = [model.get_joint_qvel_addr(kind) for kind in kinds]
    assert positions == [(0, 7), 7, (8, 12), 12]
    assert velocities == [(0, 6), 6, (7, 10), 10]
