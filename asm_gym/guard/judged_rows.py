"""Judge the rows of n robots: healthy ones in one compiled call, the others in steps.

    rows (n, D), loads (n, 2 + F)
       └► validate_rows ► observe_rows ► measure_contacts ► apply_alarm_rule ► record_motion
                └► a row is lost, or contradicts itself: STOPPED, and Python goes on by the same functions

``apply_alarm_rule`` counts the rows about which there is nothing to decide, and marks the others.
"""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import partial
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from asm_gym.blas import one_thread_for
from asm_gym.compilation import bind, compiled, inner
from asm_gym.detection.alarm_rule import JUDGED, KNOCK_EVENT, benign_event, over_threshold
from asm_gym.guard.alarm_terms import AlarmTerms
from asm_gym.guard.arbiter import MOSTLY_AFTER
from asm_gym.guard.contact_state import ContactColumns, contact_columns, measure_contacts
from asm_gym.guard.hand_check import Contradiction
from asm_gym.guard.observer import Observer, merged_failures
from asm_gym.guard.recent_rows import RowArrays
from asm_gym.guard.reflexes import MotionArrays, record_motion
from asm_gym.guard.robot_facts import RobotFacts
from asm_gym.guard.robot_table import POLICY, REFLEX, Floats32, Mask, RobotTable
from asm_gym.guard.row_validation import RowValidator, ValidatedRows, validate_rows
from asm_gym.guard.step_info import Outcome
from asm_gym.monitors import Surprise
from asm_gym.monitors.row_kernel import observe_rows

# In the place of how many robots there are to decide about: the rows are to be repaired first.
STOPPED = -1


@dataclass(slots=True)
class JudgedRow:
    """A row of each of n robots, from what was sensed to what was decided; mappings are by robot."""

    robots: NDArray[Any]
    """(n,) records of ``ROBOT``."""
    rows: Floats32
    """(n, D) as they were sensed, with NaN for stale senses; once judged, as they are believed."""
    load: NDArray[np.float64]
    """(n, 2 + F), see ``no_load``."""
    executed: Floats32
    """(n, A) in the step of the row."""
    ends_step: bool
    attribution: NDArray[np.float64]
    """(n, D)."""
    eventful: bool = False
    """There is something to say of the row: a part failed, or there is something to decide."""
    failures: Mapping[int, str] = field(default_factory=dict)
    """What failed, which is an alarm."""
    harmless_failures: Mapping[int, str] = field(default_factory=dict)
    """What failed without a consequence."""
    lost: Mapping[int, tuple[str, ...]] = field(default_factory=dict)
    """The numbers that are not finite."""
    contradictions: Mapping[int, Contradiction] = field(default_factory=dict)
    terms: Mapping[str, Mask] = field(default_factory=dict)
    """(n,) where each alarm term holds, by its name."""
    outcomes: dict[int, Outcome] = field(default_factory=dict)

    def fail(self, failures: Mapping[int, str]) -> None:
        """Note what failed in the row: the surprise of those robots, where they are active, is infinite."""
        active = self.robots["active"]
        failures = {robot: failure for robot, failure in failures.items() if active[robot]}
        if failures:
            self.failures = merged_failures(self.failures, failures)
            self.robots["failed"][list(failures)] = True
            self.eventful = True


class GuardArrays(NamedTuple):
    """What compiled code keeps of n robots, by the parts of the guard."""

    robots: NDArray[Any]  # (n,) of ``ROBOT``
    recent: RowArrays
    hand_geometry: NDArray[Any]  # (n, arms) of ``HAND_GEOMETRY``
    hand_state: NDArray[Any]  # (n, arms) of ``HAND_STATE``
    contact_columns: ContactColumns
    motion: MotionArrays
    judged: NDArray[Any]  # (n,) of ``JUDGED``, written with each row
    dt: float  # period of the rows [s]
    most_impulse: float  # that an arm may press with in an episode [N s]


