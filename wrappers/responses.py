"""What is done about what is wrong: a table of severity and causes, and the responses that it names."""

from __future__ import annotations

import logging
from collections.abc import Mapping
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

from asm_gym.monitors import ExplainsItself, Monitor
from asm_gym.monitors.diagnosis import FAMILIES, WINDOW, Cause, as_info, averaged
from asm_gym.validation import check_choice, shown
from asm_gym.wrappers.contact import ContactEstimator
from asm_gym.wrappers.hand import Contradiction, HandAgainstJoints
from asm_gym.wrappers.repair import ObservationMap, Repair
from asm_gym.wrappers.severity import FREE_FORCE, Severity
from asm_gym.wrappers.transitions import GOING_ON

_log = logging.getLogger("asm_gym.safety")

LASTING = {"contact": 1.0, "actuator": 2.5}
"""From when on a cause is a lasting one [s]: a contact that is there for so long; an actuator's fault where its joint
has been pressed for most of that time and has not turned. Where the policy goes on in spite of another cause, and the
arm is pressed so and does not move, it is a lasting contact."""

UNREAD = "unread sensor"
"""One at fault of which nothing stands in the observation, so that the policy has never read it."""

PRESSING = "pressing"
"""The arm presses harder than healthy motion does, whatever the cause is taken for."""

CAUSES = (*FAMILIES, UNREAD, *(f"lasting {family}" for family in LASTING), PRESSING, f"lasting {PRESSING}")
"""What a table of responses says something about."""

RESPONSES = (*GOING_ON, "hold", "yield", "retract", "stop")
"""Let the policy go on; complete the sensors at fault and go on; stay and keep the grip, yielding to more than a hold's
force; give way to what presses; go back along the path; stay, and end the episode."""

DEFAULT: dict[str, str] = {
    "sensor": "complete",
    UNREAD: "complete",
    "contact": "hold",
    "lasting contact": "yield",
    "actuator": "go on",
    "lasting actuator": "stop",
    "action": "hold",
    "object": "go on",
    "unknown": "hold",
    PRESSING: "hold",
    f"lasting {PRESSING}": "yield",
}
"""What ``on_alarm="graded"`` does. What presses comes first: then only its two rows count, and neither may let the
policy go on. Below that, the policy may go on where the cause is sure, the hand is not faster than any healthy one, for
a bounded time, and where somebody feels that it presses with no more than 40 N; else the robot holds."""

QUIET_S = 1.0
"""After so long without an alarm, what comes next has a cause of its own [s]."""

SURE = 0.5
"""A family that is less probable is unknown."""


class Response(NamedTuple):
    """What is to be done after a row.

    Attributes:
        name: one of ``RESPONSES``; empty where there is nothing to respond to, or nothing is to be done by the table.
        cause: as ``info["asm"]["cause"]`` says it.
        case: one of ``CAUSES``: the row of the table that was followed; empty where none was.
        touched: whether the contact that was responded to is still there; None where that is not known, and where it
            has lasted for so long that it may never end.
    """

    name: str
    cause: dict[str, Any]
    touched: bool | None = None
    case: str = ""

    @property
    def why(self) -> str:
        """The cause in words."""
        if not self.cause["family"]:
            return ""
        part = " ".join(filter(None, (self.case or self.cause["family"], self.cause["part"])))
        return f"{part}, {self.cause['probability']:.2f}"


NONE = np.zeros(0, np.intp)
NO_RESPONSE = Response("", as_info(None))
"""Where nothing is to be done."""


def responses_from(table: Mapping[str, str] | None) -> dict[str, str]:
    """The default table with the entries of ``table`` in place of its own.

    Raises:
        ValueError: an unknown cause or response (the message lists those that exist), or one that lets the policy go on
            while the arm presses.
    """
    if table is not None and not isinstance(table, Mapping):
        raise ValueError(f"responses must map causes to responses, got {shown(table)}")
    for cause, response in (table or {}).items():
        check_choice("cause", cause, CAUSES)
        check_choice("response", response, RESPONSES)
        if cause.endswith(PRESSING) and response in GOING_ON:
            raise ValueError(
                f"{shown(response)} would let an arm go on that presses: {cause} takes hold, yield, retract or stop"
            )
    return {**DEFAULT, **(table or {})}


