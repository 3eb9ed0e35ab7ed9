"""What is done follows from what is wrong, by a table that a user can edit; whatever fails, the robot holds."""

import gymnasium as gym
import numpy as np
import pytest
from threadpoolctl import threadpool_limits

from asm_gym.guard.repair import Repair
from asm_gym.guard.responses import CAUSES, DEFAULT, RESPONSES, responses_from
from asm_gym.monitors import NeuralASM
from asm_gym.monitors.diagnosis import Diagnosis
from asm_gym.wrappers import NeuralASMSafety
from tests.arms import ACT, MEMORY, SPEC, Acting, Judge, infos, offset
from tests.fakes import CueMonitor, FakeEnv


def test_every_cause_has_a_response_and_every_response_is_known():
    assert set(DEFAULT) == set(CAUSES)
    assert set(DEFAULT.values()) <= set(RESPONSES)
    assert responses_from({"contact": "retract"}) == {**DEFAULT, "contact": "retract"}
    assert DEFAULT["contact"] != "retract"


@pytest.mark.parametrize(
    ("table", "message"),
    [
        ({"weather": "hold"}, "weather.*lasting contact"),
        ({"contact": "dance"}, "dance.*comply"),
        (["hold"], "must map causes to responses"),
    ],
)
def test_unknown_names_in_a_table_are_refused_with_the_known_ones(table, message):
    with pytest.raises(ValueError, match=message):
        NeuralASMSafety(FakeEnv(), CueMonitor(), on_alarm="graded", responses=table)


@pytest.mark.parametrize(
    ("family", "response"), [("contact", "hold"), ("object", "go on"), ("command", "hold")]
)
def test_what_is_done_follows_from_the_cause(family, response):
    env = NeuralASMSafety(Acting(), Judge({10}, family), on_alarm="graded", release_after=2)
    said = infos(env, 20)
    assert said[10]["response"] == response
    assert said[10]["cause"]["family"] == {"command": "action"}.get(family, family)
    assert said[10]["cause"]["probability"] > 0.9
    assert sum(said[10]["cause"]["probabilities"].values()) == pytest.approx(1.0)
    held = [t for t, a in enumerate(env.unwrapped.actions) if not np.array_equal(a, ACT)]
    assert held == ([11, 12] if response == "hold" else [])
    assert said[9]["response"] == ""
    assert said[9]["cause"]["family"] == ""


def test_by_default_the_cause_decides_where_the_monitor_names_one_and_the_robot_holds_where_it_does_not():
    for monitor, actions in (
        (Judge({10}, "object"), [ACT] * 12),
        (CueMonitor({10}), [ACT] * 11 + [0 * ACT]),
    ):
        inner = Acting()
        monitor.spec = Judge({10}).spec
        infos(NeuralASMSafety(inner, monitor), 12)
        np.testing.assert_array_equal(inner.actions, actions)


def test_a_table_of_ones_own_is_followed():
    env = NeuralASMSafety(
        Acting(), Judge({10}, "contact"), on_alarm="graded", responses={"contact": "go on"}
    )
    said = infos(env, 20)
    assert said[10]["transition"] == "go on"
    assert not any(s["intervened"] for s in said)


def test_stopping_holds_for_half_a_second_and_ends_the_episode():
    env = NeuralASMSafety(
        Acting(), Judge(range(10, 99), "joint"), on_alarm="graded", responses={"actuator": "stop"}
    )
    env.reset(seed=0)
    outs = []
    while not outs or not (outs[-1][2] or outs[-1][3]):
        outs.append(env.step(ACT))
    assert len(outs) == 11 + 10
    assert outs[-1][4]["asm"]["gave_up"]
    assert outs[-1][4]["asm"]["cause"]["family"] == "actuator"


def test_a_contact_that_lasts_is_answered_as_one():
    table = {"contact": "go on", "lasting contact": "hold"}
    env = NeuralASMSafety(
        Acting(), Judge(range(10, 99), "contact"), on_alarm="graded", responses=table
    )
    said = infos(env, 35)
    assert [s["response"] for s in said[10:30]] == ["go on"] * 20
    assert said[30]["response"] == "hold"


