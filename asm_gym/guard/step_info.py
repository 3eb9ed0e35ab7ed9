"""What became of rows, and what ``info["asm"]`` says of a control step."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Mapping, Sequence
from copy import deepcopy
from dataclasses import dataclass, field
from typing import Any, TypedDict

import numpy as np
from numpy.typing import NDArray

from asm_gym.detection.alarm_rule import EVENTS, KNOCK_EVENT
from asm_gym.detection.drift import Wear
from asm_gym.guard.alarm_terms import ALARM_TERMS
from asm_gym.guard.arbiter import NO_DECISION, Decision
from asm_gym.guard.contact_state import severity_info
from asm_gym.guard.observer import joined
from asm_gym.guard.responses import NO_RESPONSE, Response
from asm_gym.guard.robot_table import ENDED, STATES, Mask
from asm_gym.guard.wear_watch import wear_info
from asm_gym.spec import StreamSpec


@dataclass(frozen=True, slots=True)
class Outcome:
    """What became of the row of one robot about which there was something to decide."""

    terms: tuple[str, ...] = ()
    """Alarm terms that hold, in the order of priority; empty for no alarm."""
    response: Response = NO_RESPONSE
    """What is done about it."""
    decision: Decision = NO_DECISION
    """What it has led to."""


@dataclass(frozen=True, slots=True)
class RowReport:
    """What became of a row of each of n robots; mappings hold those robots alone of which there is something to say.

    Args:
        robots: (n,) their records of ``ROBOT`` after the row, a copy.
        attribution: (n, D) what each number adds to the surprise, repaired senses left out.
        outcomes: what was decided.
        failures: what failed.
        repairs: the sensors that are not believed.
        lost: the numbers that were not finite.
        wear: what wears most, told until it is acknowledged.
    """

    robots: NDArray[Any]
    attribution: NDArray[np.float64]
    outcomes: Mapping[int, Outcome] = field(default_factory=dict)
    failures: Mapping[int, str] = field(default_factory=dict)
    repairs: Mapping[int, tuple[str, ...]] = field(default_factory=dict)
    lost: Mapping[int, tuple[str, ...]] = field(default_factory=dict)
    wear: Mapping[int, Wear] = field(default_factory=dict)

    @property
    def gave_up(self) -> Mask:
        """(n,) the episode is to end."""
        return np.asarray(self.robots["state"] == ENDED)

    @property
    def ends(self) -> Mask:
        """(n,) an alarm that ends the episode, where alarms do: a knock that passes no contact limit does not."""
        is_knock = self.robots["event"] == KNOCK_EVENT
        return np.asarray(self.robots["alarm"] & (self.robots["presses"] | ~is_knock))


NO_OUTCOME = Outcome()


class AsmInfo(TypedDict, total=False):
    """The fields of ``info["asm"]`` of one robot; in a vector each is an array whose first axis is n."""

    surprise: float  # the largest of the rows of this step; infinite where something failed
    threshold: float
    alarm: bool  # for any reason
    alarms: int  # steps in alarm so far in this episode
    reason: str  # the alarm term of the least priority; empty without an alarm
    terms: tuple[str, ...]  # all alarm terms that hold
    event: str  # "fault", "knock", "stop" (no alarm), or empty
    state: str  # who acts next
    intervened: bool  # another than the policy acted, in some row
    gave_up: bool  # the episode ends
    transition: str  # what led to the state, or how the policy goes on in alarm; or empty
    failure: str  # "policy: …", "stream: …", "monitor: …", "completion: …", "reflex: …", or empty
    cause: dict[str, Any]  # family, part, probability of the family, probabilities of all
    response: str  # what is done about it under "graded"
    case: str  # the row of the table of responses that says so
    severity: dict[str, Any]  # see ``severity_info``; None for what is not known
    executed_action: Any  # (A,) after the limit of the hand's speed; None before the first step
    slowed: float  # largest share that the speed limit took from a number of the action
    attribution: dict[str, float]  # what each number adds to the largest surprise
    surprises: NDArray[np.float64]  # (k,) of all rows in this step
    completed: tuple[str, ...]  # the sensors that are not believed now
    lost: tuple[str, ...]  # the numbers that were not finite
    wear: dict[str, Any]  # what drifts: channel, kind and since_s [s]; no alarm
    preview: dict[str, Any] | None  # of the present chunk of actions
    ceiling: float  # highest threshold, only where it follows the policy
    level: float  # share of episodes so far with a false alarm, likewise


def asm_info(
    rows: Sequence[RowReport], robot: int, spec: StreamSpec, executed: Any = None, **step: Any
) -> AsmInfo:
    """Return what ``info["asm"]`` says of a robot, from the rows of a step.

    Args:
        rows: of the step, in order.
        robot: which.
        spec: of its stream.
        executed: (A,) the action that was done last; None before the first step.
        step: what the wrapper knows of the step: ``alarms``, ``slowed``, ``preview``, ``ceiling``, ``level``.
    """
    last = rows[-1]
    now = last.robots[robot]
    surprises = np.array([row.robots["surprise"][robot] for row in rows])
    most_surprising = rows[int(surprises.argmax())]
    outcomes = [row.outcomes.get(robot, NO_OUTCOME) for row in rows]
    responses = [outcome.response for outcome in outcomes if outcome.response.why]
    response = _last(responses, NO_RESPONSE)
    transitions = [outcome.decision.transition for outcome in outcomes]
    terms = in_order_of_priority([name for outcome in outcomes for name in outcome.terms])
    info: AsmInfo = {
        "surprise": float(surprises.max()),
        "threshold": float(now["threshold"]),
        "alarm": _any(rows, "alarm", robot),
        "reason": terms[0] if terms else "",
        "terms": terms,
        "event": EVENTS[max(row.robots["event"][robot] for row in rows)],
        "state": STATES[now["state"]],
        "intervened": _any(rows, "overridden", robot),
        "gave_up": bool(now["state"] == ENDED),
        "transition": _last([name for name in transitions if name], ""),
        "failure": joined(*(row.failures.get(robot, "") for row in rows)),
        "cause": deepcopy(response.cause),
        "response": response.name,
        "case": response.case,
        "severity": _none_for_nan(severity_info(now)),
        "executed_action": deepcopy(executed),
        "attribution": dict(
            zip(spec.labels, most_surprising.attribution[robot].tolist(), strict=True)
        ),
        "surprises": surprises,
        "completed": last.repairs.get(robot, ()),
        "lost": last.lost.get(robot, ()),
        "wear": wear_info(last.wear.get(robot)),
    }
    info.update(step)  # type: ignore[typeddict-item]
    return info


def _none_for_nan(values: Mapping[str, Any]) -> dict[str, Any]:
    """Return the values, with None for those that are not known."""
    known = dict(values)
    for name, value in values.items():
        if math.isnan(value):
            known[name] = None
    return known


def _any(rows: Sequence[RowReport], field: str, robot: int) -> bool:
    """Return whether a field of a robot's record holds in any of the rows."""
    return any(bool(row.robots[field][robot]) for row in rows)


