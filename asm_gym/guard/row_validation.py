"""The rows of n robots as the monitor is to see them: compared with the hand, completed where a sense has failed."""

from __future__ import annotations

import logging
import warnings
from collections.abc import Mapping
from itertools import compress
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from asm_gym.compilation import compiled
from asm_gym.guard.hand_check import Contradiction, HandChecks
from asm_gym.guard.hand_comparison import compare_hands_of
from asm_gym.guard.recent_rows import RecentRows, leave_out_stale, make_room
from asm_gym.guard.repair import Repair
from asm_gym.guard.robot_facts import NOTHING, RobotFacts
from asm_gym.guard.robot_table import Floats32, Mask, RobotTable
from asm_gym.memory.completion import Completion
from asm_gym.spec import StreamSpec

LOG = logging.getLogger("asm_gym.safety")


class ValidatedRows(NamedTuple):
    """The next row of each robot, as the monitor is to see it; mappings hold the robots with something to say."""

    rows: Floats32  # (n, D)
    lost: Mapping[int, tuple[str, ...]] = NOTHING  # the numbers that were not finite
    contradictions: Mapping[int, Contradiction] = NOTHING  # of hand and joints
    failures: Mapping[int, str] = NOTHING  # what can no longer be relied on


class RowValidator:
    """Validates the rows of n robots, and keeps the last ones.

    Args:
        facts: what is known of the robots.
        table: their records.
        completion: of the memory that watches; None where nothing completes senses.
        kept: how many rows are kept of each.

    Attributes:
        repairs: of the robots of which something is completed, or was a moment ago.
        hands: compares each hand with its joints.
        recent: the last rows.
    """

    def __init__(
        self,
        facts: RobotFacts,
        table: RobotTable,
        completion: Completion | None,
        kept: int,
    ) -> None:
        self._spec: StreamSpec = table.spec
        self._table = table
        self._observed = facts.observed
        if completion is not None and facts.observed is None:
            completion = None
            # Completing what the monitor sees would hide a fault that the policy goes on to see.
            reason = facts.refused.get(
                "complete", "it is not known where they stand in the observation"
            )
            warnings.warn(
                "a faulty sensor cannot be estimated from the others, so the robot holds: "
                f"{reason}",
                stacklevel=5,
            )
        self._completion = completion
        self.hands = HandChecks(facts.count, facts.chains, self._spec)
        self.recent = RecentRows(facts.count, self._spec, kept)
        self.repairs: dict[int, Repair] = {}

    def begin(self, which: Mask) -> None:
        """Begin new episodes of the robots of ``which`` (n,)."""
        self.recent.begin(which)
        self.hands.begin(which)
        self.repairs = {robot: repair for robot, repair in self.repairs.items() if not which[robot]}

    def validate(self, rows: Floats32) -> ValidatedRows:
        """Return the next rows (n, D), which are written to, as the monitor is to see them."""
        unusual = validate_rows(
            self._table.records, rows, self.recent.arrays, self.hands.geometry, self.hands.state
        )
        if unusual or self.repairs:
            return self.repair(rows)
        return ValidatedRows(rows)

    def repair(self, rows: Floats32) -> ValidatedRows:
        """Return rows (n, D) that ``validate_rows`` has looked at, with what is missing or at fault completed."""
        records = self._table.records
        for hand in self.hands.arms:
            hand.close_cases()
        lost: dict[int, tuple[str, ...]] = {}
        contradictions: dict[int, Contradiction] = {}
        failures: dict[int, str] = {}
        validated = rows.copy()
        unusual = records["lost"] | records["contradicts"]
        unusual[list(self.repairs)] = True
        for robot in np.flatnonzero(unusual & records["active"]).tolist():
            record = records[robot]
            if record["lost"]:
                missing = ~np.isfinite(rows[robot])
                lost[robot] = tuple(compress(self._spec.labels, missing))
                if self._completion is not None and robot not in self.repairs:
                    self.repairs[robot] = self._new_repair(robot, rows_before=1)
            if record["contradicts"]:
                contradiction = self.hands.contradiction(robot, self._missing(robot))
                record["contradicts"] = contradiction is not None
                if contradiction is not None:
                    contradictions[robot] = contradiction
            repair = self.repairs.get(robot)
            if repair is None:
                continue
            validated[robot] = _repaired(repair, rows[robot])
            self.recent.replace_last(robot, validated[robot])
            if not repair.trusted:
                names = ", ".join(repair.names)
                failures[robot] = f"completion: too much is missing, or for too long: {names}"
        return ValidatedRows(validated, lost, contradictions, failures)

    def last(self, robot: int) -> Floats32:
        """Return (T, D) the last rows of a robot in this episode, the newest last."""
        return self.recent.last(robot, int(self._table.records["episode_rows"][robot]))

    def suspect(self, robot: int, columns: NDArray[np.intp]) -> bool:
        """Complete the sensors of ``columns`` from a robot's last row on; return whether that leaves any to go by."""
        if self._completion is None:
            return False
        repair = self.repairs.get(robot) or self._new_repair(robot, rows_before=0)
        row = repair.suspect(columns)
        if row is None:
            return False
        self.repairs[robot] = repair
        self.recent.replace_last(robot, row)
        return True

    def accounted_for(self, robot: int) -> Mask:
        """Return (D,) what is completed, or right by the hand and its joints: it explains no surprise."""
        explained = self._missing(robot)
        for hand in self.hands.arms:
            explained = explained | hand.consistent(robot)
        return explained

    def completed_names(self, robot: int) -> tuple[str, ...] | None:
        """Return the sensors of a robot that are completed; None where senses cannot be completed."""
        if self._completion is None:
            return None
        if robot not in self.repairs:
            return ()
        return self.repairs[robot].names

    def drop_repairs(self) -> None:
        """Forget the repairs that are over."""
        self.repairs = {
            robot: repair for robot, repair in self.repairs.items() if not repair.finished
        }

    def _missing(self, robot: int) -> Mask:
        """Return (D,) what is completed of a robot."""
        if robot not in self.repairs:
            return np.zeros(self._spec.size, bool)
        return self.repairs[robot].missing

    def _new_repair(self, robot: int, rows_before: int) -> Repair:
        """Return a repair of a robot from its newest row on, or from the next where that is ``rows_before`` it."""
        assert self._completion is not None
        assert self._observed is not None
        last = self.last(robot)
        before = None
        if len(last) > rows_before:
            before = last[-1 - rows_before].astype(np.float64)
        return Repair(self._completion, robot, before, self._observed, self.hands.arms)