def test_a_sensor_at_fault_is_completed_and_the_policy_goes_on():
    env = NeuralASMSafety(Acting(offset), Judge({21}, "sensor"), on_alarm="graded")
    said = infos(env, 40)
    assert said[21]["transition"] == "complete"
    assert said[21]["completed"] == ("observation[0]",)
    assert not any(s["intervened"] for s in said)


@pytest.mark.parametrize(("column", "answered"), [(0, []), (3, [30])])
def test_what_is_completed_surprises_nobody_and_what_is_not_still_does(column, answered):
    class Elsewhere(Judge):
        def observe(self, state, stream):
            state, surprise = super().observe(state, stream)
            return state, surprise if state < 30 else surprise._replace(
                attribution=np.roll(surprise.attribution, column, axis=1)
            )

    said = infos(NeuralASMSafety(Acting(offset), Elsewhere({21, 30}), on_alarm="graded"), 40)
    assert [t for t, s in enumerate(said) if s["alarm"]] == [21, *answered]


class Partial(Acting):
    """Its stream says more than its observation: nothing of ``lone``, of which nothing else tells either."""

    stream_spec = SPEC

    def __init__(self, broken):
        super().__init__(broken)
        self.observation_layout = {"joint_position": 2, "hand_position": 2}
        self.observation_space = gym.spaces.Box(-50, 50, (4,), np.float32)

    def reset(self, **kwargs):
        self.last = np.zeros(2, np.float32)
        return super().reset(**kwargs)[0], {"stream": np.append(self.row, self.last)}

    def step(self, action):
        observation, *rest, info = super().step(action)
        return observation, *rest, info | {"stream": np.append(self.row, np.float32(action))}

    def _observe(self):
        self.row = super()._observe()
        return self.row[:4]


def lone_offset(t, row):
    row[4] += 50.0 * (t >= 20)


def lone_lost(t, row):
    row[4] = np.nan if t >= 20 else row[4]


def of_stream(monitor):
    monitor.spec = SPEC
    monitor.diagnosis_ = Diagnosis(MEMORY, monitor.diagnosis_.readout)
    return monitor


def test_a_sensor_that_the_policy_cannot_read_stops_nobody_and_is_said(caplog):
    env = NeuralASMSafety(Partial(lone_offset), of_stream(Judge({21})), on_alarm="graded")
    with caplog.at_level("INFO", "asm_gym.safety"):
        said = infos(env, 80)
    assert "complete: surprise" in caplog.text
    assert "(sensor lone, 0.9" in caplog.text
    assert (said[21]["cause"]["part"], said[21]["case"], said[21]["response"]) == (
        "lone",
        "sensor",
        "complete",
    )
    assert [s["completed"] for s in said] == [()] * 21 + [
        ("lone",)
    ] * 59  # it is never well again: nothing tells of it
    assert not any(s["intervened"] or s["failure"] for s in said)
    np.testing.assert_array_equal(env.unwrapped.actions, [ACT] * 80)


def test_readings_that_are_lost_and_were_never_read_stop_nobody(caplog):
    env = NeuralASMSafety(Partial(lone_lost), of_stream(Judge(())), on_alarm="graded")
    with caplog.at_level("INFO", "asm_gym.safety"):
        said = infos(env, 80)
    assert "complete: lone says nothing any more" in caplog.text
    assert not any(s["intervened"] or s["failure"] for s in said)


def test_where_it_is_not_known_what_a_policy_reads_the_robot_holds():
    changed = gym.wrappers.TransformObservation(
        Partial(lone_offset), lambda o: o[:3], gym.spaces.Box(-50, 50, (3,))
    )
    with pytest.warns(UserWarning, match="so the robot holds"):
        env = NeuralASMSafety(changed, of_stream(Judge({21})), on_alarm="graded", release_after=2)
    assert [s["intervened"] for s in infos(env, 30)[21:25]] == [False, True, True, False]


def test_where_nothing_is_left_to_check_by_the_robot_holds_and_says_so():
    def silent(t, row):
        row[4] = np.nan if t >= 10 else row[4]  # what nothing else tells of

    env = NeuralASMSafety(Acting(silent), Judge(()), on_alarm="graded")
    with pytest.warns(UserWarning, match=r"too much is missing, or for too long: observation\[4\]"):
        said = infos(env, 40)
    assert not any(s["intervened"] for s in said[:30])
    assert all(s["intervened"] for s in said[32:])
    assert "too much is missing" in said[-1]["failure"]


