"""What ``info["asm"]`` says of a control step, from the rows that were sensed in it."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from copy import deepcopy
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from asm_gym.detection.alarm_rule import EVENTS
from asm_gym.guard.arbiter import ENDED, STATES, Decision
from asm_gym.guard.observer import joined
from asm_gym.guard.responses import NO_RESPONSE, Response
from asm_gym.guard.robots import NOTHING
from asm_gym.guard.severity import KNOCKED, Severity
from asm_gym.monitors import Surprise
from asm_gym.spec import StreamSpec

CONTACT, FAILURE, SURPRISE, CONTRADICTION, MISSING = "contact", "failure", "surprise", "contradiction", "missing"
REASONS = CONTACT, FAILURE, SURPRISE, CONTRADICTION, MISSING
"""Reasons of an alarm: a contact limit was passed, something failed, surprise is over its threshold, a hand is not
where its joints say, a number is not finite."""

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
    repairs: Mapping[int, tuple[str, ...]] = NOTHING  # the sensors that are not believed
    lost: Mapping[int, tuple[str, ...]] = NOTHING  # the numbers that were not finite

    @property
    def gave_up(self) -> Mask:
        """(n,) the episode is to end."""
        return np.asarray(self.state == ENDED)

    @property
    def ends(self) -> Mask:
        """(n,) an alarm that ends the episode, where alarms do: a knock that passes no contact limit does not."""
        found = np.zeros(len(self.alarm), bool)
        for i, outcome in self.outcomes.items():
            found[i] = outcome.alarm and (outcome.event != KNOCKED or outcome.reason == CONTACT)
        return found

    def of(self, which: Mask) -> RowReport:
        """Return the same with nothing to say of all robots but those of ``which`` (n,)."""
        parts: dict[str, Any] = {}
        for name in ("alarm", "intervened", "event", "state"):
            values = getattr(self, name)
            parts[name] = np.where(which, values, np.zeros_like(values))
        for name in ("outcomes", "failure", "repairs", "lost"):
            parts[name] = {i: value for i, value in getattr(self, name).items() if which[i]}
        return self._replace(surprise=self.surprise.silenced(~which), severity=self.severity.where(which), **parts)

    @classmethod
    def nothing(cls, count: int, size: int, threshold: NDArray[np.float64]) -> RowReport:
        """Return the report of a row in which there was nothing to decide, before the first step of an episode."""
        no, codes = np.zeros(count, bool), np.zeros(count, np.int8)
        surprise = Surprise(np.zeros(count), np.zeros((count, size)))
        return cls(surprise, threshold.copy(), no, no, codes, codes, Severity.unknown(count))


NO_OUTCOME = Outcome(False, "", 0, NO_RESPONSE, Decision())


def report(rows: Sequence[RowReport], robot: int, spec: StreamSpec, executed: Any = None) -> dict[str, Any]:
    """Return what to say of the rows of a step of one robot; the wrapper adds ``alarms``, steps in alarm so far.

    Args:
        executed: (A,) the action that was done last; None before the first step.
    """
    surprises = np.array([row.surprise.value[robot] for row in rows])
    largest, last = int(surprises.argmax()), rows[-1]
    outcomes = [row.outcomes.get(robot, NO_OUTCOME) for row in rows]
    caused = next((o.response for o in reversed(outcomes) if o.response.why), NO_RESPONSE)
    reasons = [o.reason for o in outcomes if o.reason]
    shares = rows[largest].surprise.attribution[robot].tolist()
    return {
        "surprise": float(surprises[largest]),  # the largest of this step; infinite where something failed
        "threshold": float(last.threshold[robot]),
        "alarm": any(bool(row.alarm[robot]) for row in rows),
        "reason": min(reasons, key=REASONS.index, default=""),  # of the alarm, the first of ``REASONS``
        "event": EVENTS[max(int(row.event[robot]) for row in rows)],  # "fault", "knock", "stop" (no alarm), or empty
        "state": str(STATES[last.state[robot]]),  # who acts next
        "intervened": any(bool(row.intervened[robot]) for row in rows),  # another than the policy acted, in some row
        "gave_up": any(bool(row.gave_up[robot]) for row in rows),  # the episode ends
        # What has led to the state, a name in ``TRANSITIONS``, or how the policy goes on in alarm; empty for no change
        "transition": next((t for o in reversed(outcomes) if (t := o.decision.transition)), ""),
        # "policy: …", "stream: …", "monitor: …", "completion: …", "reflex: …", or empty
        "failure": joined(*(row.failure.get(robot, "") for row in rows)),
        "cause": deepcopy(caused.cause),  # of an alarm: family, part, probability of the family, probabilities of all
        "response": caused.name,  # what is done about it under "graded"
        "case": caused.case,  # the row of the table of responses that says so
        # How bad it is, see ``Severity``; None for what is not known, so that a report equals itself.
        "severity": {k: v if v == v else None for k, v in last.severity.named(robot).items()},
        "executed_action": deepcopy(executed),  # after the limit of the hand's speed
        "attribution": dict(zip(spec.labels, shares, strict=True)),  # what each number adds to the largest surprise
        "surprises": surprises,  # (k,) of all rows in this step
        "completed": last.repairs.get(robot, ()),  # the sensors that are not believed now
        "lost": last.lost.get(robot, ()),  # the numbers that were not finite
    }


def side_by_side(row: RowReport, spec: StreamSpec) -> dict[str, Any]:
    """Return what ``report`` says of one row of each robot, in arrays whose first axis is n."""
    each = [report([row], i, spec) for i in range(len(row.alarm))]
    found: dict[str, Any] = {}
    for key, first in each[0].items():
        values = [said[key] for said in each]
        if key == "severity":
            known = [row.severity.named(i) for i in range(len(each))]
            found[key] = {name: np.array([value[name] for value in known]) for name in first}
        elif key == "attribution":
            found[key] = {name: np.array([value[name] for value in values]) for name in first}
        elif isinstance(first, dict | tuple):
            found[key] = np.empty(len(values), object)
            found[key][:] = values
        else:
            found[key] = np.array(values)
    return found | {"executed_action": None, "surprises": row.surprise.value[:, None]}


class LazyInfo(dict[str, Any]):
    """A dict whose content ``make`` returns when it is first read; copied or pickled it is a plain dict."""

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
            dict.update(self, {**make(), **dict.copy(self)})

    def __reduce_ex__(self, protocol: Any) -> tuple[Any, ...]:
        return dict, (dict(self),)


def _filled_first(name: str) -> Callable[..., Any]:
    def method(self: LazyInfo, *args: Any, **kwargs: Any) -> Any:
        self.fill()
        return getattr(dict, name)(self, *args, **kwargs)

    return method


for _name in (
    *("__iter__", "__reversed__", "__len__", "__contains__", "__eq__", "__ne__", "__repr__", "__delitem__", "__or__"),
    *("__ror__", "__ior__", "keys", "values", "items", "get", "pop", "popitem", "setdefault", "copy", "clear"),
):
    setattr(LazyInfo, _name, _filled_first(_name))
