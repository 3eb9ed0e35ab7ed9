"""What ``info["asm"]`` says of a control step, from the rows that were sensed in it."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from asm_gym.detection.events import EVENTS, KNOCK
from asm_gym.guard.arbiter import STATES
from asm_gym.guard.observer import joined
from asm_gym.guard.responses import NO_RESPONSE, Response
from asm_gym.guard.severity import Severity
from asm_gym.monitors import Surprise
from asm_gym.spec import StreamSpec

CONTACT, FAILURE, SURPRISE, CONTRADICTION, MISSING = "contact", "failure", "surprise", "contradiction", "missing"
REASONS = CONTACT, FAILURE, SURPRISE, CONTRADICTION, MISSING
"""Reasons of an alarm: a contact limit was passed, something failed, surprise is over its threshold, a hand is not
where its joints say, a number is not finite."""

INFO = "full", "flat"
"""How much stands in ``info``."""

KNOCKED = EVENTS.index(KNOCK)

Mask = NDArray[np.bool_]


class RowReport(NamedTuple):
    """What became of a row of each of n robots; mappings hold those robots alone of which there is something to say.

    Attributes:
        surprise: as it counts, repaired senses left out.
        threshold: (n,).
        alarm, intervened, gave_up: (n,).
        event: (n,) places in ``EVENTS``.
        state: (n,) who acts next, places in ``STATES``.
        severity: of each.
        reason, transition, failure, response: by robot.
        completed, unread, lost: by robot, the sensors that are not believed now, those of them that stand in no
            observation, and the numbers that were not finite.
        latency: of the monitor [s].
    """

    surprise: Surprise
    threshold: NDArray[np.float64]
    alarm: Mask
    intervened: Mask
    gave_up: Mask
    event: NDArray[np.int8]
    state: NDArray[np.int8]
    severity: Severity
    reason: Mapping[int, str]
    transition: Mapping[int, str]
    failure: Mapping[int, str]
    response: Mapping[int, Response]
    completed: Mapping[int, tuple[str, ...]]
    unread: Mapping[int, tuple[str, ...]]
    lost: Mapping[int, tuple[str, ...]]
    latency: float = 0.0

    @property
    def ends(self) -> Mask:
        """(n,) an alarm that ends the episode, where alarms do: a knock that passes no contact limit does not."""
        if not self.alarm.any():
            return self.alarm
        contact = np.array([self.reason.get(i, "") == CONTACT for i in range(len(self.alarm))])
        found: Mask = self.alarm & ((self.event != KNOCKED) | contact)
        return found

    def with_failures(self, failures: Mapping[int, str]) -> RowReport:
        """Return the same with what failed before the rows, by robot."""
        both = {i: joined(said, self.failure.get(i, "")) for i, said in failures.items()}
        return self._replace(failure={**self.failure, **both}) if failures else self

    def without(self, which: Mask) -> RowReport:
        """Return the same with nothing to say of the robots of ``which`` (n,)."""
        blank = RowReport.nothing(len(which), self.surprise.attribution.shape[1], self.threshold)
        arrays = ("alarm", "intervened", "gave_up", "event", "state")
        mappings = ("reason", "transition", "failure", "response", "completed", "unread", "lost")
        severity = zip(blank.severity, self.severity, strict=True)
        return self._replace(
            surprise=self.surprise.silenced(which),
            severity=Severity(*(np.where(which, none, now) for none, now in severity)),
            **{name: np.where(which, getattr(blank, name), getattr(self, name)) for name in arrays},
            **{name: {i: said for i, said in getattr(self, name).items() if not which[i]} for name in mappings},
        )

    @classmethod
    def nothing(cls, count: int, size: int, threshold: NDArray[np.float64]) -> RowReport:
        """Return the report of a row in which there was nothing to decide, before the first step of an episode."""
        no, none = np.zeros(count, bool), np.full(count, np.nan)
        severity = Severity(none, no, none, np.zeros(count), none, none, no, none)
        surprise = Surprise(np.zeros(count), np.zeros((count, size)))
        codes = np.zeros(count, np.int8)
        return cls(surprise, threshold.copy(), no, no, no, codes, codes, severity, *({},) * 7)


def report(
    rows: Sequence[RowReport], robot: int, spec: StreamSpec, executed: Any = None, failed: str = ""
) -> dict[str, Any]:
    """Return what to say of the rows of a step of one robot.

    Args:
        executed: (A,) the action that was done last; None before the first step.
        failed: what failed before the step; empty where nothing did.

    Returns:
        ``surprise``: the largest of this step; infinite where something failed. ``surprise_body`` and
        ``surprise_skill``: the largest at what no body does, and at what no known skill does, not a number where the
        monitor does not tell. ``threshold``. ``alarm``, and its ``reason``: ``"surprise"`` is over the threshold, a
        ``"contact"`` limit was passed, hand and joints are in ``"contradiction"``, a number of the stream is
        ``"missing"``, or a ``"failure"``. ``event``: ``"fault"`` of the body, its senses or its commands; ``"knock"``,
        from which the policy goes on after a pause; ``"stop"``, a joint at its stop, which is no alarm; or empty.
        ``intervened``: something else than the policy acted, in a part of this step at least. ``state``: who acts next,
        one of ``asm_gym.guard.transitions.State``. ``gave_up``: the episode ends. ``transition``: the name in
        ``asm_gym.guard.transitions.TRANSITIONS`` of what has led there, ``"override"``, ``"release"``, ``"trial"``,
        ``"give_up"``, or how the policy goes on in alarm, ``"go on"``, ``"complete"``; empty where nothing changes.
        They go to the log ``asm_gym.safety`` with the cause. ``failure``: what failed in this step, ``policy: …``,
        ``stream: …``, ``monitor: …``, ``completion: …`` or ``reflex: …``; or empty. ``cause``: at an alarm, ``family``
        (one of ``asm_gym.monitors.diagnosis.FAMILIES``), ``part``, ``probability`` of the family, ``probabilities`` of
        all, and for a contact ``force``: the link, the force's size [N] and its vector. ``severity``: how bad it is,
        see ``asm_gym.guard.severity.Severity``. ``response``: what is done about it under ``"graded"``, and ``case``:
        the row of the table that says so. ``executed_action``: the last one, a copy; beneath it ``contact_limits`` may
        have slowed the hand down, as the stream says. ``attribution``: what each number of the stream adds to
        surprise. ``surprises`` (k,) of all rows in this step. ``latency_us``: the longest time that the monitor took
        for one. ``completed``: the sensors that are not believed now, ``unread``: those of them that stand in no
        observation, so that the policy goes on without them, ``lost``: the numbers that were not finite. The wrapper
        adds ``alarms``, steps in alarm in this episode so far.
    """
    surprises = np.array([row.surprise.value[robot] for row in rows])
    largest, last = int(surprises.argmax()), rows[-1]
    caused = next((r for row in reversed(rows) if (r := row.response.get(robot, NO_RESPONSE)).why), NO_RESPONSE)
    worst, reasons = rows[largest].surprise, [row.reason[robot] for row in rows if robot in row.reason]
    return {
        "surprise": float(surprises[largest]),
        "surprise_body": _largest((row.surprise.of_body for row in rows), robot, float(surprises[largest])),
        "surprise_skill": _largest((row.surprise.of_skill for row in rows), robot, math.nan),
        "threshold": float(last.threshold[robot]),
        "alarm": any(bool(row.alarm[robot]) for row in rows),
        "reason": min(reasons, key=REASONS.index, default=""),
        "event": EVENTS[max(int(row.event[robot]) for row in rows)],
        "state": str(STATES[last.state[robot]]),
        "intervened": any(bool(row.intervened[robot]) for row in rows),
        "gave_up": any(bool(row.gave_up[robot]) for row in rows),
        "transition": next((t for row in reversed(rows) if (t := row.transition.get(robot, ""))), ""),
        "failure": joined(failed, *(row.failure.get(robot, "") for row in rows)),
        "cause": caused.cause,
        "response": caused.name,
        "case": caused.case,
        "severity": {name: part[robot].item() for name, part in zip(Severity._fields, last.severity, strict=True)},
        "executed_action": None if executed is None else np.array(executed),
        "attribution": dict(zip(spec.labels, worst.attribution[robot].tolist(), strict=True)),
        "surprises": surprises,
        "latency_us": 1e6 * max(row.latency for row in rows),
        "completed": last.completed.get(robot, ()),
        "unread": last.unread.get(robot, ()),
        "lost": last.lost.get(robot, ()),
    }


def _largest(parts: Iterable[NDArray[np.float64] | None], robot: int, unknown: float) -> float:
    """Return the largest of one part of the surprise in each row; ``unknown`` where no monitor said it."""
    return max((float(part[robot]) for part in parts if part is not None), default=unknown)


def side_by_side(row: RowReport, spec: StreamSpec) -> dict[str, Any]:
    """Return what ``report`` says of one row of each robot, in arrays whose first axis is n."""
    n, value = len(row.alarm), row.surprise.value
    responses = [row.response.get(i, NO_RESPONSE) for i in range(n)]
    caused = [response if response.why else NO_RESPONSE for response in responses]

    def named(said: Mapping[int, str]) -> NDArray[np.str_]:
        return np.array([said.get(i, "") for i in range(n)])

    def listed(values: Sequence[Any]) -> NDArray[Any]:
        array = np.empty(n, object)
        for i, value in enumerate(values):
            array[i] = value
        return array

    def parts(said: Mapping[int, tuple[str, ...]]) -> NDArray[Any]:
        return listed([said.get(i, ()) for i in range(n)])

    return {
        "surprise": value,
        "surprise_body": value if row.surprise.of_body is None else row.surprise.of_body,
        "surprise_skill": np.full(n, np.nan) if row.surprise.of_skill is None else row.surprise.of_skill,
        "threshold": row.threshold,
        "alarm": row.alarm,
        "reason": named(row.reason),
        "event": np.array(EVENTS)[row.event],
        "state": np.array([str(state) for state in STATES])[row.state],
        "intervened": row.intervened,
        "gave_up": row.gave_up,
        "transition": named(row.transition),
        "failure": named(row.failure),
        "cause": listed([response.cause for response in caused]),
        "response": np.array([response.name for response in caused]),
        "case": np.array([response.case for response in caused]),
        "severity": row.severity._asdict(),
        "executed_action": None,
        "attribution": dict(zip(spec.labels, row.surprise.attribution.T, strict=True)),
        "surprises": value[:, None],
        "latency_us": np.full(n, 1e6 * row.latency),
        "completed": parts(row.completed),
        "unread": parts(row.unread),
        "lost": parts(row.lost),
    }
