"""Names the cause of an alarm, and says what is to be done about it."""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from asm_gym.guard.hand import Contradiction
from asm_gym.guard.responses import GOING_ON, LASTING, NO_RESPONSE, PRESSING, Response
from asm_gym.guard.robot_facts import NO_COLUMNS, columns_ending
from asm_gym.guard.severity import FAST, FREE_FORCE
from asm_gym.memory.completion import Completion
from asm_gym.monitors.diagnosis import FAMILIES, WINDOW, Cause, Diagnosis, as_info, averaged
from asm_gym.spec import StreamSpec

PRESSED_BY = 2.5  # something presses where an external torque is so many standard deviations of its completion off
STILL = 0.02  # a joint that turns by no more than this does not [rad/s]
CALM_S = 1.0  # after so long without an alarm, what comes next has a cause of its own [s]
SURE = 0.5  # a family that is less probable is unknown

Floats = NDArray[np.float64]
Mask = NDArray[np.bool_]


class Alarm(NamedTuple):
    """An alarming row of one robot."""

    rows: NDArray[np.float32]  # (T, D) the last ones, the newest last
    attribution: Floats  # (D,) where the surprise is
    known: Mask  # (D,) what is completed, or right by the hand and its joints: it explains nothing
    over: bool  # surprise is over the threshold
    knocked: bool  # it is but for a knock, which excuses it
    lost: bool  # numbers are missing
    contradiction: Contradiction | None  # of hand and joints
    failed: bool  # monitor, stream or policy failed, so that nothing is known
    presses: bool  # the arm presses harder than healthy motion does
    feels: bool  # somebody would know if it pressed
    force: float  # contact force [N]
    speed: float  # of the fastest hand [m/s]
    may_go_on: bool  # the policy has not gone on in alarm for too long yet
    completed: tuple[str, ...] | None  # the sensors that are completed; None where they cannot be

    @property
    def certain(self) -> bool:
        """It is one whatever the surprise."""
        return self.contradiction is not None or self.failed or self.presses

    @property
    def only_lost(self) -> bool:
        """Nothing is wrong but missing numbers."""
        return self.lost and not (self.certain or self.over or self.knocked or self.speed > FAST)


@dataclass
class _Incident:
    """What has been found out about one robot since it was calm."""

    since: dict[str, int] = field(default_factory=dict)  # rows since a family was first the cause
    touched: bool = False  # the last alarm was answered as a contact, or looked like one
    calm: int = 0  # rows without an alarm
    belief: Floats = field(default_factory=lambda: np.zeros(len(FAMILIES)))
    diagnoses: int = 0
    latest: dict[str, Cause] = field(default_factory=dict)  # the newest diagnosis of each family

    def next(self, alarm: bool) -> None:
        """Count a row more since each cause was first found."""
        self.calm = 0 if alarm else self.calm + 1
        self.since = {family: rows + 1 for family, rows in self.since.items()}

    def believed(self, newest: Cause) -> Cause:
        """Return the cause by all diagnoses, the newest of which counts a tenth at least."""
        self.diagnoses += 1
        probabilities = np.array([newest.probabilities[name] for name in FAMILIES])
        belief = self.belief = averaged(self.belief, probabilities, self.diagnoses)
        family = FAMILIES[int(belief.argmax())]
        self.latest[newest.family] = newest
        all_of_them = dict(zip(FAMILIES, belief.tolist(), strict=True))
        found = self.latest.get(family, newest)
        return found._replace(family=family, probability=float(belief.max()), probabilities=all_of_them)


