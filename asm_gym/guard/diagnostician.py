"""Names the cause of an alarm, and says what is to be done about it."""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from asm_gym.detection.channel_columns import handled_columns
from asm_gym.detection.contact_limits import FREE_FORCE
from asm_gym.detection.hand_speed import Floats
from asm_gym.guard.contact_estimator import ContactEstimator
from asm_gym.guard.responses import GOING_ON, LASTING, NO_RESPONSE, PRESSING, SLOW, Response
from asm_gym.guard.robot_facts import NO_COLUMNS, columns_ending
from asm_gym.guard.robot_table import POLICY, Floats32, Mask
from asm_gym.guard.row_evidence import RowEvidence
from asm_gym.monitors.diagnosis import (
    DIAGNOSED_ROWS,
    FAMILIES,
    Cause,
    Diagnosis,
    as_info,
    updated_belief,
)
from asm_gym.spec import StreamSpec

CALM_S = 1.0  # after so long without an alarm, what comes next has a cause of its own [s]
SURE = 0.5  # a family that is less probable is unknown
MOST_OF_OBJECT = 0.8  # share of the surprise from which on it is that of a handled object

NO_CAUSE = Cause(
    family="unknown",
    part="",
    probability=0.0,
    probabilities={},
    columns=NO_COLUMNS,
)


@dataclass
class Incident:
    """What has been found out about one robot since it was calm."""

    rows: int = 0  # of it
    first_row: dict[str, int] = field(default_factory=dict)  # in which a case was first the cause
    touched: bool = False  # the last alarm was answered as a contact, or looked like one
    calm_rows: int = 0  # rows without an alarm
    # Mean probability of each family.
    belief: Floats = field(default_factory=lambda: np.zeros(len(FAMILIES)))
    diagnoses: int = 0
    newest: dict[str, Cause] = field(default_factory=dict)  # the newest diagnosis of each family

    def believe(self, cause: Cause) -> Cause:
        """Return the cause by all diagnoses, the newest of which counts a tenth at least."""
        self.diagnoses += 1
        probabilities = np.array([cause.probabilities[name] for name in FAMILIES])
        self.belief = updated_belief(self.belief, probabilities, self.diagnoses)
        self.newest[cause.family] = cause
        family = FAMILIES[int(self.belief.argmax())]
        return self.newest.get(family, cause)._replace(
            family=family,
            probability=float(self.belief.max()),
            probabilities=dict(zip(FAMILIES, self.belief.tolist(), strict=True)),
        )


class Prescription(NamedTuple):
    """What is to be done about an alarm."""

    response: Response
    columns: NDArray[np.intp] = NO_COLUMNS  # (k,) of the stream to complete


