"""Faults change the simulation while they act, nothing before, and nothing after a reset."""

import gymnasium as gym
import numpy as np
import pytest

from asm_gym.faults import FAULTS, FrozenEncoder, Push, WeakJoint, make_fault
from asm_gym.wrappers import FaultInjection
from tests.fakes import FakeEnv

STEPS, ONSET = 14, 5
EVERY = [
    Push(body="robot0_link5", newtons=20, onset=ONSET, duration=4),
    WeakJoint(joint=1, strength=0.5, onset=ONSET, duration=4),
    FrozenEncoder(joint=3, onset=ONSET, duration=4),
]


def record(env, seed=0):
    """(STEPS, D) stream of fixed actions, and which faults were said to act."""
    actions = np.random.default_rng(2).uniform(-0.5, 0.5, (STEPS, 7)).astype(np.float32)
    env.reset(seed=seed)
    infos = [env.step(a)[4] for a in actions]
    return np.array([i["stream"] for i in infos]), [i.get("fault", ()) for i in infos]


@pytest.mark.parametrize("fault", EVERY, ids=lambda f: f.name)
def test_a_fault_acts_on_time_and_only_then(lift, fault):
    healthy, _ = record(lift)
    faulty, active = record(FaultInjection(lift, [fault]))
    assert active == [(fault.name,) if ONSET <= t < ONSET + 4 else () for t in range(STEPS)]
    np.testing.assert_array_equal(faulty[:ONSET], healthy[:ONSET])
    assert not np.array_equal(faulty[ONSET], healthy[ONSET])
    touched = [f for f, label in enumerate(lift.unwrapped.stream_spec.labels) if label in fault.labels(lift.unwrapped)]
    assert np.abs(faulty - healthy)[ONSET : ONSET + 4, touched].max() > 0.01


@pytest.mark.parametrize("seed", [0, None], ids=["seeded reset", "soft reset"])
@pytest.mark.parametrize("fault", EVERY, ids=lambda f: f.name)
def test_a_reset_in_the_middle_of_a_fault_leaves_nothing_of_it(lift, fault, seed):
    def second_episode(env):
        """The episode after one that was cut short while the fault was active."""
        env.reset(seed=1)
        for _ in range(ONSET + 2):
            env.step(np.zeros(7, np.float32))
        env.reset(seed=seed)
        return np.array([env.step(np.full(7, 0.2, np.float32))[4]["stream"] for _ in range(ONSET)])

    # A soft reset goes on with the generators, so both first episodes must be of one length, not of one course.
    np.testing.assert_array_equal(second_episode(FaultInjection(lift, [fault])), second_episode(lift))
    assert lift.unwrapped.corruptions == []
    assert not lift.unwrapped.simulation.data.xfrc_applied.any()
    np.testing.assert_array_equal(lift.unwrapped.simulation.model.actuator_gear[:7, 0], 1.0)


def test_an_active_weak_joint_is_an_edit_of_the_model_that_a_soft_reset_undoes(lift):
    env = FaultInjection(lift, [WeakJoint(joint=2, strength=0.25, onset=0)])
    env.reset(seed=0)
    env.step(np.zeros(7, np.float32))
    gear = lift.unwrapped.simulation.model.actuator_gear
    assert gear[2, 0] == 0.25
    env.reset()
    assert gear[2, 0] == 1.0


def test_a_frozen_encoder_repeats_its_last_reading_in_stream_and_observation_alike(lift):
    env = FaultInjection(lift, [FrozenEncoder(joint=3, onset=ONSET)])
    stream, _ = record(env)
    slices = lift.unwrapped.stream_spec.slices
    position, velocity = slices["joint_position"].start + 3, slices["joint_velocity"].start + 3
    assert (stream[ONSET:, position] == stream[ONSET - 1, position]).all()
    assert (stream[ONSET:, velocity] == 0).all()
    observation = env.step(np.zeros(7, np.float32))[0]
    assert observation[3] == stream[-1, position]
    env.reset()


def test_pushes_add_up_and_a_moving_arm_gives_way(lift):
    def hand(faults):
        stream, _ = record(FaultInjection(lift, faults))
        return stream[:, lift.unwrapped.stream_spec.slices["hand_position"]]

    push = Push(newtons=10, onset=ONSET)
    rest, one, two = hand([]), hand([push]), hand([push, push])
    moved = [np.linalg.norm(h[-1] - rest[-1]) for h in (one, two)]
    assert 0.005 < moved[0] < moved[1]


@pytest.mark.parametrize(
    ("fault", "message"),
    [
        (Push(body="robot0_tail"), "'robot0_tail'.*robot0_link5"),
        (WeakJoint(joint=7), "0 to 6.*7"),
        (FrozenEncoder(joint=-1), "0 to 6.*-1"),
        (Push(onset=100), "horizon of 100"),
    ],
)
def test_a_fault_that_the_robot_cannot_have_is_refused(lift, fault, message):
    with pytest.raises(ValueError, match=message):
        FaultInjection(lift, [fault])


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: make_fault("earthquake"), "'earthquake'.*push, weak_joint, frozen_encoder"),
        (lambda: make_fault("push", force=3), "'force'.*newtons"),
        (lambda: Push(onset=-1), "onset.*-1"),
        (lambda: Push(duration=0), "duration.*0"),
        (lambda: Push(newtons=float("nan")), "newtons.*nan"),
        (lambda: Push(direction=(0, 0, 0)), "direction"),
        (lambda: Push(direction=(float("inf"), 0, 0)), "direction"),
        (lambda: Push(onset=2.5), "onset.*2.5"),
        (lambda: WeakJoint(joint=1.5), "joint.*1.5"),
        (lambda: WeakJoint(strength=1.5), "strength.*1.5"),
    ],
)
def test_a_bad_description_is_refused(make, message):
    with pytest.raises(ValueError, match=message):
        make()


def test_every_fault_has_a_name_to_be_made_by():
    assert {type(f) for f in EVERY} == set(FAULTS.values())
    assert make_fault("push", newtons=5) == Push(newtons=5)


def test_faults_need_one_of_our_environments(lift):
    with pytest.raises(TypeError, match="robosuite environments"):
        FaultInjection(FakeEnv(), [])
    with pytest.raises(TypeError, match="push"):
        FaultInjection(lift, ["push"])


def test_faults_that_could_not_be_undone_one_by_one_are_refused(lift):
    with pytest.raises(ValueError, match="one joint"):
        FaultInjection(lift, [WeakJoint(joint=3, onset=0), WeakJoint(joint=3, onset=5)])
    with pytest.raises(ValueError, match="FaultInjection already"):
        FaultInjection(FaultInjection(lift, []), [Push()])


def test_closing_undoes_a_running_fault():
    env = FaultInjection(gym.make("asm_gym/Lift-v0"), [FrozenEncoder(onset=0)])
    env.reset(seed=0)
    env.step(np.zeros(7, np.float32))
    inner = env.unwrapped
    env.close()
    assert inner.corruptions == []