def test_all_senses_lost_is_held():
    def blind(t, row):
        row[:] = np.nan if t >= 10 else row

    class Careful(Judge):
        def observe(self, state, stream):
            state, surprise = super().observe(state, stream)
            return state, surprise._replace(
                value=np.where(np.isfinite(stream).all(axis=1), 0.1, np.inf)
            )

    said = infos(NeuralASMSafety(Acting(blind), Careful(()), on_alarm="graded"), 20)
    assert all(s["intervened"] for s in said[10:])
    assert said[-1]["cause"]["family"] == "unknown"


def test_a_stream_that_stops_for_a_second_is_held_for_as_long_without_a_trial_and_the_policy_resumes():
    class Stopping(gym.Wrapper):
        def step(self, action):
            observation, *rest = self.env.step(action)
            return observation[:2] if 20 < self.unwrapped.t <= 40 else observation, *rest

    env = NeuralASMSafety(Stopping(Acting()), Judge(()), release_after=5)
    with pytest.warns(UserWarning, match="stream: ValueError"):
        said = infos(env, 60)
    assert [t for t, s in enumerate(said) if s["intervened"]] == list(range(21, 45))
    assert [t for t, s in enumerate(said) if s["failure"].startswith("stream: ")] == list(
        range(20, 40)
    )
    assert [(t, s["transition"]) for t, s in enumerate(said) if s["transition"]] == [
        (20, "override"),
        (44, "release"),
    ]


def test_a_diagnosis_that_raises_is_answered_as_the_unknown_is():
    monitor = Judge({10}, "object")
    object.__setattr__(monitor.diagnosis_, "readout", lambda evidence: 1 / 0)
    env = NeuralASMSafety(Acting(), monitor, on_alarm="graded", release_after=2)
    with pytest.warns(UserWarning, match="diagnosis: ZeroDivisionError"):
        said = infos(env, 20)
    assert (said[10]["cause"]["family"], said[10]["response"]) == ("unknown", "hold")
    assert [s["intervened"] for s in said[10:14]] == [False, True, True, False]


def test_a_completion_that_raises_loses_the_row_and_not_the_guard(monkeypatch):
    def lost(t, row):
        row[0] = np.nan if t == 2 else row[0]

    env = NeuralASMSafety(Acting(lost), Judge({21}, "sensor"), on_alarm="graded")
    monkeypatch.setattr(Repair, "next", lambda repair, row: 1 / 0)
    with pytest.warns(UserWarning, match="completion: ZeroDivisionError"):
        said = infos(env, 4)
    assert said[1]["alarm"]


def test_a_cause_is_the_same_on_any_number_of_threads():
    known = NeuralASM.pretrained("panda").diagnosis_
    senses, causes = known.completion.senses, []
    for threads in (1, 2, 4):
        rng = np.random.default_rng(0)
        with threadpool_limits(threads):
            diagnosis = Diagnosis(known.completion, known.readout)
            rows = senses.mean + senses.spread * rng.normal(size=(3, 12, len(senses.mean)))
            causes.append([diagnosis(own, np.ones(len(senses.mean))).probabilities for own in rows])
    assert causes[0] == causes[1] == causes[2]


def test_slow_lets_the_policy_go_on_at_a_quarter_of_the_speed_whatever_the_cause(lift):
    monitor = CueMonitor({5}, spec=lift.unwrapped.stream_spec)
    env = NeuralASMSafety(lift, monitor, on_alarm="graded", responses={"unknown": "slow"})
    env.reset(seed=0)
    action = np.float32([0, 1, 0, 0, 0, 0, -1])
    said = [env.step(action)[-1]["asm"] for _ in range(40)]
    assert said[5]["transition"] == "slow"
    assert not any(s["intervened"] for s in said)
    speeds = [s["executed_action"][1] for s in said]
    assert speeds[10] == pytest.approx(speeds[4] / 4, rel=0.05)
    assert speeds[-1] == pytest.approx(speeds[4], rel=0.05)


def test_slow_is_refused_where_no_speed_can_be_limited():
    with pytest.raises(ValueError, match="slow"):
        NeuralASMSafety(Acting(), Judge({10}), responses={"contact": "slow"})


def test_a_pressing_arm_is_never_let_go_on_slowly():
    with pytest.raises(ValueError, match="pressing"):
        responses_from({"pressing": "slow"})