def _repaired(repair: Repair, row: Floats32) -> Floats32:
    """Return a row (D,) with what is missing or at fault completed."""
    known = repair.names
    try:
        row = repair.next(row)
    except Exception as error:
        # Nobody knows what the row should say: what is not finite is an alarm without explanation.
        warnings.warn(f"completion: {error!r}; the row counts as lost", stacklevel=2)
        return np.full_like(row, np.nan)
    if silent := ", ".join(name for name in repair.names if name not in known):
        LOG.info("complete: %s says nothing any more", silent)
    return row


@compiled
def validate_rows(
    robots: Any,
    rows: Any,
    recent: Any,
    hand_geometry: Any,
    hand_state: Any,
) -> bool:
    """Keep rows (n, D), with NaN for stale senses, and mark the robots whose rows are not whole or not consistent.

    Args:
        robots: (n,) records of ``ROBOT``.
        recent: ``RowArrays``.
        hand_geometry, hand_state: (n, arms) of ``HandChecks``.

    Returns:
        Whether there is any such robot.
    """
    end = make_room(recent)
    unusual = False
    for n in range(len(robots)):
        robot = robots[n]
        row = rows[n]
        leave_out_stale(row, recent, n)
        recent.rows[n, end] = row
        contradicts = compare_hands_of(row, hand_geometry[n], hand_state[n])
        robot.episode_rows += 1
        robot.lost = robot.active and not np.isfinite(row).all()
        robot.contradicts = robot.active and contradicts
        unusual = unusual or robot.lost or robot.contradicts
    return unusual
