"""The hand against its joints: what contradicts is found, named and completed, and nothing else is."""

import gymnasium as gym
import mujoco
import numpy as np
import pytest

from asm_gym.compilation import compiled
from asm_gym.detection.kinematics import Chain
from asm_gym.guard.hand_check import HandChecks
from asm_gym.guard.hand_comparison import compare_hands_of
from asm_gym.monitors import NeuralASM
from asm_gym.wrappers import NeuralASMSafety

FORWARD = np.array([0.0, 0.0, 0.3, 0.0, 0.0, 0.0, -1.0], np.float32)


def test_a_planar_arm_is_where_trigonometry_says():
    up, long = np.array([0.0, 0.0, 1.0]), np.array([0.7, 0.4])
    hand = np.array([[long.sum(), 0, 0], [1, 0, 0], [0, 1, 0]], np.float64)
    chain = Chain("", np.stack([up, up]), np.array([[0, 0, 0], [long[0], 0, 0]], np.float64), hand)
    for a, b in np.random.default_rng(0).uniform(-3, 3, (20, 2)):
        place = long[0] * np.array([np.cos(a), np.sin(a)]) + long[1] * np.array(
            [np.cos(a + b), np.sin(a + b)]
        )
        turned = [np.cos(a + b), np.sin(a + b), 0, -np.sin(a + b), np.cos(a + b), 0]
        np.testing.assert_allclose(chain.at(np.array([a, b])), [*place, 0, *turned], atol=1e-12)


def test_the_chain_of_an_arm_is_the_simulators(lift):
    arm = lift.unwrapped
    robot, model = arm.robosuite_env.robots[0], arm.simulation.model
    data, rng = mujoco.MjData(model), np.random.default_rng(1)
    body = model.body(robot.robot_model.eef_name["right"]).id
    for angles in rng.uniform(-2, 2, (20, 7)):
        data.qpos[robot._ref_joint_pos_indexes] = angles
        mujoco.mj_kinematics(model, data)
        turn = data.xmat[body].reshape(3, 3)
        wanted = [*data.site_xpos[robot.eef_site_id["right"]], *turn[:, 0], *turn[:, 1]]
        np.testing.assert_allclose(arm.hand_chains[0].at(angles), wanted, atol=1e-9)


def rows(arm, count, seed=0):
    """(T, D) of an arm that moves as it likes, with the noise that its sensors have."""
    spec, chain, rng = arm.stream_spec, arm.hand_chains[0], np.random.default_rng(seed)
    where = [
        spec.slices[n]
        for n in ("joint_position", "joint_velocity", "hand_position", "hand_orientation")
    ]
    angles = np.array([0, 0.2, 0, -2.4, 0, 2.9, 0.8]) + rng.normal(0, 0.004, (count, 7)).cumsum(
        axis=0
    )
    speeds = np.gradient(angles, axis=0) / spec.dt
    found = rng.normal(size=(count, spec.size)) * spec.noise
    for row, q, v in zip(found, angles, speeds, strict=True):
        hand = chain.at(q - chain.late_s * v)
        for at, values in zip(where, (q, v, hand[:3], hand[3:]), strict=True):
            row[at] += values
    return found, angles


@compiled
def compare_hand(row, geometry, state):
    """Compare the hands of one robot with its joints."""
    return compare_hands_of(row, geometry, state)


class Check:
    """One arm's hand against its joints."""

    def __init__(self, lift):
        self.all = HandChecks(1, ((lift.unwrapped.hand_chains[0],),), lift.unwrapped.stream_spec)
        self.hands = self.all.arms[0]

    def read(self, row, missing):
        some = compare_hand(row.astype(np.float32), self.all.geometry[0], self.all.state[0])
        self.hands.close_cases()
        assert some == self.hands.contradicts(0)
        return self.hands.contradiction(0, missing) if some else None

    def reset(self):
        self.all.begin(np.ones(1, bool))

    @property
    def vouched(self):
        return self.hands.consistent(0)


def said(check, stream, since=0, missing=None):
    missing = np.zeros(stream.shape[1], bool) if missing is None else missing
    found = [check.read(row, missing) for row in stream]
    assert not any(found[:since])
    return next(((t, c) for t, c in enumerate(found) if c is not None), None)