class ContactEstimator:
    """Tells what presses, by one completion of all that a contact shows in, in a stream with external torques."""

    def __init__(self, completion: Completion) -> None:
        spec = completion.spec
        self._completion, self._dt = completion, spec.dt
        # Where a contact shows: in external torques, their peaks too, and in forces and torques at the wrist.
        shows = ["external_torque" in c.name or c.group == "wrench" for c in spec.channels for _ in range(c.size)]
        self._filling = completion.filling(np.array(shows, bool))
        self._own = np.isin(self._filling.columns, columns_ending(spec.channels, "external_torque"))
        self._joints = columns_ending(spec.channels, "joint_position")

    def beyond(self, rows: NDArray[np.floating[Any]]) -> NDArray[np.float64]:
        """Return (T - 1, J) external torques of rows (T, D) but the first, beyond what is expected [deviations]."""
        expected = self._completion.complete(self._filling, self._completion.lift(rows))
        beyond = (rows[:, self._filling.columns] - expected)[1:, self._own]
        return np.asarray(beyond / self._filling.error[self._own])

    def presses(self, rows: NDArray[np.floating[Any]]) -> bool:
        """Return whether something presses in the last of the rows (T, D)."""
        return bool((np.abs(self.beyond(rows[-2:])[-1]) >= PRESSED_BY).any())

    def blocked(self, rows: NDArray[np.floating[Any]], joint: str = "") -> bool:
        """Return whether ``joint``, such as ``joint[3]``, has been pressed in most of the rows (T, D), without turning.

        Without a joint: whether any has been pressed, and none has turned; an arm that pulls at a door turns some.
        """
        pressed = np.median(np.abs(self.beyond(rows)), axis=0) > PRESSED_BY
        if len(pressed) != len(self._joints):
            return False
        still = np.ptp(rows[:, self._joints], axis=0) < STILL * self._dt * len(rows)
        if not joint:
            return bool(pressed.any() and still.all())
        labels = [self._completion.spec.labels[column].replace("joint_position", "joint") for column in self._joints]
        return bool((pressed & still)[[label == joint for label in labels]].any())


