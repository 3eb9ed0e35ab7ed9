"""Decides about the row of one robot: evidence ► prescribe ► arbitrate ► outcome."""

from __future__ import annotations

import warnings
from dataclasses import dataclass

import numpy as np

from asm_gym.detection.alarm_rule import FAULT_EVENT, KNOCK_EVENT
from asm_gym.guard.alarm_terms import BY_CAUSE, CONTACT, SURPRISE, AlarmTerms
from asm_gym.guard.arbiter import Arbiter
from asm_gym.guard.diagnostician import Diagnostician
from asm_gym.guard.judged_rows import JudgedRow
from asm_gym.guard.responses import Response, unexplained
from asm_gym.guard.robot_table import RobotTable
from asm_gym.guard.row_evidence import RowEvidence
from asm_gym.guard.row_validation import RowValidator
from asm_gym.guard.step_info import Outcome


@dataclass(frozen=True, eq=False)
class RowDecider:
    """Decides about rows with something to decide.

    Attributes:
        table: the records of the robots.
        terms: alarm terms, and how often each held.
        validator: holds the last rows, and completes sensors at fault.
        diagnostician: finds causes.
        arbiter: says who acts next.
        graded: severity and cause choose the response.
    """

    table: RobotTable
    terms: AlarmTerms
    validator: RowValidator
    diagnostician: Diagnostician
    arbiter: Arbiter
    graded: bool

    def decide(self, index: int, row: JudgedRow) -> Outcome:
        """Return what is done about the row of one robot."""
        evidence = self._evidence(index, row)
        robot = evidence.robot
        response = self._respond(evidence)
        if not robot.overridden and np.isfinite(robot.surprise):
            warning = self.arbiter.count_policy_row(evidence)
            if warning:
                warnings.warn(warning, stacklevel=5)

        decision = self.arbiter.decide(evidence, response)
        self.terms.count(evidence.terms)
        if not evidence.alarm:
            return Outcome(response=response, decision=decision)
        robot.alarm = True
        robot.event = FAULT_EVENT
        only_felt = set(evidence.terms) <= {CONTACT, SURPRISE}
        if only_felt and not robot.over:
            # A contact and no fault: surprise is under its threshold, or a knock excuses it.
            robot.event = KNOCK_EVENT
        return Outcome(evidence.terms, response, decision)

    def _evidence(self, index: int, row: JudgedRow) -> RowEvidence:
        """Return what is known of the row of one robot."""
        return RowEvidence(
            index=index,
            robot=self.table.robot(index),
            rows=self.validator.last(index),
            attribution=row.attribution[index],
            accounted_for=self.validator.accounted_for(index),
            terms=tuple(name for name, mask in row.terms.items() if mask[index]),
            contradiction=row.contradictions.get(index),
            completed=self.validator.completed_names(index),
            may_go_on=self.arbiter.may_go_on(index),
        )

    def _respond(self, evidence: RowEvidence) -> Response:
        """Return what is to be done about a row, once the sensors at fault are completed."""
        if not evidence.alarm:
            return self.diagnostician.watch(evidence)
        reason = evidence.terms[0]
        response_of_term = self.terms.terms[reason].response
        if response_of_term != BY_CAUSE and self.graded:
            return unexplained(response_of_term, reason)

        response, blamed_columns = self.diagnostician.prescribe(evidence)
        completes = response.name == "complete"
        blames_sensors = blamed_columns.size > 0 or (completes and not evidence.only_lost)
        if not blames_sensors:  # numbers that are only missing are completed already
            return response

        is_completed = self.validator.suspect(evidence.index, blamed_columns)
        if is_completed:
            self.diagnostician.close(evidence.index)  # it begins anew, on the completed rows
        elif completes:
            return self.diagnostician.instead_of_completing(response)
        return response
