"""A policy in LeRobot's loop is guarded: with the library's own pipeline where it is installed, and without it."""

from __future__ import annotations

import numpy as np
import pytest

from asm_gym.data.episode import Episode
from asm_gym.monitors import make_monitor
from asm_gym.wrappers.lerobot import LeRobotGuard
from tests.needs import needs

MOTORS = [
    "shoulder_pan.pos",
    "shoulder_lift.pos",
    "elbow_flex.pos",
    "wrist_flex.pos",
    "wrist_roll.pos",
    "gripper.pos",
]
RATE = 30.0


class Arm:
    """Servos that go a third of the way to where they are told; ``jammed`` ones stay. Degrees, as an SO-101 says."""

    def __init__(self, seed: int) -> None:
        self.rng = np.random.default_rng(seed)
        self.q, self.jammed, self.sent = np.zeros(6), np.zeros(6, np.bool_), list[np.ndarray]()
        self.phase = self.rng.uniform(0, 6, 6)

    def get_observation(self) -> dict[str, float]:
        return dict(zip(MOTORS, (self.q + 0.05 * self.rng.normal(size=6)).tolist(), strict=True))

    def send_action(self, action: dict[str, float]) -> dict[str, float]:
        told = np.array([action[m] for m in MOTORS])
        self.sent.append(told)
        self.q = np.where(self.jammed, self.q, self.q + (told - self.q) / 3)
        return action

    def policy(self, k: int) -> dict[str, float]:
        wave = 30 * np.sin(np.arange(1, 7) * 0.4 * k / RATE + self.phase)
        return dict(zip(MOTORS, (wave * min(1, k / 30)).tolist(), strict=True))


def recorded(seed: int, rows: int = 260, arm: type[Arm] = Arm) -> Episode:
    """A healthy run, with a pause, for a hold is one too."""
    robot, columns = arm(seed), list[list[float]]()
    pause = int(np.random.default_rng(seed).integers(60, 180))
    for k in range(rows):
        going = k if k < pause else max(pause, k - 60)
        observation, action = robot.get_observation(), robot.policy(going)
        columns.append([*observation.values(), *action.values()])
        robot.send_action(action)
    names = [f"observation.state[{name}]" for name in observation]
    names += [f"action[{name}]" for name in action]
    made = dict(zip(names, np.array(columns).T, strict=True))
    return Episode.from_table(made, rate=RATE, action=["action*"], success=True)


@pytest.fixture(scope="module")
def monitor():
    made = make_monitor("kalman+evidence", recorded(0).spec).fit([recorded(n) for n in range(20)])
    return made.calibrate([recorded(100 + n) for n in range(39)], 0.025)


def run(guard, arm, rows=200, jam=100, begin=0, step=None):
    """The rows of alarm and of intervention."""
    step = step or (lambda o, a: guard({"observation": o, "action": a})["action"])
    alarms, others = [], []
    for k in range(begin, begin + rows):
        if k == jam:
            arm.jammed[2] = True
        arm.send_action(step(arm.get_observation(), arm.policy(k)))
        alarms += [k] * guard.alarm
        others += [k] * guard.intervened
    return alarms, others


def test_a_healthy_policy_is_let_go_on(monitor):
    guard, arm = LeRobotGuard(monitor), Arm(200)
    assert run(guard, arm, jam=-1) == ([], [])
    np.testing.assert_array_equal(arm.sent[-1], list(arm.policy(199).values()))


def test_a_jammed_joint_is_an_alarm_and_the_arm_stays_where_it_stood(monitor):
    guard, arm = LeRobotGuard(monitor), Arm(201)
    alarms, others = run(guard, arm, rows=120)
    assert 100 < alarms[0] <= 115
    assert others[0] == alarms[0]
    assert guard.last_alarm["servo"] == "elbow_flex"
    held = arm.sent[alarms[0] :]
    np.testing.assert_array_equal(held, np.repeat(held[:1], len(held), axis=0))
    told_before = arm.sent[alarms[0] - 1]
    assert held[0][5] == pytest.approx(told_before[5], rel=1e-6)  # the gripper keeps its grip
    assert np.abs(held[0][:5] - arm.q[:5]).max() < 1.0