class Responder:
    """Names the cause of an alarm in one environment, repairs its rows, and says what is to be done.

    Args:
        env: where it acts.
        monitor: what watches; without a diagnosis every cause is unknown.
        table: what is done about which cause, as ``responses_from`` gives it.
        repairs: it does something about it, and does not only say what it is.
    """

    def __init__(self, env: gym.Env[Any, Any], monitor: Monitor, table: Mapping[str, str], repairs: bool) -> None:
        self._table, self._spec, self._repairs = table, monitor.spec, repairs
        self._diagnosis = monitor.diagnosis_ if isinstance(monitor, ExplainsItself) else None
        self.repair: Repair | None = None
        self._map: ObservationMap | None = None
        self._touch: ContactEstimator | None = None
        self.hands = HandAgainstJoints.of(env, self._spec)
        self._kept = WINDOW + 1 + round(LASTING["actuator"] / self._spec.dt)
        if self._diagnosis is not None:
            self._touch = ContactEstimator.where_measured(env, self._diagnosis.completion)
            self._map = self._mapped(env) if repairs else None
            self.repair = Repair(
                self._diagnosis.completion, read=None if self._map is None else self._map.shown, hands=self.hands
            )
        self.reset()

    def _mapped(self, env: gym.Env[Any, Any]) -> ObservationMap | None:
        try:
            return ObservationMap(env, self._spec)
        except ValueError as error:
            # Completing what the monitor sees would hide a fault that the policy goes on to see.
            gym.logger.warn(f"senses cannot be completed, and on a sensor at fault the robot holds: {error}")
            return None

    def reset(self) -> None:
        """A new episode begins."""
        self._rows: list[NDArray[np.float32]] = []
        self._quiet = 0
        self._contradiction: Contradiction | None = None
        self._lost = NONE
        self._forget()
        for hand in self.hands:
            hand.reset()
        if self.repair is not None:
            self.repair.reset()

    def _forget(self) -> None:
        """What was wrong is over."""
        self._since: dict[str, int] = {}  # rows since a family was first the cause
        self._touched = False  # the last alarm was answered as a contact, or looked like one
        self._belief, self._diagnoses = np.zeros(len(FAMILIES)), 0
        self._latest: dict[str, Cause] = {}  # the newest diagnosis of each family

    @property
    def settling(self) -> bool:
        """Whether the monitor still compares repaired rows with some that were not."""
        return self.repair is not None and self.repair.settling > 0

    @property
    def missing(self) -> NDArray[np.bool_]:
        """(D,) the numbers that are completed."""
        return np.zeros(self._spec.size, bool) if self.repair is None else self.repair.missing

    @property
    def judged(self) -> bool:
        """Whether somebody is surprised at every number."""
        return self.repair is None or self.repair.judged

    @property
    def unjudged(self) -> NDArray[np.bool_]:
        """(D,) the numbers at which nobody is surprised, for they are completed or were a moment ago."""
        return np.zeros(self._spec.size, bool) if self.repair is None else self.repair.unjudged

    @property
    def lost(self) -> tuple[str, ...]:
        """The numbers of the last row that were not finite."""
        return tuple(self._spec.labels[i] for i in self._lost) if len(self._lost) else ()

    @property
    def contradicts(self) -> bool:
        """Whether the last row says of a hand what its joints do not, beside what is completed."""
        return self._contradiction is not None

    @property
    def doubt(self) -> str:
        """What can no longer be relied on; empty where everything can."""
        if self.repair is None or self.repair.trusted:
            return ""
        return f"completion: too much is missing, or for too long: {', '.join(self.repair.names)}"

    @property
    def completed(self) -> tuple[str, ...]:
        """The sensors that are completed."""
        return () if self.repair is None else self.repair.names

    @property
    def unread(self) -> tuple[str, ...]:
        """Those of them that the policy does not read."""
        return () if self.repair is None else self.repair.unread

    def read(self, row: NDArray[np.float32]) -> NDArray[np.float32]:
        """(D,) the row as the monitor is to see it."""
        finite = np.isfinite(row)
        self._lost = NONE if finite.all() else np.flatnonzero(~finite)
        found = [hand.read(row, self.missing) for hand in self.hands]
        self._contradiction = next(filter(None, found), None)
        if self.repair is not None and self._map is not None:
            known = self.completed
            try:
                row = self.repair.read(row, whole=self._lost is NONE)
                if self.repair.names and (lost := ", ".join(name for name in self.completed if name not in known)):
                    _log.info("complete: %s says nothing any more", lost)
            except Exception as error:
                # Nobody knows what the row should say: what is not finite is an alarm, and nothing explains it.
                gym.logger.warn(f"completion: {error!r}; the row counts as lost")
                row = np.full_like(row, np.nan)
        self._rows.append(row)
        del self._rows[: -self._kept]
        return row

    @property
    def calm(self) -> bool:
        """Whether there is nothing to be done about a row that is quiet."""
        return not (self._since or self._touched) and (self.repair is None or self.repair.calm)

    def let_pass(self, rows: list[NDArray[np.float32]]) -> None:
        """Quiet rows (D,), which are left alone from now on; ``passed`` is told of them later."""
        self._quiet, self._lost, self._contradiction = self._quiet + len(rows), NONE, None
        self._rows += rows
        if len(self._rows) > 2 * self._kept:
            del self._rows[: -self._kept]

    def passed(self, count: int, mean: NDArray[np.float64]) -> None:
        """So many rows were let pass; see ``HandAgainstJoints.passed``."""
        rows = self._rows[-count:]
        for hand in self.hands:
            hand.passed(rows, count, mean)
        if self.repair is not None and self._map is not None:
            self.repair.passed(rows)

    def observed(self, observation: Any) -> Any:
        """The observation as the policy is to see it."""
        if self._map is None or self.repair is None or not self._rows or not self.completed:
            return observation
        return self._map.repaired(observation, self._rows[-1], self.repair.missing)

    def row(self) -> NDArray[np.float32] | None:
        """(D,) the last row, repaired; None where nothing is."""
        return self._rows[-1] if self._rows and self.completed else None

    def respond(
        self, alarm: bool, failed: bool, attribution: NDArray[np.float64], severity: Severity, may_go_on: bool = True
    ) -> Response:
        """What is to be done about the last row.

        Args:
            alarm: surprise is over the threshold, or a number is missing, or it presses.
            failed: monitor, stream or policy failed, so that nothing is known.
            attribution: (D,) where the surprise is.
            severity: how bad it is.
            may_go_on: the policy has not gone on in alarm for too long yet.
        """
        self._quiet = 0 if alarm else self._quiet + 1
        if self._since and self._quiet > QUIET_S / self._spec.dt:
            self._forget()
        touched = self._touches() if self._repairs else None
        for family in self._since:
            self._since[family] += 1
        if not alarm:
            return NO_RESPONSE if touched is None else NO_RESPONSE._replace(touched=touched)
        cause = self._contradicted()
        if cause is None or failed:
            cause = self._believed(self._cause(failed, attribution))
        family = cause.family if cause is not None and cause.probability >= SURE else "unknown"
        self._touched = severity.presses or (cause is not None and cause.family == "contact")
        self._since.setdefault(PRESSING if severity.presses else family, 0)
        case = (
            f"{'lasting ' if self._lasts(PRESSING) else ''}{PRESSING}"
            if severity.presses
            else self._case(family, cause)
        )
        name = self._table[case]
        if name == "go on" and self._blocked(family, cause):
            # Whatever the policy goes on with, it does not move the arm, and presses.
            case = "lasting actuator" if family == "actuator" else "lasting contact"
            name = self._table[case]
        if name in GOING_ON and not self._lets(name, cause, severity, may_go_on):
            name = self._held(case)
        elif name == "complete" and not self._complete(cause):
            name = self._table["unknown"]
        said = as_info(cause, self._force(family))
        if cause is None or family != cause.family:
            said |= {"family": family, "part": ""}
        return Response(name, said, touched, case) if self._repairs else Response("", said, touched)

    def _lets(self, name: str, cause: Cause | None, severity: Severity, may_go_on: bool) -> bool:
        """Whether the policy may go on in alarm."""
        if name == "complete":  # what is left judges on, and what is completed is bounded by itself
            return not severity.fast
        sure = cause is not None and cause.probability >= SURE
        return sure and may_go_on and severity.felt and not (severity.fast or severity.force > FREE_FORCE)

    def _held(self, case: str) -> str:
        """What is done where the policy may not go on: the response to what is unknown, or staying."""
        name = self._table["unknown"] if case != "unknown" else "hold"
        return "hold" if name in GOING_ON else name

    def missed(self) -> Response:
        """What is done about a row in which numbers are missing, and nothing else is wrong: they are completed."""
        if self._map is None:
            return Response("", as_info(None))
        said = as_info(None) | {"family": "sensor", "part": ", ".join(self.completed), "probability": 1.0}
        return Response("complete", said, None, "sensor")

    def knocked(self) -> Response:
        """What is done about a knock that presses no more: the arm is braked until what touched it has gone."""
        self._touched, self._quiet = True, 0
        said = as_info(None) | {"family": "contact", "part": "", "probability": 1.0}
        touched = self._touches() if self._repairs else None
        return Response("hold" if self._repairs else "", said, touched, "contact")

    def _case(self, family: str, cause: Cause | None) -> str:
        """The row of the table for a cause of ``family``."""
        if family == "contact" and self._lasts(family):
            return f"lasting {family}"
        if family != "sensor" or cause is None or self.repair is None or self._map is None:
            return family
        return family if self.repair.reads(cause.columns) else UNREAD

    def _cause(self, failed: bool, attribution: NDArray[np.float64]) -> Cause | None:
        rows = np.stack(self._rows[-1 - WINDOW :])
        if failed or self._diagnosis is None or not np.isfinite(rows).all():
            return None
        try:
            vouched = [hand.vouched for hand in self.hands]
            return self._diagnosis(rows, attribution, np.logical_or.reduce([self.missing, *vouched]))
        except Exception as error:
            # Whatever goes wrong here, an alarm is answered: by what is done about the unknown.
            gym.logger.warn(f"diagnosis: {error!r}; the cause counts as unknown")
            return None

    def _contradicted(self) -> Cause | None:
        """What hand and joints say is wrong: a sensor, beyond doubt, though it may not be known which."""
        if self._contradiction is None:
            return None
        part, columns = self._contradiction
        return Cause("sensor", part, 1.0, {name: float(name == "sensor") for name in FAMILIES}, columns)

    def _believed(self, cause: Cause | None) -> Cause | None:
        """The cause by all diagnoses since it was quiet for a second, the newest of which counts a tenth at least."""
        if cause is None:
            return None
        self._diagnoses += 1
        newest = np.array([cause.probabilities[name] for name in FAMILIES])
        self._belief = averaged(self._belief, newest, self._diagnoses)
        family = FAMILIES[int(self._belief.argmax())]
        self._latest[cause.family] = cause
        said = self._latest.get(family, cause)
        believed = dict(zip(FAMILIES, self._belief.tolist(), strict=True))
        return said._replace(family=family, probability=float(self._belief.max()), probabilities=believed)

    def _complete(self, cause: Cause | None) -> bool:
        """Completes what is at fault; whether that could be done."""
        if cause is None or self.repair is None or self._map is None:
            return False
        row = self.repair.suspect(cause.columns)
        if row is not None:
            self._rows[-1] = row
            self._forget()
        return row is not None

    def _touches(self) -> bool | None:
        """Whether what touched the body still does."""
        if not self._touched or self._touch is None or len(self._rows) < 2:
            return None
        if not self._touch.presses(np.stack(self._rows[-2:])):
            return False
        return None if self._lasts("contact") or self._lasts(PRESSING) else True

    def _blocked(self, family: str, cause: Cause | None) -> bool:
        """Whether the joint at fault, or else the arm, is pressed and still, for as long as what lasts."""
        rows = self._kept - WINDOW
        joint = cause.part if family == "actuator" and cause is not None else ""
        if self._touch is None or len(self._rows) < rows:
            return False
        return self._touch.blocked(np.stack(self._rows[-rows:]), joint)

    def _lasts(self, family: str) -> bool:
        longest = LASTING["contact" if family == PRESSING else family] if family in (*LASTING, PRESSING) else np.inf
        return self._since.get(family, 0) >= longest / self._spec.dt

    def _force(self, family: str) -> dict[str, Any] | None:
        """What is behind a contact."""
        if family != "contact" or self._touch is None or len(self._rows) < 2:
            return None
        return self._touch.force(np.stack(self._rows[-2:]))
