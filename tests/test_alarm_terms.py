"""Alarm terms: named causes, each a mask over the table of robots, the user's own beside those built in."""

from __future__ import annotations

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.vector import SyncVectorEnv

from asm_gym.guard.adapter import SensedRows
from asm_gym.guard.alarm_terms import ALARM_TERMS, register_alarm_term
from asm_gym.guard.guard import Guard
from asm_gym.guard.options import GuardOptions
from asm_gym.guard.robot_facts import RobotFacts
from asm_gym.wrappers import NeuralASMSafety, VectorNeuralASMSafety
from tests.arms import ACT, Acting, Judge, infos
from tests.fakes import SPEC, CueMonitor, FadingMonitor, FakeEnv


@pytest.fixture(autouse=True)
def _forget_terms():
    yield
    for name in [name for name in ALARM_TERMS if name not in ALARM_TERMS.own]:
        del ALARM_TERMS[name]


class Curtain(gym.Wrapper):
    """A light curtain that is broken in step 5."""

    def step(self, action):
        *rest, info = self.env.step(action)
        self.t = getattr(self, "t", 0) + 1
        return *rest, {**info, "curtain": float(self.t == 5)}


def broken(robots):
    return robots.info("curtain", 0.0) > 0.0


def test_a_light_curtain_is_an_alarm_term_and_the_arm_holds():
    register_alarm_term("curtain", broken, help="the curtain is broken")
    env = NeuralASMSafety(Curtain(Acting()), Judge(()), "graded", release_after=2)
    said = infos(env, 7)
    assert [s["alarm"] for s in said] == [False] * 4 + [True] + [False] * 2
    assert (said[4]["reason"], said[4]["terms"], said[4]["event"]) == (
        "curtain",
        ("curtain",),
        "fault",
    )
    assert (said[4]["response"], said[4]["transition"]) == ("hold", "override")
    assert [s["intervened"] for s in said[4:]] == [False, True, True]
    assert "curtain" in str(env.guard)
    assert env.guard.terms.held_rows["curtain"] == 1


@pytest.mark.parametrize(
    ("on_alarm", "ends"), [("hold", False), ("terminate", True), ("monitor", False)]
)
def test_a_term_acts_as_any_alarm_under_other_settings(on_alarm, ends):
    register_alarm_term("curtain", broken)
    env = NeuralASMSafety(Curtain(FakeEnv()), CueMonitor(), on_alarm)
    env.reset(seed=0)
    outs = [env.step(np.zeros(3, np.float32)) for _ in range(5)]
    assert outs[-1][4]["asm"]["reason"] == "curtain"
    assert outs[-1][4]["cost"] == 1.0
    assert outs[-1][2] == ends


def test_a_force_sensor_in_the_gripper_is_read_from_the_row():
    register_alarm_term("force", lambda robots: robots.channel("position").max(axis=1) >= 3.0)
    env = NeuralASMSafety(FakeEnv(), CueMonitor(), "monitor")
    env.reset(seed=0)
    alarms = [env.step(np.zeros(3, np.float32))[4]["asm"]["alarm"] for _ in range(4)]
    assert alarms == [False, False, True, True]


def test_in_a_vector_a_term_speaks_of_its_own_robot():
    register_alarm_term("far", lambda robots: robots.channel("position").max(axis=1) > 100.0)
    members = [lambda i=i: FakeEnv(20, first=100 * i) for i in range(2)]
    env = VectorNeuralASMSafety(SyncVectorEnv(members), FadingMonitor(()), "hold")
    env.reset(seed=0)
    infos_of_step = env.step(np.zeros((2, 3), np.float32))[-1]
    assert infos_of_step["asm"]["reason"].tolist() == ["", "far"]
    assert infos_of_step["asm_alarm"].tolist() == [False, True]