@pytest.mark.parametrize(
    ("hot", "fault"), [(25.0, "stalled"), (71.0, "overheated"), (None, "stalled")]
)
def test_a_servo_that_stalls_or_overheats_is_named(monitor, hot, fault):
    guard, arm = LeRobotGuard(monitor, "monitor"), Arm(201)

    def step(observation, action):
        if hot is not None:
            observation["elbow_flex.temperature"] = hot if arm.jammed[2] else 25.0
        return guard({"observation": observation, "action": action})["action"]

    run(guard, arm, rows=125, step=step)
    assert (guard.last_alarm["servo"], guard.last_alarm["fault"]) == ("elbow_flex", fault)


def test_a_hold_ends_when_it_is_quiet_and_a_stop_when_it_is_reset(monitor):
    for response, over in (("hold", True), ("stop", False)):
        guard, arm = LeRobotGuard(monitor, response, release_s=0.5), Arm(202)
        run(guard, arm, rows=115)
        assert guard.intervened
        arm.jammed[:] = False
        still = dict(zip(MOTORS, arm.sent[-1], strict=True))
        for _ in range(120):
            arm.send_action(
                guard({"observation": arm.get_observation(), "action": dict(still)})["action"]
            )
        assert guard.intervened is not over
        guard.reset()
        arm.send_action(
            guard({"observation": arm.get_observation(), "action": dict(still)})["action"]
        )
        assert not guard.intervened


def test_the_former_name_of_an_argument_is_taken_for_one_release(monitor):
    with pytest.warns(DeprecationWarning, match="release_s"):
        assert LeRobotGuard(monitor, quiet_s=0.5).release_s == 0.5


def test_monitor_only_says_so(monitor):
    guard, arm = LeRobotGuard(monitor, "monitor"), Arm(203)
    alarms, others = run(guard, arm, rows=120)
    assert alarms
    assert not others


@pytest.mark.filterwarnings("ignore:policy. the action must be finite")
@pytest.mark.parametrize(
    "spoil",
    [
        lambda o, a: o.pop("wrist_roll.pos"),
        lambda o, a: o.update({"wrist_roll.pos": float("nan")}),
        lambda o, a: a.update({"wrist_roll.pos": float("inf")}),
    ],
)
def test_what_is_missing_or_not_finite_is_held_at_once_at_finite_numbers(monitor, spoil):
    guard, arm = LeRobotGuard(monitor), Arm(204)
    run(guard, arm, rows=60, jam=-1)
    observation, action = arm.get_observation(), arm.policy(60)
    spoil(observation, action)
    sent = guard({"observation": observation, "action": action})["action"]
    assert guard.intervened
    assert np.isfinite(list(sent.values())).all()
    assert abs(sent["wrist_roll.pos"] - arm.q[4]) < 8  # near where it stands


@pytest.mark.filterwarnings("ignore:(policy. the action|reflex).*finite")
@pytest.mark.parametrize("on_alarm", ["hold", "stop", "monitor"])
@pytest.mark.parametrize("rows", [1, 60])
@pytest.mark.parametrize("what", ["observation", "action"])
@pytest.mark.parametrize("value", [None, "?", float("nan"), float("inf"), "missing"])
def test_only_finite_numbers_are_sent_and_nothing_before_there_is_a_place_to_hold(
    monitor, on_alarm, rows, what, value
):
    guard, arm = LeRobotGuard(monitor, on_alarm), Arm(208)
    for k in range(60):
        given = {"observation": arm.get_observation(), "action": arm.policy(k)}
        if k < rows:
            given[what]["elbow_flex.pos"] = value
            if value == "missing":
                del given[what]["elbow_flex.pos"]
        sent = guard(given)["action"]
        assert np.isfinite(list(sent.values())).all()
        if k < rows:
            assert guard.alarm or guard.intervened
            assert what == "action" or on_alarm == "monitor" or not sent
        elif on_alarm != "monitor":
            assert set(sent) == set(MOTORS)
        arm.q[[MOTORS.index(name) for name in sent]] = [*sent.values()]


