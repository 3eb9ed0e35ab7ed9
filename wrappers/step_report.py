"""What ``info["asm"]`` says of a control step, from the rows that were sensed in it."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from typing import Any, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from asm_gym.detection.events import EVENTS, KNOCK, NO_EVENT
from asm_gym.monitors import Surprise
from asm_gym.spec import StreamSpec
from asm_gym.wrappers.arbiter import Decision
from asm_gym.wrappers.lazily import Lazily
from asm_gym.wrappers.observer import joined
from asm_gym.wrappers.responses import NO_RESPONSE, Response
from asm_gym.wrappers.severity import Severity

NO_SEVERITY = Severity()


CONTACT, FAILURE, SURPRISE, CONTRADICTION, MISSING = "contact", "failure", "surprise", "contradiction", "missing"
"""Reasons of an alarm: a contact limit was passed, something failed, surprise is over its threshold, a hand is not
where its joints say, a number is not finite."""


REASONS = CONTACT, FAILURE, SURPRISE, CONTRADICTION, MISSING
INFO = "full", "flat"
"""How much stands in ``info``."""

STALE = "monitor: it was fitted while it watched; reset() takes it over"


class RowReport(NamedTuple):
    """What became of one row."""

    surprise: Surprise
    decision: Decision
    latency: float = 0.0  # of the monitor [s]
    failure: str = ""
    response: Response = NO_RESPONSE
    severity: Severity = NO_SEVERITY
    reason: str = ""
    event: str = NO_EVENT

    @property
    def value(self) -> float:
        """Its surprise."""
        return float(self.surprise.value[0])

    def whole(self, threshold: float) -> RowReport:
        """All that there is to say of it: this."""
        return self


class Said(Protocol):
    """What became of one row, said in full when somebody asks."""

    @property
    def decision(self) -> Decision:
        """Who acts next."""

    @property
    def value(self) -> float:
        """Its surprise."""

    def whole(self, threshold: float) -> RowReport:
        """At the threshold of its episode."""


def ends(row: RowReport) -> bool:
    """Whether an alarm ends the episode, where alarms do: a knock no harder than healthy motion does not."""
    return row.decision.alarm and (row.event != KNOCK or row.reason == CONTACT)


def report(
    rows: Sequence[Said],
    spec: StreamSpec,
    threshold: float,
    executed: NDArray[np.float32] | None,
    failed: str,
) -> Lazily:
    """What to say of the rows of a step, put together when it is read.

    Args:
        rows: left alone from now on.
        executed: (A,) the action that was done last; None before the first step.
        failed: what failed before the step; empty where nothing did.

    Returns:
        ``surprise``: the largest of this step; infinite where something failed. ``surprise_body`` and
        ``surprise_skill``: the largest at what no body does, and at what no skill that was shown does, not a number
        where the monitor does not listen for it. ``threshold``. ``alarm``, and its ``reason``: ``"surprise"`` is over
        the threshold, a ``"contact"`` limit was passed, hand and joints are in ``"contradiction"``, a number of the
        stream is ``"missing"``, or a ``"failure"``.
        ``event``: ``"fault"`` of the body, its senses or its commands; ``"knock"``, from which the policy goes on after
        a pause; ``"stop"``, a joint at its stop, which is said and is no alarm; or empty.
        ``intervened``: something else than the policy acted, in a part of this step at least.
        ``state``: who acts next, one of ``asm_gym.wrappers.transitions.State``. ``gave_up``: the episode ends.
        ``transition``: the name in ``asm_gym.wrappers.transitions.TRANSITIONS`` of what has led there, ``"override"``,
        ``"release"``, ``"trial"``, ``"give_up"``, or how the policy goes on in alarm, ``"go on"``, ``"complete"``;
        empty where nothing changes. They go to the log
        ``asm_gym.safety`` with the cause. ``failure``: what failed in this step, ``policy: …``, ``stream: …``,
        ``monitor: …``, ``completion: …`` or ``reflex: …``; or empty. ``cause``: at an alarm, ``family`` (one of
        ``asm_gym.monitors.diagnosis.FAMILIES``), ``part``, ``probability`` of the family, ``probabilities`` of all,
        and for a contact ``force``: the link, the force's size [N] and its vector. ``severity``: how bad it is, see
        ``asm_gym.wrappers.severity.Severity``. ``response``: what is done about it
        under ``"graded"``, and ``case``: the row of the table that says so. ``executed_action``: the last one, a copy;
        beneath it ``contact_limits`` may have slowed the hand down, as the stream says.
        ``attribution``: what each number of the stream adds to surprise. ``surprises`` (n,) of all rows in this step.
        ``latency_us``: the longest time that the monitor took for one. The wrapper adds ``completed``, the sensors that
        are not believed now, ``unread``, those of them that stand in no observation, so that the policy goes on
        without them, ``lost``, the numbers that were not finite, and ``alarms``, steps in alarm in this episode so far,
        for wrappers outside that skip steps.
    """
    surprises = [row.value for row in rows]
    now = {
        "surprise": max(surprises),
        "alarm": any(row.decision.alarm for row in rows),
        "intervened": any(row.decision.intervened for row in rows),
        "gave_up": any(row.decision.gave_up for row in rows),
    }
    done = None if executed is None else np.array(executed)
    return Lazily(
        now, lambda: _all_of([row.whole(threshold) for row in rows], surprises, spec, threshold, done, failed) | now
    )


def _all_of(
    rows: Sequence[RowReport],
    surprises: list[float],
    spec: StreamSpec,
    threshold: float,
    executed: NDArray[np.float32] | None,
    failed: str,
) -> dict[str, Any]:
    largest = max(surprises)
    worst = rows[surprises.index(largest)].surprise
    caused = next((row.response for row in reversed(rows) if row.response.why), NO_RESPONSE)
    return {
        "surprise": largest,
        "surprise_body": _largest((row.surprise.of_body for row in rows), largest),
        "surprise_skill": _largest((row.surprise.of_skill for row in rows), math.nan),
        "threshold": threshold,
        "alarm": False,
        "reason": next((r for r in REASONS if any(row.reason == r for row in rows)), ""),
        "event": max((row.event for row in rows), key=EVENTS.index),
        "state": str(rows[-1].decision.state),
        "intervened": False,
        "gave_up": False,
        "transition": next((t for row in reversed(rows) if (t := row.decision.transition)), ""),
        "failure": joined(failed, *(row.failure for row in rows)),
        "cause": caused.cause,
        "response": caused.name,
        "case": caused.case,
        "severity": rows[-1].severity._asdict(),
        "executed_action": executed,
        "attribution": dict(zip(spec.labels, worst.attribution[0].tolist(), strict=True)),
        "surprises": np.array(surprises),
        "latency_us": 1e6 * max(row.latency for row in rows),
    }


def _largest(parts: Iterable[NDArray[np.float64] | None], unknown: float) -> float:
    """Of one part of the surprise in each row; ``unknown`` where no monitor said it."""
    said = [float(part[0]) for part in parts if part is not None]
    return max(said) if said else unknown
