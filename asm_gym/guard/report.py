"""What ``info["asm"]`` says of a control step, from the rows that were sensed in it."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from asm_gym.detection.events import EVENTS, KNOCK
from asm_gym.guard.arbiter import ENDED, STATES, Decision
from asm_gym.guard.observer import joined
from asm_gym.guard.responses import NO_RESPONSE, Response
from asm_gym.guard.robots import NOTHING
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


class Outcome(NamedTuple):
    """What became of the row of one robot about which there was something to decide."""

    alarm: bool  # for whatever reason
    reason: str  # one of ``REASONS``; empty where there is no alarm
    event: int  # a place in ``EVENTS``; 0 where there is no alarm
    response: Response  # what is done about it
    decision: Decision  # what it has led to


class RowReport(NamedTuple):
    """What became of a row of each of n robots; mappings hold those robots alone of which there is something to say."""

    surprise: Surprise  # as it counts, repaired senses left out
    threshold: NDArray[np.float64]  # (n,)
    alarm: Mask  # (n,)
    intervened: Mask  # (n,)
    event: NDArray[np.int8]  # (n,) places in ``EVENTS``
    state: NDArray[np.int8]  # (n,) who acts next, places in ``STATES``
    severity: Severity
    outcomes: Mapping[int, Outcome] = NOTHING
    failure: Mapping[int, str] = NOTHING
    repairs: Mapping[int, tuple[tuple[str, ...], tuple[str, ...]]] = NOTHING  # not believed, and not observed either
    lost: Mapping[int, tuple[str, ...]] = NOTHING  # the numbers that were not finite
    latency: float = 0.0  # of the monitor [s]

    @property
    def gave_up(self) -> Mask:
        """(n,) the episode is to end."""
        found: Mask = self.state == ENDED
        return found

    @property
    def ends(self) -> Mask:
        """(n,) an alarm that ends the episode, where alarms do: a knock that passes no contact limit does not."""
        found = np.zeros(len(self.alarm), bool)
        for i, outcome in self.outcomes.items():
            found[i] = outcome.alarm and (outcome.event != KNOCKED or outcome.reason == CONTACT)
        return found

    def outcome(self, robot: int) -> Outcome:
        """Return what became of the row of a robot."""
        return self.outcomes.get(robot, NO_OUTCOME)

    def with_failures(self, failures: Mapping[int, str]) -> RowReport:
        """Return the same with what failed before the rows, by robot."""
        both = {i: joined(said, self.failure.get(i, "")) for i, said in failures.items()}
        return self._replace(failure={**self.failure, **both}) if failures else self

    def of(self, which: Mask) -> RowReport:
        """Return the same with nothing to say of all robots but those of ``which`` (n,)."""
        mappings, arrays = ("outcomes", "failure", "repairs", "lost"), ("alarm", "intervened", "event", "state")
        parts: dict[str, Any] = {
            name: np.where(which, part := getattr(self, name), np.zeros_like(part)) for name in arrays
        }
        parts |= {name: {i: said for i, said in getattr(self, name).items() if which[i]} for name in mappings}
        return self._replace(surprise=self.surprise.silenced(~which), severity=self.severity.where(which), **parts)

    @classmethod
    def nothing(cls, count: int, size: int, threshold: NDArray[np.float64]) -> RowReport:
        """Return the report of a row in which there was nothing to decide, before the first step of an episode."""
        no, codes = np.zeros(count, bool), np.zeros(count, np.int8)
        surprise = Surprise(np.zeros(count), np.zeros((count, size)))
        return cls(surprise, threshold.copy(), no, no, codes, codes, Severity.unknown(count))


NO_OUTCOME = Outcome(False, "", 0, NO_RESPONSE, Decision())


def report(
    rows: Sequence[RowReport], robot: int, spec: StreamSpec, executed: Any = None, failed: str = ""
) -> dict[str, Any]:
    """Return what to say of the rows of a step of one robot.

    Args:
        executed: (A,) the action that was done last; None before the first step.
        failed: what failed before the step; empty where nothing did.

    Returns:
        ``surprise``: the largest of this step; infinite where something failed. ``threshold``. ``alarm``, and its
        ``reason``: ``"surprise"`` is over the threshold, a
        ``"contact"`` limit was passed, hand and joints are in ``"contradiction"``, a number of the stream is
        ``"missing"``, or a ``"failure"``. ``event``: ``"fault"`` of the body, its senses or its commands; ``"knock"``,
        from which the policy goes on after a pause; ``"stop"``, a joint at its stop, which is no alarm; or empty.
        ``intervened``: something else than the policy acted, in a part of this step at least. ``state``: who acts next,
        one of ``asm_gym.guard.arbiter.State``. ``gave_up``: the episode ends. ``transition``: the name in
        ``asm_gym.guard.arbiter.TRANSITIONS`` of what has led there, ``"override"``, ``"release"``, ``"trial"``,
        ``"give_up"``, or how the policy goes on in alarm, ``"go on"``, ``"complete"``; empty where nothing changes.
        They go to the log ``asm_gym.safety`` with the cause. ``failure``: what failed in this step, ``policy: …``,
        ``stream: …``, ``monitor: …``, ``completion: …`` or ``reflex: …``; or empty. ``cause``: at an alarm, ``family``
        (one of ``asm_gym.monitors.diagnosis.FAMILIES``), ``part``, ``probability`` of the family, ``probabilities`` of
        all. ``severity``: how bad it is,
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
    outcomes = [row.outcome(robot) for row in rows]
    caused = next((o.response for o in reversed(outcomes) if o.response.why), NO_RESPONSE)
    worst, reasons = rows[largest].surprise, [o.reason for o in outcomes if o.reason]
    completed, unread = last.repairs.get(robot, ((), ()))
    return {
        "surprise": float(surprises[largest]),
        "threshold": float(last.threshold[robot]),
        "alarm": any(bool(row.alarm[robot]) for row in rows),
        "reason": min(reasons, key=REASONS.index, default=""),
        "event": EVENTS[max(int(row.event[robot]) for row in rows)],
        "state": str(STATES[last.state[robot]]),
        "intervened": any(bool(row.intervened[robot]) for row in rows),
        "gave_up": any(bool(row.gave_up[robot]) for row in rows),
        "transition": next((t for o in reversed(outcomes) if (t := o.decision.transition)), ""),
        "failure": joined(failed, *(row.failure.get(robot, "") for row in rows)),
        "cause": caused.cause,
        "response": caused.name,
        "case": caused.case,
        "severity": last.severity.named(robot),
        "executed_action": None if executed is None else np.array(executed),
        "attribution": dict(zip(spec.labels, worst.attribution[robot].tolist(), strict=True)),
        "surprises": surprises,
        "latency_us": 1e6 * max(row.latency for row in rows),
        "completed": completed,
        "unread": unread,
        "lost": last.lost.get(robot, ()),
    }