class Diagnostician:
    """Finds the causes of alarms of n robots, and the responses to them.

    Args:
        spec: of their streams.
        diagnosis: of the monitor; without one every cause is unknown.
        table: what is done about which cause, as ``responses_from`` gives it.
        asked: the table is followed; else causes are only named.
    """

    def __init__(self, spec: StreamSpec, diagnosis: Diagnosis | None, table: Mapping[str, str], asked: bool) -> None:
        self._spec, self._diagnosis, self._table, self._asked = spec, diagnosis, table, asked
        self._contact = None
        if diagnosis is not None and columns_ending(spec.channels, "external_torque").size:
            self._contact = ContactEstimator(diagnosis.completion)
        self.incidents: dict[int, _Incident] = {}  # of the robots that have not been calm for long enough
        self.rows = WINDOW + 1 + round(LASTING["actuator"] / spec.dt)  # how many rows it looks back

    def begin(self, robot: int) -> None:
        """A new episode of a robot."""
        self.incidents.pop(robot, None)

    def watch(self, robot: int, rows: NDArray[np.float32], policy_acts: bool) -> Response:
        """Return what is known of a robot's last row (T, D), which is no alarm."""
        incident = self.incidents.get(robot)
        if incident is None:
            return NO_RESPONSE
        touched = self._touched(incident, rows)
        incident.next(alarm=False)
        if incident.calm > CALM_S / self._spec.dt and (incident.since or policy_acts):
            self.begin(robot)
            return NO_RESPONSE
        return NO_RESPONSE._replace(touched=touched)

    def respond(self, robot: int, alarm: Alarm) -> tuple[Response, NDArray[np.intp]]:
        """Return what is to be done about an alarm, and the columns to complete where it is ``"complete"``."""
        if alarm.only_lost:
            missing = Response("complete", _named("sensor", ", ".join(alarm.completed or ())), None, "sensor")
            return NO_RESPONSE if alarm.completed is None else missing, NO_COLUMNS
        incident = self.incidents.setdefault(robot, _Incident())
        if alarm.knocked and not alarm.certain:  # it presses no more: the arm is braked until the contact has gone
            incident.touched, incident.calm = True, 0
            name = "hold" if self._asked else ""
            return Response(name, _named("contact"), self._touched(incident, alarm.rows), "contact"), NO_COLUMNS
        touched = self._touched(incident, alarm.rows)
        incident.next(alarm=True)
        cause = self._cause(incident, alarm)
        family = cause.family if cause is not None and cause.probability >= SURE else "unknown"
        incident.touched = alarm.presses or (cause is not None and cause.family == "contact")
        incident.since.setdefault(PRESSING if alarm.presses else family, 0)
        case, name = self._looked_up(incident, family, cause, alarm)
        said = as_info(cause)
        if cause is None or family != cause.family:
            said |= {"family": family, "part": ""}
        columns = cause.columns if cause is not None and name == "complete" else NO_COLUMNS
        return Response(name, said, touched, case) if self._asked else Response("", said, touched), columns

    def uncompleted(self, response: Response) -> Response:
        """Return what is done where the sensors at fault cannot be completed."""
        return response._replace(name=self._table["unknown"])

    def _looked_up(self, incident: _Incident, family: str, cause: Cause | None, alarm: Alarm) -> tuple[str, str]:
        """Return the row of the table that holds, and the response."""
        case = PRESSING if alarm.presses else family
        if case in (PRESSING, "contact") and self._lasts(incident, case):
            case = f"lasting {case}"
        name = self._table[case]
        if name == "go on" and self._blocked(family, cause, alarm.rows):
            # Whatever the policy goes on with, it does not move the arm, and presses.
            case = "lasting actuator" if family == "actuator" else "lasting contact"
            name = self._table[case]
        if name in GOING_ON and not _may_go_on(name, cause, alarm):
            name = self._table["unknown"] if case != "unknown" else "hold"
            name = "hold" if name in GOING_ON else name
        return case, name

    def _cause(self, incident: _Incident, alarm: Alarm) -> Cause | None:
        """Return the cause; a contradiction names a sensor beyond doubt, though perhaps not which."""
        if alarm.contradiction is not None and not alarm.failed:
            part, columns = alarm.contradiction
            return Cause("sensor", part, 1.0, {name: float(name == "sensor") for name in FAMILIES}, columns)
        rows = alarm.rows[-1 - WINDOW :]
        if alarm.failed or self._diagnosis is None or not np.isfinite(rows).all():
            return None
        try:
            newest = self._diagnosis(rows, alarm.attribution, alarm.known)
        except Exception as error:
            # Whatever goes wrong here, an alarm is answered: by what is done about the unknown.
            warnings.warn(f"diagnosis: {error!r}; the cause counts as unknown", stacklevel=2)
            return None
        return incident.believed(newest)

    def _touched(self, incident: _Incident, rows: NDArray[np.float32]) -> bool | None:
        """Return whether what touched the body still does; None where nobody knows."""
        if not self._asked or not incident.touched or self._contact is None or len(rows) < 2:
            return None
        if not self._contact.presses(rows[-2:]):
            return False
        return None if self._lasts(incident, "contact") or self._lasts(incident, PRESSING) else True

    def _blocked(self, family: str, cause: Cause | None, rows: NDArray[np.float32]) -> bool:
        """Return whether the joint at fault, or else the arm, is pressed and still, for as long as what lasts."""
        needed = self.rows - WINDOW
        joint = cause.part if family == "actuator" and cause is not None else ""
        return self._contact is not None and len(rows) >= needed and self._contact.blocked(rows[-needed:], joint)

    def _lasts(self, incident: _Incident, case: str) -> bool:
        return incident.since.get(case, 0) >= LASTING["contact"] / self._spec.dt


def _named(family: str, part: str = "") -> dict[str, Any]:
    """Return what ``info`` says of a cause beyond doubt."""
    return as_info(None) | {"family": family, "part": part, "probability": 1.0}


def _may_go_on(name: str, cause: Cause | None, alarm: Alarm) -> bool:
    """Return whether the policy may go on in alarm."""
    fast = bool(alarm.speed > FAST)
    if name == "complete":  # what is left judges on, and what is completed is bounded by itself
        return not fast
    sure = cause is not None and cause.probability >= SURE
    return sure and alarm.may_go_on and alarm.feels and not (fast or alarm.force > FREE_FORCE)
