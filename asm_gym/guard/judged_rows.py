"""A healthy row in one compiled call, from what was sensed to what is decided.

    rows (n, D), loads (n, 2 + F)
       └► validate_rows ► observe_rows ► measure_contacts ► apply_alarm_rule ► record_motion
                └► a row is lost, or contradicts itself: STOPPED, and Python goes on by the same functions

``apply_alarm_rule`` counts the rows about which there is nothing to decide, and marks the others.
"""

from __future__ import annotations

from functools import partial
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from asm_gym.compilation import compiled, inner
from asm_gym.detection.alarm_rule import KNOCK_EVENT, benign_event, over_threshold
from asm_gym.guard.arbiter import MOSTLY_AFTER
from asm_gym.guard.contact_state import ContactColumns, measure_contacts
from asm_gym.guard.recent_rows import RowArrays
from asm_gym.guard.reflexes import MotionArrays, record_motion
from asm_gym.guard.robot_table import POLICY, REFLEX
from asm_gym.guard.row_validation import validate_rows
from asm_gym.monitors.row_kernel import observe_rows

# in the place of how many robots there are to decide about: the rows are to be repaired first
STOPPED = -1


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
    robot.calm_rows += 1
    robot.free_rows = 0
    robot.rows_since_return += 1
    robot.policy_rows += 1
    robot.largest_surprise = max(robot.largest_surprise, robot.surprise)