class RowJudge:
    """Judges rows of n robots, and marks the robots about which there is something to decide.

    Args:
        facts: what is known of the robots.
        table: their records.
        validator: completes senses and compares hands with joints.
        observer: asks the monitor for surprise.
        terms: alarm terms, of which the user's own are asked at every row.
        motion: what reflexes need of rows and actions.
        most_impulse: that an arm may press with in an episode [N s].

    Attributes:
        surprises: (n,) records of ``JUDGED`` of the newest rows.
    """

    def __init__(
        self,
        facts: RobotFacts,
        table: RobotTable,
        validator: RowValidator,
        observer: Observer,
        terms: AlarmTerms,
        motion: MotionArrays,
        most_impulse: float,
    ) -> None:
        self._table = table
        self._validator = validator
        self._observer = observer
        self._terms = terms
        self.surprises: NDArray[Any] = np.zeros(facts.count, JUDGED)
        self._arrays = GuardArrays(
            robots=table.records,
            recent=validator.recent.arrays,
            hand_geometry=validator.hands.geometry,
            hand_state=validator.hands.state,
            contact_columns=contact_columns(facts.felt_channels, table.spec),
            motion=motion,
            judged=self.surprises,
            dt=table.spec.dt,
            most_impulse=float(most_impulse),
        )
        self._bound = bind(self._arrays)

    def judge(self, row: JudgedRow) -> int:
        """Judge a row; return how many robots there are to decide about."""
        memory = None
        if not (self._validator.repairs or self._terms.of_user):
            memory = self._observer.compiled_step()
        if memory is None:
            return self._judge_in_steps(row, self._validator.validate(row.rows))

        to_decide = self._judge_in_one_call(row, memory)
        if to_decide == STOPPED:
            return self._judge_in_steps(row, self._validator.repair(row.rows))
        return to_decide

    def _judge_in_one_call(self, row: JudgedRow, memory: Any) -> int:
        """Judge a row by one compiled call; return how many robots there are to decide about, or ``STOPPED``."""
        start = time.perf_counter()
        with one_thread_for(len(row.rows)):
            to_decide = judge_rows(
                self._bound, memory, row.rows, row.load, row.executed, row.attribution
            )
        if to_decide != STOPPED:
            self._observer.stepped(memory, time.perf_counter() - start)
        return to_decide

    def _judge_in_steps(self, row: JudgedRow, validated: ValidatedRows) -> int:
        """Judge a validated row by the functions that ``judge_rows`` is made of.

        Python takes part: a monitor that is not compiled, a sense that is completed, or a user's alarm term.

        Returns:
            How many robots there are to decide about.
        """
        arrays = self._arrays
        robots = row.robots
        repairs = self._validator.repairs
        row.rows = validated.rows
        row.lost = validated.lost
        row.contradictions = validated.contradictions
        row.eventful = row.eventful or bool(row.lost or repairs)
        row.fail(validated.failures)
        row.fail(self._observer.observe(row.rows, self.surprises, row.attribution))
        self._leave_out_repaired(row)
        measure_contacts(
            robots, row.rows, row.load, arrays.contact_columns, arrays.dt, arrays.most_impulse
        )
        if self._terms.of_user:
            failure = self._terms.ask_users(self._table)
            robots["must_decide"] |= self._terms.any_of_user()
            if failure:
                row.fail(dict.fromkeys(range(len(robots)), failure))
        robots["must_decide"][list(repairs)] = True
        to_decide = apply_alarm_rule(robots, self.surprises, row.attribution)
        record_motion(robots, row.rows, row.executed, arrays.motion)
        return int(to_decide)

    def _leave_out_repaired(self, row: JudgedRow) -> None:
        """Leave out of the surprise what is completed, or changes from what was."""
        for robot, repair in self._validator.repairs.items():
            own = slice(robot, robot + 1)
            judged = self.surprises[own]
            surprise = Surprise(
                judged["surprise"], row.attribution[own], raw=judged["raw_surprise"]
            )
            surprise = surprise.without(repair.unjudged)
            if repair.settling and robot not in row.failures:
                surprise = surprise.silenced(np.ones(1, bool))
            judged["surprise"] = surprise.value
            judged["raw_surprise"] = surprise.raw
            row.attribution[own] = surprise.attribution


