"""A row in one compiled call, against the same rules in plain Python, and against the guard's steps one by one."""

from __future__ import annotations

import math

import numpy as np
import pytest

from asm_gym.detection.alarm_rule import EVENTS, JUDGED
from asm_gym.detection.contact_limits import FREE_FORCE, LEANS_S
from asm_gym.guard.adapter import SensedRows
from asm_gym.guard.alarm_terms import ALARM_TERMS, register_alarm_term
from asm_gym.guard.arbiter import MOSTLY_AFTER
from asm_gym.guard.contact_state import (
    HEAVIEST,
    LEVER,
    SLOW_FORCE,
    SLOW_HAND,
    SOONER,
    WEIGHED_S,
    contact_columns,
    measure_contacts,
)
from asm_gym.guard.guard import Guard
from asm_gym.guard.hand_check import HandChecks
from asm_gym.guard.judged_rows import apply_alarm_rule
from asm_gym.guard.options import GuardOptions
from asm_gym.guard.recent_rows import IMPOSSIBLE, MOST_REPEAT, RecentRows
from asm_gym.guard.reflexes import PATH, USUAL_GAIN, MotionArrays, record_motion
from asm_gym.guard.robot_facts import RobotFacts
from asm_gym.guard.robot_table import POLICY, REFLEX, RobotTable
from asm_gym.guard.row_validation import validate_rows
from asm_gym.monitors import NeuralASM
from asm_gym.spec import MOTOR, Channel, StreamSpec

DT = 0.05
MOST_IMPULSE = 20.0
SPEC = StreamSpec(
    (
        Channel("wrist_force", 3, "N", 0.2, resolution=0.05),
        Channel("external_torque", 2, "N m", 0.1),
        Channel("hand_velocity", 3, "m/s", 3e-3),
        Channel("action", 2, group=MOTOR),
    ),
    DT,
)
ROBOTS = 3


class PlainRobot:
    """The rules of one robot, written as they are told."""

    def __init__(self):
        self.state, self.threshold = POLICY, 1.0
        self.weights = {"felt": [0.0, np.zeros(3)], "sensed": [0.0, np.zeros(3)]}
        self.impulse = self.leaning = 0.0
        self.strikes = self.calm = self.policy_rows = self.since = 0
        self.largest = -math.inf
        self.readings = None
        self.torque = self.usual = np.zeros(2)
        self.path = []

    def validated(self, row):
        """With NaN for stale senses."""
        chance = np.clip(SPEC.resolution / (2 * np.sqrt(np.pi) * SPEC.noise + 1e-300), 1e-6, 1.0)
        noisy = (SPEC.noise > 0) & (chance < 0.5)
        noisy[SPEC.motor] = False
        again = (
            noisy & (row == self.readings)
            if self.readings is not None
            else np.zeros(SPEC.size, bool)
        )
        self.readings = row.copy()
        stale = (
            -np.log(chance[again]).sum() > IMPOSSIBLE and again.sum() > MOST_REPEAT * noisy.sum()
        )
        return np.where(again & stale, np.nan, row)

    def force(self, wrist, torques, name):
        steps, weight = self.weights[name]
        if wrist @ wrist < HEAVIEST**2:
            steps = min(steps + 1, WEIGHED_S / DT)
            weight = weight + (wrist - weight) / steps
            self.weights[name] = [steps, weight]
        return np.fmax(np.linalg.norm(wrist - weight), np.abs(torques).max() / LEVER)

    def measure(self, row, load):
        force = self.force(load[4:7], load[2:4], "felt")
        if np.isnan(force):
            force = self.force(row[:3], row[3:5], "sensed")
        speed = np.linalg.norm(row[5:8])
        excess = max(force - FREE_FORCE, 0.0) if np.isfinite(force) else 0.0
        self.impulse += excess * DT
        lean = -DT
        if excess > 0:
            lean = DT + (DT * excess / SLOW_FORCE if speed < SLOW_HAND else 0.0)
        self.leaning = min(max(self.leaning + lean, 0.0), 2 * LEANS_S)
        leans = self.leaning > LEANS_S / (1 + SOONER * self.strikes)
        self.presses = load[0] > 1 or np.isfinite(load[1]) or leans or self.impulse > MOST_IMPULSE
        return force, speed

    def decides(self, value, raw, excuse, lost):
        """Whether there is something to decide; else the row is counted."""
        self.event = excuse if raw > self.threshold and value <= self.threshold else 0
        knocked = EVENTS[self.event] == "knock"
        reported = self.policy_rows == MOSTLY_AFTER - 1
        if lost or self.presses or not value <= self.threshold or knocked:
            return True
        if self.state != POLICY or reported:
            return True
        self.calm += 1
        self.since += 1
        self.policy_rows += 1
        self.largest = max(self.largest, value)
        return False

    def record(self, row, executed):
        overridden = self.state == REFLEX
        if not overridden:
            self.usual = self.usual + USUAL_GAIN * (self.torque - self.usual)
            self.path = [*self.path, executed][-PATH:]
        self.torque = np.where(np.isfinite(row[3:5]), row[3:5], 0.0)