@pytest.mark.filterwarnings("ignore:policy. the action must be finite")
def test_a_velocity_is_held_by_zero_and_what_no_name_tells_must_be_told(monitor):
    names = [
        f"{what}[{m.replace('.pos', '.vel')}]"
        for what in ("observation.state", "action")
        for m in MOTORS
    ]
    other = recorded(0)
    named = Episode.from_table(
        dict(zip(names, other.stream.T.astype(float), strict=True)), rate=RATE, action=["action*"]
    )
    rolls = make_monitor("kalman+evidence", named.spec)
    rolls = rolls.restore_learned(monitor.learned_)
    rolls.threshold_ = monitor.threshold
    observation = dict(
        zip((m.replace(".pos", ".vel") for m in MOTORS), np.arange(6.0), strict=True)
    )
    guard = LeRobotGuard(rolls)
    sent = guard({"observation": observation, "action": dict.fromkeys(observation, float("nan"))})[
        "action"
    ]
    assert list(sent.values())[:5] == [0.0] * 5
    guard = LeRobotGuard(monitor, action_means="torque")
    with pytest.raises(ValueError, match="action_means"):
        guard({"observation": Arm(0).get_observation(), "action": Arm(0).policy(0)})


def test_a_monitor_that_fails_ends_in_the_hold(monitor, monkeypatch):
    guard, arm = LeRobotGuard(monitor), Arm(205)
    run(guard, arm, rows=60, jam=-1)
    monkeypatch.setattr(type(monitor), "observe", lambda *args: 1 / 0)
    with pytest.warns(UserWarning, match="monitor: ZeroDivisionError"):
        guard({"observation": arm.get_observation(), "action": arm.policy(60)})
    assert guard.intervened


def test_what_it_cannot_guard_is_refused(monitor):
    with pytest.raises(ValueError, match="unknown on_alarm 'run'; known: hold"):
        LeRobotGuard(monitor, "run")
    other = Episode.from_table({"q": np.zeros(20)}, rate=30.0).spec
    monitor_of_other = make_monitor("kalman+evidence", other)
    with pytest.raises(RuntimeError):
        LeRobotGuard(monitor_of_other)
    with pytest.raises(TypeError, match="actions with names"):
        LeRobotGuard(monitor)({"observation": {}, "action": np.zeros(6)})


@pytest.mark.filterwarnings("ignore:.*(range|action must be finite)")
@pytest.mark.parametrize("times", [1.6, 5.0, 1e6, 3e38])
@pytest.mark.parametrize("joints", [slice(0, 1), slice(0, 5)])
def test_a_command_beyond_the_healthy_range_is_an_alarm_and_is_not_sent(monitor, times, joints):
    guard, arm = LeRobotGuard(monitor), Arm(209)
    run(guard, arm, rows=60, jam=-1)
    action = arm.policy(60)
    for name in MOTORS[joints]:
        action[name] = min(30.0 * times, 3e38)
    sent = guard({"observation": arm.get_observation(), "action": action})["action"]
    assert guard.alarm
    assert guard.intervened
    assert guard.last_alarm["reason"] == "out_of_range"
    assert max(abs(value) for value in sent.values()) < 45


@pytest.mark.filterwarnings("ignore:.*range")
def test_a_command_that_leaps_within_the_range_is_not_sent(monitor):
    guard, arm = LeRobotGuard(monitor), Arm(210)
    run(guard, arm, rows=60, jam=-1)
    last = np.array(list(arm.policy(59).values()))
    leap = dict(zip(MOTORS, np.where(last > 0, -28.0, 28.0).tolist(), strict=True))
    sent = guard({"observation": arm.get_observation(), "action": leap})["action"]
    assert guard.alarm
    assert np.abs(np.array([sent[m] for m in MOTORS]) - last).max() < 20


@pytest.mark.filterwarnings("ignore:.*range")
def test_a_slow_drift_out_of_the_healthy_range_is_an_alarm(monitor):
    for response in ("hold", "monitor"):
        guard, arm = LeRobotGuard(monitor, response), Arm(211)
        run(guard, arm, rows=60, jam=-1)
        start = np.array(list(arm.policy(59).values()))
        for k in range(400):
            drift = start + 0.4 * k
            arm.send_action(
                guard(
                    {
                        "observation": arm.get_observation(),
                        "action": dict(zip(MOTORS, drift.tolist(), strict=True)),
                    }
                )["action"]
            )
            if guard.alarm:
                break
        assert guard.alarm
        assert np.abs(arm.q).max() < 60