@partial(compiled, calls=("memory", "detection", "monitors", "."))
def judge_rows(
    guard: Any, memory: Any, rows: Any, load: Any, executed: Any, attribution: Any
) -> int:
    """Judge rows by a memory whose row is compiled, and count those about which there is nothing to decide.

    Args:
        guard: a ``Bound`` of ``GuardArrays``.
        memory: a ``Bound`` of ``RowKernel``.
        rows: (n, D) float32, written to where senses are stale.
        load: (n, 2 + F), see ``no_load``.
        executed: (n, A) in the step of the rows.
        attribution: (n, D), written.

    Returns:
        How many robots there are to decide about, or ``STOPPED``.
    """
    (arrays,) = guard.parts
    robots = arrays.robots
    if validate_rows(robots, rows, arrays.recent, arrays.hand_geometry, arrays.hand_state):
        return STOPPED
    exact = np.empty(rows.shape)
    for n in range(len(rows)):
        for i in range(rows.shape[1]):
            exact[n, i] = rows[n, i]
    observe_rows(memory, exact, arrays.judged, attribution)
    measure_contacts(robots, rows, load, arrays.contact_columns, arrays.dt, arrays.most_impulse)
    to_decide = apply_alarm_rule(robots, arrays.judged, attribution)
    record_motion(robots, rows, executed, arrays.motion)
    return to_decide


@compiled
def apply_alarm_rule(robots: Any, judged: Any, attribution: Any) -> int:
    """Compare surprise with its threshold, count the quiet rows, and mark the others.

    Args:
        robots: (n,) records of ``ROBOT``.
        judged: (n,) records of ``JUDGED``.
        attribution: (n, D).

    Returns:
        How many robots are marked by ``must_decide``.
    """
    to_decide = 0
    for n in range(len(robots)):
        robot = robots[n]
        take_up_surprise(robot, judged[n], attribution[n])
        robot.held = robot.state == REFLEX
        robot.overridden = robot.held or robot.refused
        robot.over = over_threshold(robot.surprise, robot.threshold)
        robot.event = benign_event(
            robot.raw_surprise, robot.surprise, robot.excuse, robot.threshold
        )
        robot.knocked = robot.event == KNOCK_EVENT
        robot.alarm = False
        robot.must_decide = robot.active and (robot.must_decide or is_eventful(robot))
        if robot.must_decide:
            to_decide += 1
        elif robot.active:
            count_quiet_row(robot)
    return to_decide


@inner
def is_eventful(robot: Any) -> bool:
    """Return whether there is something to decide about a judged row."""
    judged = robot.presses or robot.over or robot.knocked
    sensed = robot.lost or robot.contradicts or robot.refused
    reported = robot.policy_rows == MOSTLY_AFTER - 1
    return judged or sensed or reported or robot.state != POLICY


@inner
def take_up_surprise(robot: Any, judged: Any, attribution: Any) -> None:
    """Take up what counts of the surprise at a row: it is infinite where something failed, and 0 where none counts."""
    robot.surprise = judged.surprise
    robot.raw_surprise = judged.raw_surprise
    robot.excuse = judged.excuse
    counted = robot.pressed_impulse + robot.leaning_time + robot.threshold
    if robot.failed or not judged.surprise > -np.inf or not np.isfinite(counted):  # NaN too
        robot.failed = True
        robot.surprise = np.inf
    if not robot.active:
        robot.surprise = 0.0
        robot.raw_surprise = 0.0
    if robot.failed or not robot.active:
        for i in range(len(attribution)):
            attribution[i] = 0.0


@inner
def count_quiet_row(robot: Any) -> None:
    """Count a row of the policy about which there is nothing to decide."""
    robot.low_surprise_rows += 1
    robot.contact_free_rows = 0
    robot.rows_since_return += 1
    robot.policy_rows += 1
    robot.largest_surprise = max(robot.largest_surprise, robot.surprise)
