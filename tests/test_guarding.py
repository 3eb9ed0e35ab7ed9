"""What a guard promises at its edges: to copy, to be bound to its robot, and to see its monitor change."""

from dataclasses import replace

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env, data_equivalence
from gymnasium.vector import SyncVectorEnv

from asm_gym.detection.contact_limits import ContactLimits
from asm_gym.guard.options import ON_ALARM
from asm_gym.monitors import NeuralASM
from asm_gym.policies.hold import Hold
from asm_gym.wrappers import NeuralASMSafety, VectorNeuralASMSafety
from tests.arms import ACT as ARM_ACT
from tests.arms import Acting, Judge, infos
from tests.fakes import CueMonitor, FadingMonitor, FakeEnv

ACT = np.array([0.5, -0.5, 1.0], np.float32)


# ---------------------------------------------------------------- missing numbers


def blinks(every, since=20):
    """One number is lost every so many rows, another each time."""

    def broken(t, row):
        if t >= since and t % every == 0:
            row[(t // every) % 5] = np.nan

    return broken


class Finite(Judge):
    """Surprised in the steps of ``cue``, and at what is not finite."""

    def observe(self, state, stream):
        state, surprise = super().observe(state, stream)
        return state, surprise._replace(
            value=np.where(np.isfinite(stream).all(axis=1), surprise.value, np.inf)
        )


def test_a_number_that_is_missing_is_an_alarm_that_says_so_and_the_policy_goes_on():
    said = infos(NeuralASMSafety(Acting(blinks(1000, 0)), Finite(()), "graded"), 5)
    assert not any(s["alarm"] for s in said)
    said = infos(NeuralASMSafety(Acting(blinks(30)), Finite(())), 40)
    missing = [t for t, s in enumerate(said) if s["alarm"]]
    assert missing == [29]
    assert said[29]["reason"] == "missing"
    assert said[29]["lost"] == ("observation[1]",)
    assert said[29]["surprise"] < said[29]["threshold"]
    assert said[29]["transition"] == "complete"
    assert not any(s["intervened"] for s in said)
    assert said[31]["completed"] == ()  # it says what is expected again, and is believed at once


class Everywhere(Finite):
    """Surprised at all senses alike."""

    def observe(self, state, stream):
        state, surprise = super().observe(state, stream)
        shares = np.where(np.arange(self.spec.size) < 5, surprise.attribution.sum() / 5, 0.0)[None]
        return state, surprise._replace(attribution=shares)


@pytest.mark.parametrize("every", [2, 3, 10])
def test_numbers_that_are_lost_in_turn_hide_no_surprise(every):
    """Surprise went to 0 for three rows at each number that was lost, so that one every 150 ms hid everything."""
    for step in range(25, 35):
        said = infos(
            NeuralASMSafety(Acting(blinks(every)), Everywhere({step}, "contact"), "graded"),
            step + 2,
        )
        assert said[step]["reason"] == "surprise"
        assert 3.9 < said[step]["surprise"] <= 10.0  # three of five senses are judged at least
        assert said[step + 1]["intervened"]


# ---------------------------------------------------------------- whose reflex


class BackOff(Hold):
    """A reflex of a user's."""


def test_a_reflex_of_another_environment_is_refused_and_a_class_is_bound():
    env = FakeEnv()
    for reflex in (Hold, BackOff):
        with pytest.raises(
            ValueError,
            match=f"this {reflex.__name__} was made for another environment.*on_alarm={reflex.__name__}",
        ):
            NeuralASMSafety(env, CueMonitor([1]), on_alarm=reflex(FakeEnv()))
        assert NeuralASMSafety(env, CueMonitor([1]), on_alarm=reflex(env)).reset(seed=0)
        assert NeuralASMSafety(env, CueMonitor([1]), on_alarm=reflex).reset(seed=0)
    made = []
    NeuralASMSafety(env, CueMonitor([1]), on_alarm=lambda e: made.append(e) or BackOff(e))
    assert made == [env]


# ---------------------------------------------------------------- copies


def test_a_policy_that_uses_one_buffer_changes_nothing_that_was_said_or_kept():
    env = FakeEnv()
    guarded = NeuralASMSafety(env, CueMonitor([3]), on_alarm="hold")
    guarded.reset(seed=0)
    buffer, said = np.zeros(3, np.float32), []
    for t in range(6):
        buffer[:] = [0.1 * t, 0.0, 1.0 if t < 4 else -1.0]
        said.append(guarded.step(buffer)[4]["asm"]["executed_action"])
    np.testing.assert_allclose([s[0] for s in said], [0, 0.1, 0.2, 0.3, 0, 0], atol=1e-6)
    # the grip of before the alarm, whatever came into the buffer
    np.testing.assert_allclose([s[2] for s in said], 1.0)


# ---------------------------------------------------------------- a monitor that changes


@pytest.mark.parametrize("many", [False, True])
def test_a_monitor_that_is_assigned_watches_from_the_next_episode_on(many):
    inner = SyncVectorEnv([FakeEnv, FakeEnv]) if many else FakeEnv()
    env = (VectorNeuralASMSafety if many else NeuralASMSafety)(
        inner, FadingMonitor([2]), on_alarm="hold"
    )
    act = np.stack([ACT, ACT]) if many else ACT

    def alarms():
        env.reset(seed=0)
        return [bool(np.all(env.step(act)[4]["asm"]["alarm"])) for _ in range(5)]

    assert alarms() == [False, True, False, False, False]
    env.monitor = FadingMonitor([4])
    assert alarms() == [False, False, False, True, False]
    with pytest.raises(RuntimeError, match="not calibrated"):
        env.monitor = CueMonitor(threshold=None)


def test_a_memory_that_is_fitted_while_it_watches_is_an_alarm_until_it_is_taken_over():
    monitor = Judge(())
    env = NeuralASMSafety(Acting(), monitor, "hold")
    assert not any(s["alarm"] for s in infos(env, 5))
    monitor.diagnosis_ = Judge(()).diagnosis_  # as ``fit`` does
    with pytest.warns(UserWarning, match="fitted while it watched"):
        said = env.step(ARM_ACT)[4]["asm"]
    assert said["alarm"]
    assert said["reason"] == "failure"
    assert not any(s["alarm"] for s in infos(env, 5))


# ---------------------------------------------------------------- the box


@pytest.mark.parametrize(
    "action",
    [
        np.ones(3) + 1j,
        np.ma.masked_array(np.ones(3), [0, 1, 0]),
        np.array(["1", "0", "0"]),
        ["1", "0", "0"],
    ],
)
def test_what_would_lose_what_it_is_is_no_action(action):
    env = NeuralASMSafety(FakeEnv(), CueMonitor())
    env.reset(seed=0)
    with pytest.raises(ValueError, match="an action must be numbers"):
        env.step(action)


def test_an_environment_that_cannot_tell_speed_says_so_and_is_held_at_an_alarm():
    env = NeuralASMSafety(
        FakeEnv(), CueMonitor([3]), "hold", contact_limits=ContactLimits(hand_speed=0.05)
    )
    env.reset(seed=0)
    said = [env.step(np.full(3, 0.9, np.float32))[4]["asm"] for _ in range(5)]
    assert {
        (s["severity"]["speed"], s["severity"]["predicted_force"], s["slowed"]) for s in said
    } == {(None, None, 0)}
    assert [s["intervened"] for s in said] == [False] * 4 + [True]
    np.testing.assert_array_equal(env.unwrapped.actions[-1][:2], [0, 0])


def test_steps_in_alarm_are_counted_for_wrappers_outside_that_skip_some():
    env = NeuralASMSafety(FakeEnv(), CueMonitor([1, 2, 6]), on_alarm="monitor")
    env.reset(seed=0)
    infos = [env.step(ACT)[4] for _ in range(8)]
    assert [i["cost_sum"] for i in infos] == [0, 1, 2, 2, 2, 2, 3, 3]
    assert [i["asm_steps"] for i in infos] == [1, 2, 3, 4, 5, 6, 7, 8]
    assert infos[-1]["asm"]["alarms"] == 3
    begun = env.reset(seed=0)[1]
    assert begun["cost_sum"] == begun["asm_steps"] == 0


# ---------------------------------------------------------------- guards around guards, and memories of others


class Twice(gym.Wrapper):
    """Makes two steps of one, and notes before each whether the arm is held."""

    held = ()
    repeat = 2

    def step(self, action):
        for _ in range(self.repeat):
            self.held = (*self.held, self.unwrapped.holding)
            outcome = self.env.step(action)
        return outcome


def strict(env, monitor, **limits):
    return NeuralASMSafety(env, monitor, "hold", contact_limits=ContactLimits(**limits))


def test_of_guards_around_one_environment_the_strictest_limits_count_and_an_outer_one_takes_none_away(
    lift,
):
    robot, memory = lift.unwrapped, NeuralASM.pretrained("panda")
    inner = strict(lift, memory, wrist_force=50.0, hand_speed=0.1)
    NeuralASMSafety(inner, memory, "monitor").reset(seed=0)
    assert robot.contact_limits.stays
    assert robot.contact_limits.hand_speed == 0.1
    NeuralASMSafety(inner, memory, "hold", contact_limits=None).reset(seed=0)
    assert robot.contact_limits.wrist_force == 50.0
    outer = strict(inner, memory, wrist_force=200.0, external_torque=10.0, hand_speed=0.05)
    outer.reset(seed=0)
    felt = robot.felt_channels
    assert robot.contact_limits.hand_speed == 0.05
    both = ContactLimits(50.0, 40.0), ContactLimits(200.0, 10.0)
    strictest = np.minimum(*(limits.limit_of_each(felt) for limits in both))
    np.testing.assert_array_equal(robot.contact_limits.limit_of_each(felt), strictest)
    lift.reset(seed=0)
    assert robot.contact_limits is None


def test_a_guard_inside_a_vector_guard_keeps_its_limits_and_its_costs(lift):
    memory = NeuralASM.pretrained("panda")
    inner = NeuralASMSafety(
        lift, CueMonitor([2], memory.spec), "hold", contact_limits=ContactLimits(wrist_force=50.0)
    )
    env = VectorNeuralASMSafety(SyncVectorEnv([lambda: inner]), memory, "hold", contact_limits=None)
    env.reset(seed=0)
    assert lift.unwrapped.contact_limits.wrist_force == 50.0
    costs = [env.step(np.zeros((1, 7), np.float32))[4]["cost"][0] for _ in range(4)]
    assert costs == [0.0, 0.0, 1.0, 0.0]
    lift.unwrapped.keeps_holding = False


def test_a_hold_of_an_outer_guard_lasts_through_all_parts_of_its_step(lift):
    memory, action = NeuralASM.pretrained("panda"), np.full(7, 0.5, np.float32)
    inner = NeuralASMSafety(lift, CueMonitor([], memory.spec), "hold", contact_limits=None)
    twice = Twice(inner)
    slower = replace(memory.spec, dt=0.1)
    env = NeuralASMSafety(twice, CueMonitor([1], slower), "hold", contact_limits=None)
    env.reset(seed=0)
    for _ in range(4):
        env.step(action)
    assert twice.held == (False,) * 4 + (True,) * 4  # from the step after the alarm on
    assert not lift.unwrapped.holding


def test_a_memory_of_another_robot_controller_or_rate_is_refused_and_both_are_named(lift):
    with pytest.raises(ValueError, match=r"Sawyer.*Panda"):
        NeuralASMSafety(lift, NeuralASM.pretrained("sawyer"))
    with pytest.raises(ValueError, match=r"0\.01 s against 0\.05 s"):
        NeuralASMSafety(lift, NeuralASM.pretrained("panda_100hz"))
    memory = NeuralASM.pretrained("panda")
    memory.about = {**memory.about, "controller": "IK_POSE"}
    with pytest.raises(ValueError, match=r"IK_POSE.*OSC_POSE"):
        NeuralASMSafety(lift, memory)
    memory.about = {}  # nothing is known of it
    env = NeuralASMSafety(lift, memory)
    with pytest.raises(ValueError, match=r"Sawyer.*Panda"):
        env.monitor = NeuralASM.pretrained("sawyer")
    for source in ("", "table"):
        NeuralASMSafety(lift, CueMonitor([], replace(memory.spec, source=source)))


@pytest.mark.parametrize("name", ON_ALARM)
@pytest.mark.filterwarnings("ignore:.*different from the unwrapped version")
def test_a_guarded_environment_keeps_gymnasiums_contract_and_its_info_equals_itself(name, lift):
    env = NeuralASMSafety(lift, NeuralASM.pretrained("panda"), name)
    check_env(env, skip_render_check=True, skip_close_check=True)
    said = []
    for _ in range(2):
        env.reset(seed=4)
        said.append([env.step(np.full(7, 0.3, np.float32))[4] for _ in range(3)])
    assert data_equivalence(*said, exact=True)


def test_a_reflex_does_the_same_in_the_second_episode_as_in_the_first(lift):
    """The hand presses on the table: the way back is that of the own episode, in each of two alike."""
    env = NeuralASMSafety(lift, NeuralASM.pretrained("panda"), on_alarm="retract")
    down = np.zeros(env.action_space.shape, np.float32)
    down[2] = -1.0
    episodes = []
    for _ in range(2):
        env.reset(seed=3)
        steps = [env.step(down)[-1] for _ in range(60)]
        assert any(info["asm"]["intervened"] for info in steps)
        episodes.append([info["asm"]["executed_action"].tolist() for info in steps])
    assert episodes[0] == episodes[1]