def test_names_that_the_memory_does_not_know_and_numbers_that_are_none_are_refused(monitor):
    guard, arm = LeRobotGuard(monitor), Arm(212)
    with pytest.raises(ValueError, match=r"no action called thumb\.pos"):
        guard({"observation": arm.get_observation(), "action": arm.policy(0) | {"thumb.pos": 1e30}})
    run(guard, arm, rows=60, jam=-1)
    action = arm.policy(60) | {"elbow_flex.pos": 10**400}
    with pytest.warns(UserWarning, match="finite"):
        sent = guard({"observation": arm.get_observation(), "action": action})["action"]
    assert guard.intervened
    assert np.isfinite(list(sent.values())).all()


def test_lerobots_own_pipeline_takes_it(monitor):
    processor = needs("lerobot.processor")
    converters = needs("lerobot.processor.converters")
    guard, arm = LeRobotGuard(monitor), Arm(206)
    pipeline = processor.RobotProcessorPipeline(
        steps=[guard],
        to_transition=converters.robot_action_observation_to_transition,
        to_output=converters.transition_to_robot_action,
    )
    alarms, others = run(guard, arm, rows=120, step=lambda o, a: pipeline((a, o)))
    assert 100 < alarms[0] <= 115
    assert others[0] == alarms[0]
    pipeline.reset()
    assert not guard.intervened


class CurrentArm(Arm):
    """Servos that say their currents: they rise with the distance to the target."""

    def get_observation(self) -> dict[str, float]:
        told = self.sent[-1] if self.sent else self.q
        currents = 0.1 + 0.02 * np.abs(told - self.q) + 0.005 * self.rng.random(6)
        names = [motor.replace(".pos", ".current") for motor in MOTORS]
        return super().get_observation() | dict(zip(names, currents.tolist(), strict=True))


@pytest.fixture(scope="module")
def deaf():
    """A monitor of an arm that says its currents, and that no surprise wakes."""
    episodes = [recorded(n, arm=CurrentArm) for n in range(12)]
    made = make_monitor("kalman", episodes[0].spec).fit(episodes[:6])
    return made.calibrate(episodes[6:], 0.2).with_threshold(1e12)


@pytest.mark.parametrize("servo", [2, 5])  # the elbow, and the gripper, whose grip a hold keeps
def test_a_stalled_servo_with_a_high_current_is_an_alarm_by_itself_and_is_unloaded(deaf, servo):
    guard, arm = LeRobotGuard(deaf), CurrentArm(201)
    for k in range(160):
        arm.jammed[servo] = k >= 100
        observation = arm.get_observation()
        arm.send_action(guard({"observation": observation, "action": arm.policy(k)})["action"])
        if guard.alarm:
            break
    assert 100 < k < 140
    motor = MOTORS[servo]
    alarm = guard.last_alarm
    assert (alarm["reason"], alarm["response"], alarm["fault"]) == ("stall", "unload", "stalled")
    assert motor == f"{alarm['servo']}.pos"
    assert arm.sent[-1][servo] == pytest.approx(observation[motor])  # it stands there
    for _ in range(10):
        observation = arm.get_observation()
        arm.send_action(guard({"observation": observation, "action": arm.policy(k)})["action"])
        assert guard.intervened
        assert abs(arm.sent[-1][servo] - arm.q[servo]) < 0.5
    assert observation[motor.replace(".pos", ".current")] < 0.15


def test_a_high_current_of_an_arm_that_moves_and_a_still_arm_are_no_stall(deaf):
    guard, arm = LeRobotGuard(deaf), CurrentArm(202)
    for k in range(120):
        observation = arm.get_observation()
        if k < 60:
            observation["elbow_flex.current"] = 9.0
        action = arm.policy(min(k, 60))
        arm.send_action(guard({"observation": observation, "action": action})["action"])
        assert not guard.alarm, guard.last_alarm