def _last(values: Sequence[Any], otherwise: Any) -> Any:
    """Return the last of several values; ``otherwise`` without one."""
    return values[-1] if values else otherwise


def in_order_of_priority(names: Sequence[str]) -> tuple[str, ...]:
    """Return names of alarm terms, each once, the one that gives the reason first."""

    def priority(name: str) -> float:
        term = ALARM_TERMS.get(name)
        return np.inf if term is None else term.priority

    return tuple(sorted(dict.fromkeys(names), key=priority))


def side_by_side(row: RowReport, spec: StreamSpec, **step: Any) -> dict[str, Any]:
    """Return what ``asm_info`` says of one row of each robot, in arrays whose first axis is n.

    Args:
        row: of n robots.
        spec: of their streams.
        step: further fields, arrays whose first axis is n.
    """
    infos: list[Any] = [asm_info([row], robot, spec) for robot in range(len(row.robots))]
    severities = [severity_info(robot) for robot in row.robots]
    info: dict[str, Any] = {
        name: _stacked([of_robot[name] for of_robot in infos]) for name in infos[0]
    }
    info["severity"] = {
        name: np.array([severity[name] for severity in severities]) for name in severities[0]
    }
    info["attribution"] = {
        label: row.attribution[:, column] for column, label in enumerate(spec.labels)
    }
    info["surprises"] = row.robots["surprise"][:, None]
    info["executed_action"] = None
    return info | step


def _stacked(values: list[Any]) -> NDArray[Any]:
    """Return an array (n,), of objects where the values are not all numbers or text."""
    if not isinstance(values[0], dict | tuple):
        return np.array(values)
    stacked = np.empty(len(values), object)
    stacked[:] = values
    return stacked


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
        make = self._make
        self._make = None
        if make is not None:
            dict.update(self, {**make(), **dict.copy(self)})

    def __array__(self, dtype: Any = None, copy: bool | None = None) -> NDArray[np.bytes_]:
        """Return its ``str`` as one text: so Minari writes it with ``record_infos=True``."""
        return np.array(str(self), np.bytes_)

    def __str__(self) -> str:
        """Return its content as JSON."""
        return json.dumps(dict(self), default=_plain)

    def __reduce_ex__(self, protocol: Any) -> tuple[Any, ...]:
        return dict, (dict(self),)


def _plain(value: Any) -> Any:
    """Return an array, or a number of NumPy, as JSON holds it."""
    return value.tolist()


def _filled_first(name: str) -> Callable[..., Any]:
    def method(self: LazyInfo, *args: Any, **kwargs: Any) -> Any:
        self.fill()
        return getattr(dict, name)(self, *args, **kwargs)

    return method


_OPERATORS = "iter reversed len contains eq ne repr delitem or ror ior"
_METHODS = "keys values items get pop popitem setdefault copy clear"
for _name in (*(f"__{operator}__" for operator in _OPERATORS.split()), *_METHODS.split()):
    setattr(LazyInfo, _name, _filled_first(_name))