def test_a_row_is_judged_as_the_rules_say():
    rng = np.random.default_rng(0)
    felt = (Channel("external_torque", 2, "N m"), Channel("wrist_force", 3, "N"))
    table = RobotTable(ROBOTS, SPEC, 1.0)
    records = table.records
    records["ends_step"] = True
    recent, hands = RecentRows(ROBOTS, SPEC, 10), HandChecks(ROBOTS, (), SPEC)
    columns = contact_columns(felt, SPEC)
    motion = MotionArrays(
        torque_columns=np.array([3, 4]),
        torque=np.zeros((ROBOTS, 2)),
        usual_torque=np.zeros((ROBOTS, 2)),
        path=np.zeros((ROBOTS, PATH, 2), np.float32),
        path_steps=np.zeros(ROBOTS, np.int64),
    )
    plain = [PlainRobot() for _ in range(ROBOTS)]
    before = np.zeros((ROBOTS, SPEC.size), np.float32)
    decided = 0
    for t in range(600):
        rows = rng.normal(0, [4, 4, 8, 3, 3, 0.1, 0.1, 0.1, 1, 1], (ROBOTS, SPEC.size))
        rows = rows.astype(np.float32)
        rows[0, 2] += 70.0 * (200 < t < 230)  # it leans
        rows[1, rng.integers(8)] = np.nan if rng.random() < 0.02 else rows[1, 0]
        if 300 < t < 310:
            rows[2, :8] = before[2, :8]  # a stale bus
        before = rows.copy()
        load = np.full((ROBOTS, 7), np.nan)
        load[:, 1] = np.inf
        if t % 3:
            load[:, 0] = rng.uniform(0, 0.5, ROBOTS)
            load[:, 2:] = rng.normal(0, 5, (ROBOTS, 5))
        load[0, 0] = 1.5 if t == 400 else load[0, 0]
        judged = np.zeros(ROBOTS, JUDGED)
        judged["surprise"] = rng.exponential(0.2, ROBOTS)
        judged["raw_surprise"] = judged["surprise"] * rng.choice([1.0, 10.0], ROBOTS)
        judged["excuse"] = rng.integers(0, 3, ROBOTS)
        executed = rng.normal(size=(ROBOTS, 2)).astype(np.float32)
        records["state"] = rng.choice([POLICY, REFLEX], ROBOTS, p=[0.9, 0.1])
        records["strikes"] = rng.integers(0, 2, ROBOTS)
        sensed, values = rows.copy(), judged.copy()

        validate_rows(records, rows, recent.arrays, hands.geometry, hands.state)
        measure_contacts(records, rows, load, columns, DT, MOST_IMPULSE)
        count = apply_alarm_rule(records, judged, np.zeros((ROBOTS, SPEC.size)))
        record_motion(records, rows, executed, motion)

        wanted = []
        for n, robot in enumerate(plain):
            robot.state, robot.strikes = records["state"][n], records["strikes"][n]
            row = robot.validated(sensed[n])
            np.testing.assert_array_equal(rows[n], row)
            force, speed = robot.measure(row.astype(np.float64), load[n])
            lost = not np.isfinite(row).all()
            own = values[n]
            wanted.append(robot.decides(own["surprise"], own["raw_surprise"], own["excuse"], lost))
            robot.record(row, executed[n])
            kept = records[n]
            np.testing.assert_allclose(kept["contact_force"], force, rtol=1e-6)
            np.testing.assert_allclose(kept["hand_speed"], speed, rtol=1e-6)
            np.testing.assert_allclose(kept["pressed_impulse"], robot.impulse, rtol=1e-6)
            np.testing.assert_allclose(kept["leaning_time"], robot.leaning, atol=1e-6)
            assert kept["presses"] == robot.presses
            assert kept["lost"] == lost
            assert kept["event"] == robot.event
            assert kept["low_surprise_rows"] == robot.calm
            assert kept["policy_rows"] == robot.policy_rows
            assert kept["rows_since_return"] == robot.since
            assert kept["largest_surprise"] == robot.largest
            np.testing.assert_allclose(motion.usual_torque[n], robot.usual, rtol=1e-6)
            np.testing.assert_allclose(motion.path[n, PATH - len(robot.path) :], robot.path)
            np.testing.assert_array_equal(recent.last(n, 1)[0], row)
        assert records["must_decide"].tolist() == wanted
        assert count == sum(wanted)
        decided += count
        records["must_decide"] = False
    assert 100 < decided < 1500


def healthy_rows(lift, steps):
    """(T, D) of an arm that moves."""
    lift.reset(seed=0)
    rng = np.random.default_rng(0)
    action = np.zeros(7, np.float32)
    rows = []
    for _ in range(steps):
        action[:3] = np.clip(action[:3] + rng.normal(0, 0.1, 3), -0.4, 0.4)
        rows.append(lift.step(action)[-1]["stream"].copy())
    return np.array(rows)


@pytest.fixture
def _never():
    register_alarm_term("never", lambda robots: np.zeros(len(robots.records), bool))
    yield
    del ALARM_TERMS["never"]


def judged_by(rows, memory, spec):
    facts = RobotFacts.unknown(spec)
    guard = Guard(facts, memory, GuardOptions("monitor", contact_limits=None))
    guard.begin()
    nothing = np.zeros((1, len(spec.motor)), np.float32)
    reports = [guard.judge(SensedRows(row[None]), nothing) for row in rows]
    return guard, reports


@pytest.mark.floats
def test_one_call_gives_what_the_steps_give_one_by_one(lift, request):
    spec = lift.unwrapped.stream_spec
    memory = NeuralASM.pretrained("panda")
    rows = healthy_rows(lift, 80)
    rows[30:34, 3] += 0.3  # an encoder that errs
    rows[50, 10] = np.nan
    at_once, reports = judged_by(rows, memory, spec)
    request.getfixturevalue("_never")
    in_steps, others = judged_by(rows, memory, spec)
    assert not at_once.terms.of_user
    assert in_steps.terms.of_user == ("never",)
    for report, other in zip(reports, others, strict=True):
        np.testing.assert_array_equal(report.attribution, other.attribution)
        for name in report.robots.dtype.names:
            np.testing.assert_array_equal(report.robots[name], other.robots[name], name)
        assert report.lost == other.lost
        assert report.failures == other.failures
    assert any(report.robots["alarm"][0] for report in reports)
    assert any(report.lost for report in reports)