def test_contact_comes_before_a_users_term_and_no_term_lets_a_pressing_arm_go_on():
    class Pressing(Acting):
        @property
        def felt(self):
            return 1.2 if self.t == 5 else 0.1

    register_alarm_term("curtain", broken, response="go on")
    said = infos(NeuralASMSafety(Curtain(Pressing()), Judge(()), "graded"), 6)
    assert said[4]["terms"] == ("contact", "curtain")
    assert said[4]["reason"] == "contact"
    assert said[5]["intervened"]


def test_a_term_that_lets_the_policy_go_on_is_an_alarm_without_an_override():
    register_alarm_term("curtain", broken, response="go on", priority=5)
    said = infos(NeuralASMSafety(Curtain(Acting()), Judge(()), "graded"), 6)
    assert said[4]["alarm"]
    assert not said[5]["intervened"]


def test_what_is_no_term_is_refused():
    with pytest.raises(ValueError, match="surprise"):
        register_alarm_term("surprise", broken)
    with pytest.raises(ValueError, match="unknown response 'complete'"):
        register_alarm_term("curtain", broken, response="complete")


@pytest.mark.parametrize(
    ("holds", "said"),
    [
        (lambda robots: np.zeros(3), "it must return a mask"),
        (lambda robots: robots.channel("nowhere"), "unknown channel 'nowhere'"),
    ],
)
def test_a_term_that_fails_is_an_alarm(holds, said):
    register_alarm_term("wrong", holds)
    env = NeuralASMSafety(FakeEnv(), CueMonitor(), "hold")
    env.reset(seed=0)
    with pytest.warns(UserWarning, match="alarm term wrong"):
        info = env.step(np.zeros(3, np.float32))[4]["asm"]
    assert (info["reason"], info["state"]) == ("failure", "reflex")
    assert said in info["failure"]


class Unbounded(FakeEnv):
    """Its actions are joint targets without bounds."""

    def __init__(self):
        super().__init__(30)
        self.action_space = gym.spaces.Box(-np.inf, np.inf, (3,), np.float32)


@pytest.mark.parametrize("action", [5.0, 1e6, 3e38])
def test_an_absurd_action_without_bounds_is_not_executed_and_a_healthy_one_is(action):
    monitor = CueMonitor()
    monitor.commands_ = np.array([[-1.0] * 3, [1.0] * 3, [0.2] * 3])  # of healthy commands
    inner = Unbounded()
    env = NeuralASMSafety(inner, monitor, "hold", release_after=2)
    env.reset(seed=0)
    env.step(np.full(3, 1.5, np.float32))
    info = env.step(np.full(3, action, np.float32))[4]
    assert inner.actions[0].max() == 1.5
    assert inner.actions[1].tolist() == [0.0, 0.0, 1.5]  # it stays, and keeps its grip
    assert (info["asm"]["reason"], info["overridden"]) == ("out_of_range", True)
    assert np.isfinite(info["asm"]["surprise"])


@pytest.mark.parametrize("field", ["threshold", "pressed_impulse", "leaning_time"])
def test_a_record_that_is_not_finite_is_an_alarm_of_that_robot_alone_and_says_which_field(field):
    low = np.full(3, -1.0, np.float32)
    facts = RobotFacts(2, low, -low, np.zeros(3, np.float32), dt=0.05)
    guard = Guard(facts, FadingMonitor(()), GuardOptions("hold"))
    guard.begin()
    guard.table.records[field][1] = np.nan
    rows = np.zeros((2, SPEC.size), np.float32)
    with pytest.warns(UserWarning, match=f"guard: {field} is nan; which counts as an alarm"):
        report = guard.judge(SensedRows(rows), np.zeros((2, 3), np.float32))
    assert report.robots["alarm"].tolist() == [False, True]
    assert report.failures == {1: f"guard: {field} is nan"}
    assert guard.overriding.tolist() == [False, True]


def test_the_table_prints_and_is_copied_as_one_array():
    env = NeuralASMSafety(Acting(), Judge({3}), "graded")
    env.reset(seed=0)
    for _ in range(5):
        env.step(ACT)
    table = env.guard.table
    assert "surprise" in str(table)
    kept = np.frombuffer(table.records.tobytes(), table.records.dtype)
    assert kept["largest_surprise"] == 10.0