def test_healthy_senses_contradict_nothing(lift):
    check = Check(lift)
    assert said(check, rows(lift.unwrapped, 3000)[0]) is None


@pytest.mark.parametrize("joint", range(7))
def test_an_encoder_that_is_five_thousandths_off_is_named_and_its_angle_found_by_the_hand(
    lift, joint
):
    spec = lift.unwrapped.stream_spec
    check = Check(lift)
    stream, angles = rows(lift.unwrapped, 60, seed=joint)
    stream[30:, joint] += 0.005
    at, cause = said(check, stream, since=30)
    assert at < 36
    assert cause.part == f"encoder[{joint}]"
    missing = np.zeros(spec.size, bool)
    # said again until somebody completes it
    assert all(check.read(row, missing).part == cause.part for row in stream[40:45])
    missing[cause.columns] = True
    assert check.read(stream[50], missing) is None  # that explains it
    assert check.hands.accused(0)[cause.columns].all()
    guessed = stream[50].copy()
    guessed[joint] += 0.03  # what a memory may be off
    found = check.hands.refine(0, guessed, missing, np.full(spec.size, 0.05))
    assert abs(found[joint] - angles[50, joint]) < 0.002


def test_a_number_of_the_hand_is_named_and_what_no_single_sensor_explains_is_not(lift):
    spec = lift.unwrapped.stream_spec
    check = Check(lift)
    stream, _ = rows(lift.unwrapped, 60)
    stream[30:, spec.slices["hand_position"].start + 1] += 0.01
    assert said(check, stream, since=30)[1].part == "hand_position[1]"
    check.reset()
    stream, _ = rows(lift.unwrapped, 60)
    stream[30:, [0, 3]] += 0.05
    assert said(check, stream, since=30)[1].part == ""


def test_what_hand_and_joints_agree_upon_is_no_sensor_at_fault(lift):
    """A memory that named a healthy encoder completed it, and was blind to what the arm did (IIWA, Door, 2,572 N)."""
    spec = lift.unwrapped.stream_spec
    check = Check(lift)
    none = np.zeros(spec.size, bool)
    stream, _ = rows(lift.unwrapped, 60)
    assert not check.vouched.any()  # nothing was seen yet
    for row in stream[:30]:
        check.read(row, none)
    encoder, hand = [3, 10], np.arange(spec.size)[spec.slices["hand_position"]]
    assert check.vouched[encoder].all()
    assert check.vouched[hand].all()
    assert not check.vouched[spec.slices["measured_torque"]].any()
    stream[30:, 10] += 0.5  # a speed that is not that of the angle
    for row in stream[30:33]:
        check.read(row, none)
    assert not check.vouched[encoder].any()
    assert check.vouched[[2, 9]].all()


class Forged(gym.Wrapper):
    """The encoder of joint 6 drifts with a speed to match."""

    def reset(self, **given):
        self.t = 0
        return self.env.reset(**given)

    def step(self, action):
        *rest, info = self.env.step(action)
        self.t += 1
        stream, spec = info["stream"].copy(), self.unwrapped.stream_spec
        if self.t > 10:
            stream[spec.slices["joint_position"].start + 6] += 0.1 * spec.dt * (self.t - 10)
            stream[spec.slices["joint_velocity"].start + 6] += 0.1
        return *rest, {**info, "stream": stream}


def test_a_drift_that_moves_as_a_joint_could_is_an_alarm_and_the_policy_goes_on(lift):
    """It came to 0.9 rad and more before anybody noticed; the memory may notice sooner, and is left out."""
    env = NeuralASMSafety(Forged(lift), NeuralASM.pretrained("panda").with_threshold(1e9))
    env.reset(seed=0)
    infos = [env.step(FORWARD)[-1]["asm"] for _ in range(30)]
    first = next(t for t, info in enumerate(infos) if info["alarm"])
    assert 10 <= first <= 14  # 0.02 rad
    assert (infos[first]["reason"], infos[first]["event"]) == ("contradiction", "fault")
    assert infos[first]["cause"]["part"] == "encoder[6]"
    assert infos[first]["response"] == "complete"
    assert all(info["completed"] == ("encoder[6]",) for info in infos[first:])
    assert sum(info["alarm"] for info in infos) == 1
    assert infos[-1]["state"] == "policy"