def side_by_side(row: RowReport, spec: StreamSpec) -> dict[str, Any]:
    """Return what ``report`` says of one row of each robot, in arrays whose first axis is n."""
    each = [report([row], i, spec) for i in range(len(row.alarm))]
    found: dict[str, Any] = {key: _array([said[key] for said in each]) for key in each[0]}
    for key in ("severity", "attribution"):
        found[key] = {name: np.array([said[key][name] for said in each]) for name in each[0][key]}
    return found | {"executed_action": None, "surprises": row.surprise.value[:, None]}


def _array(values: list[Any]) -> NDArray[Any]:
    """Return values in an array, each of them one element."""
    if not isinstance(values[0], dict | tuple):
        return np.array(values)
    array = np.empty(len(values), object)
    array[:] = values
    return array


class LazyInfo(dict[str, Any]):
    """A dict whose content is made when it is first read; copied or pickled it is a plain dict.

    Args:
        make: returns the content, from values that never change.
    """

    __slots__ = ("_make",)

    def __init__(self, make: Callable[[], Mapping[str, Any]]) -> None:
        self._make: Callable[[], Mapping[str, Any]] | None = make

    def __missing__(self, key: str) -> Any:
        if self._make is None:
            raise KeyError(key)
        self.fill()
        return self[key]

    def fill(self) -> None:
        """Make the content now; what was written before stays."""
        make, self._make = self._make, None
        if make is not None:
            written = dict.copy(self)
            dict.clear(self)
            dict.update(self, make(), **written)

    def __reduce_ex__(self, protocol: Any) -> tuple[Any, ...]:
        return dict, (dict(self),)


def _filled_first(name: str) -> Callable[..., Any]:
    own = getattr(dict, name)

    def method(self: LazyInfo, *args: Any, **kwargs: Any) -> Any:
        self.fill()
        return own(self, *args, **kwargs)

    return method


for _name in (
    *("__iter__", "__reversed__", "__len__", "__contains__", "__eq__", "__ne__", "__repr__", "__delitem__", "__or__"),
    *("__ror__", "__ior__", "keys", "values", "items", "get", "pop", "popitem", "setdefault", "copy", "clear"),
):
    setattr(LazyInfo, _name, _filled_first(_name))