class Diagnostician:
    """Finds the causes of alarms of n robots, and the responses to them.

    Args:
        spec: of their streams.
        diagnosis: of the monitor; without one every cause is unknown.
        responses: what is done about which cause, as ``responses_from`` gives it.
        responds: the responses are followed; else causes are only named.

    Attributes:
        incidents: of the robots that have not been calm for long enough.
        rows: how many rows it looks back.
    """

    def __init__(
        self,
        spec: StreamSpec,
        diagnosis: Diagnosis | None,
        responses: Mapping[str, str],
        responds: bool,
    ) -> None:
        self._dt = spec.dt
        self._diagnosis = diagnosis
        self._responses = responses
        self._responds = responds
        self._handled = handled_columns(spec)
        # By which a joint is found blocked.
        self._blocked_rows = 1 + round(LASTING["actuator"] / spec.dt)
        self._contact = None
        if diagnosis is not None and columns_ending(spec.channels, "external_torque").size:
            self._contact = ContactEstimator(diagnosis.completion)
        self.incidents: dict[int, Incident] = {}
        self.rows = DIAGNOSED_ROWS + self._blocked_rows

    def begin(self, which: Mask) -> None:
        """Begin new episodes of the robots of ``which`` (n,)."""
        for robot in np.flatnonzero(which).tolist():
            self.close(robot)

    def close(self, robot: int) -> None:
        """Close the incident of a robot: what comes next has a cause of its own."""
        self.incidents.pop(robot, None)

    def watch(self, evidence: RowEvidence) -> Response:
        """Return what is known of a robot's last row, which is no alarm."""
        incident = self.incidents.get(evidence.index)
        if incident is None:
            return NO_RESPONSE
        touched = self._touched(incident, evidence.rows)
        incident.rows += 1
        incident.calm_rows += 1
        policy_acts = evidence.robot.state == POLICY
        if incident.calm_rows > CALM_S / self._dt and (incident.first_row or policy_acts):
            self.close(evidence.index)
            return NO_RESPONSE
        return NO_RESPONSE._replace(touched=touched)

    def prescribe(self, evidence: RowEvidence) -> Prescription:
        """Return what is to be done about an alarm."""
        if evidence.only_lost:
            return Prescription(_complete_missing(evidence))
        if self._only_of_object(evidence):
            return self._without_object()
        incident = self.incidents.setdefault(evidence.index, Incident())
        if evidence.robot.knocked and not evidence.certain:
            return Prescription(self._brake(incident, evidence))

        touched = self._touched(incident, evidence.rows)
        incident.rows += 1
        incident.calm_rows = 0
        presses = bool(evidence.robot.presses)
        cause = self._find_cause(incident, evidence)
        family = "unknown"
        if cause.probability >= SURE:
            family = cause.family
        incident.touched = presses or cause.family == "contact"
        incident.first_row.setdefault(PRESSING if presses else family, incident.rows)

        case, name = self._case_and_response(incident, family, cause, evidence)
        description = as_info(cause)
        if family != cause.family:
            description |= {"family": family, "part": ""}
        response = Response(name, description, touched, case)
        if not self._responds:
            response = response._replace(name="", case="")
        if name != "complete":
            return Prescription(response)
        return Prescription(response, cause.columns)

    def _only_of_object(self, evidence: RowEvidence) -> bool:
        """Return whether a row surprises by a handled object, and nothing else is the matter."""
        is_more = evidence.certain or evidence.fast or bool(evidence.robot.knocked)
        if not self._handled.size or is_more:
            return False
        shares = np.nan_to_num(evidence.attribution, posinf=0.0)
        return bool(shares[self._handled].sum() > MOST_OF_OBJECT * shares.sum())

    def _without_object(self) -> Prescription:
        """Return what is done about an object, or its tracker: it endangers nobody, and the other senses judge on."""
        cause = _certain("object", "handled object")
        if not self._responds:
            return Prescription(Response("", cause))
        return Prescription(Response("complete", cause, case="object"), self._handled)

    def instead_of_completing(self, response: Response) -> Response:
        """Return what is done where the sensors at fault cannot be completed."""
        if response.case == "object":
            return response._replace(name="go on")
        return response._replace(name=self._responses["unknown"])

    def _brake(self, incident: Incident, evidence: RowEvidence) -> Response:
        """Return the response to a knock that presses no more: the arm is braked until the contact has gone."""
        incident.touched = True
        incident.calm_rows = 0
        return Response(
            name="hold" if self._responds else "",
            cause=_certain("contact"),
            touched=self._touched(incident, evidence.rows),
            case="contact",
        )

    def _case_and_response(
        self,
        incident: Incident,
        family: str,
        cause: Cause,
        evidence: RowEvidence,
    ) -> tuple[str, str]:
        """Return the row of the table of responses that holds, and the response."""
        case = PRESSING if evidence.robot.presses else family
        if case in (PRESSING, "contact") and self._lasts(incident, case):
            case = f"lasting {case}"
        name = self._responses[case]
        if name == "go on" and self._blocked(family, cause, evidence.rows):
            # Whatever the policy goes on with, it does not move the arm, and presses.
            case = "lasting actuator" if family == "actuator" else "lasting contact"
            name = self._responses[case]
        if name in GOING_ON and not _may_go_on(name, cause, evidence):
            name = "hold"
            if case != "unknown" and self._responses["unknown"] not in GOING_ON:
                name = self._responses["unknown"]
        return case, name

    def _find_cause(self, incident: Incident, evidence: RowEvidence) -> Cause:
        """Return the cause; a contradiction names a sensor beyond doubt, though perhaps not which."""
        failed = bool(evidence.robot.failed)
        if evidence.contradiction is not None and not failed:
            return Cause(
                family="sensor",
                part=evidence.contradiction.part,
                probability=1.0,
                probabilities=dict.fromkeys(FAMILIES, 0.0) | {"sensor": 1.0},
                columns=evidence.contradiction.columns,
            )
        rows = evidence.rows[-1 - DIAGNOSED_ROWS :]
        if failed or self._diagnosis is None or not np.isfinite(rows).all():
            return NO_CAUSE
        try:
            cause = self._diagnosis(rows, evidence.attribution, evidence.accounted_for)
        except Exception as error:
            # Whatever goes wrong here, an alarm is answered: by what is done about the unknown.
            warnings.warn(f"diagnosis: {error!r}; the cause counts as unknown", stacklevel=2)
            return NO_CAUSE
        return incident.believe(cause)

    def _touched(self, incident: Incident, rows: Floats32) -> bool | None:
        """Return whether what touched the body still does; None where nobody knows."""
        if not self._responds or not incident.touched or self._contact is None or len(rows) < 2:
            return None
        if not self._contact.presses(rows):
            return False
        lasts = self._lasts(incident, "contact") or self._lasts(incident, PRESSING)
        return None if lasts else True

    def _blocked(self, family: str, cause: Cause, rows: Floats32) -> bool:
        """Return whether the joint at fault, or else the arm, is pressed and still, for as long as what lasts."""
        if self._contact is None or len(rows) < self._blocked_rows:
            return False
        joint = ""
        if family == "actuator":
            joint = cause.part
        return self._contact.blocked(rows[-self._blocked_rows :], joint)

    def _lasts(self, incident: Incident, case: str) -> bool:
        """Return whether a case has been the cause for so long that it lasts."""
        first = incident.first_row.get(case, incident.rows)
        return incident.rows - first >= LASTING["contact"] / self._dt


def _certain(family: str, part: str = "") -> dict[str, Any]:
    """Return what ``info`` says of a cause beyond doubt."""
    return as_info(None) | {"family": family, "part": part, "probability": 1.0}


def _complete_missing(evidence: RowEvidence) -> Response:
    """Return the response to missing numbers, which are completed where that is possible."""
    if evidence.completed is None:
        return NO_RESPONSE
    return Response("complete", _certain("sensor", ", ".join(evidence.completed)), case="sensor")


def _may_go_on(name: str, cause: Cause, evidence: RowEvidence) -> bool:
    """Return whether the policy may go on in alarm."""
    if evidence.fast:
        return False
    if name == "complete":  # what is left judges on, and what is completed is bounded by itself
        return True
    if not (evidence.may_go_on and evidence.feels):
        return False
    if name != SLOW and cause.probability < SURE:
        return False
    return not evidence.robot.contact_force > FREE_FORCE
