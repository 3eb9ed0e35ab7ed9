"""Alarm terms: the named causes of an alarm, each a function of the table of robots to a mask.

A row is an alarm where any term holds; of several, the one with the least priority gives the reason. To add a term of
your own: ``register_alarm_term("curtain", lambda robots: robots.info("curtain", 0.0) > 0.0)``.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from asm_gym.guard.responses import GOING_ON, RESPONSES
from asm_gym.guard.robot_table import Mask, RobotTable
from asm_gym.registries import Registry
from asm_gym.validation import check_choice, check_number, short_repr

BY_CAUSE = "by cause"  # diagnosis chooses the response from the table of responses

CONTACT, FAILURE, SURPRISE = "contact", "failure", "surprise"
CONTRADICTION, MISSING, OUT_OF_RANGE = "contradiction", "missing", "out_of_range"

USUAL_PRIORITY = 45.0  # of a user's own term


@dataclass(frozen=True)
class AlarmTerm:
    """One cause of alarms.

    Args:
        holds: where it holds (n,), by the table of n robots.
        priority: the least of those that hold is the reason.
        help: where it holds, in a sentence.
        response: under ``"graded"``, a response by name, or ``BY_CAUSE``.
    """

    holds: Callable[[RobotTable], Mask]
    priority: float
    help: str = ""
    response: str = BY_CAUSE


ALARM_TERMS: Registry[AlarmTerm] = Registry(
    "alarm term",
    "asm_gym.guard.alarm_terms:ALARM_TERMS",
    {
        CONTACT: AlarmTerm(
            lambda robots: robots.records["presses"],
            priority=10.0,
            help="a contact limit was passed within the step, or the arm leans on something",
        ),
        FAILURE: AlarmTerm(
            lambda robots: robots.records["failed"],
            priority=20.0,
            help="the policy, the stream, the monitor or the reflex failed",
        ),
        SURPRISE: AlarmTerm(
            lambda robots: robots.records["over"] | robots.records["knocked"],
            priority=30.0,
            help="surprise is over its threshold, or would be but for a knock",
        ),
        CONTRADICTION: AlarmTerm(
            lambda robots: robots.records["contradicts"],
            priority=40.0,
            help="a hand is not where its joints say",
        ),
        MISSING: AlarmTerm(
            lambda robots: robots.records["lost"],
            priority=50.0,
            help="a number of the row is not finite",
        ),
        OUT_OF_RANGE: AlarmTerm(
            lambda robots: robots.records["out_of_range"],
            priority=60.0,
            help=(
                "the policy's action is far out of the range of healthy commands, "
                "and is not executed"
            ),
            response="hold",
        ),
    },
)
"""Alarm terms by name; those that a user adds travel with the work into other processes."""


def register_alarm_term(
    name: str,
    holds: Callable[[RobotTable], Mask],
    *,
    help: str = "",
    priority: float = USUAL_PRIORITY,
    response: str = "hold",
) -> None:
    """Add an alarm term of the user's own to every guard that is made from now on.

    Args:
        name: of the term, as ``info["asm"]["terms"]`` says it.
        holds: takes the table of robots and returns a mask (n,). It is asked at every row: ``robots.channel(name)`` are
            numbers of the row (n, k), ``robots.info(name)`` what environments say in ``info`` (n,), and
            ``robots.records`` the contact state.
        help: where it holds, in a sentence.
        priority: of several terms, the least is the reason; contact has 10, surprise 30, missing numbers 50.
        response: what is done under ``"graded"``: ``"hold"``, ``"comply"``, ``"retract"``, ``"stop"``, ``"go on"``, or
            ``"by cause"``. ``"go on"`` counts as an alarm and lets the policy act, unless the arm presses.

    Raises:
        ValueError: the name is taken, or an unknown response.

    Example:
        >>> from asm_gym.guard.alarm_terms import ALARM_TERMS, register_alarm_term
        >>> register_alarm_term("squeezed", lambda robots: robots.info("grip_force", 0.0) > 30.0)
        >>> del ALARM_TERMS["squeezed"]
    """
    possible = (*(known for known in RESPONSES if known not in GOING_ON), "go on", BY_CAUSE)
    check_choice("response", response, possible)
    check_number("priority", priority)
    ALARM_TERMS.register(name, AlarmTerm(holds, priority, help, response))


class AlarmTerms:
    """The terms of one guard, and in how many rows each held.

    Attributes:
        terms: by name, in the order of priority.
        held_rows: rows of robots in which each term held, by name.
        of_user: names of the terms that are not the package's own.
    """

    def __init__(self) -> None:
        self.terms = dict(sorted(ALARM_TERMS.items(), key=lambda item: item[1].priority))
        self.held_rows = dict.fromkeys(self.terms, 0)
        self.of_user = tuple(name for name in self.terms if name not in ALARM_TERMS.own)
        self._user_masks: dict[str, Mask] = {}  # (n,) at the newest row, by the user's own terms

    def ask_users(self, robots: RobotTable) -> str:
        """Evaluate the user's own terms at a row, whose masks are kept; return what failed, as an alarm must not."""
        self._user_masks = {}
        for name in self.of_user:
            try:
                self._user_masks[name] = self._checked(name, robots)
            except Exception as error:
                return f"alarm term {name}: {error!r}"
        return ""

    def any_of_user(self) -> Mask | bool:
        """Return (n,) where any of the user's own terms holds at the row."""
        return np.logical_or.reduce(list(self._user_masks.values()), initial=False)

    def masks(self, robots: RobotTable) -> dict[str, Mask]:
        """Return where each term holds (n,), by name, in the order of priority."""
        active = robots.records["active"]
        built_in = {
            name: term.holds(robots) for name, term in self.terms.items() if name in ALARM_TERMS.own
        }
        masks = built_in | self._user_masks
        return {name: masks[name] & active for name in self.terms if name in masks}

    def count(self, names: tuple[str, ...]) -> None:
        """Count a row of a robot in which these terms hold."""
        for name in names:
            self.held_rows[name] += 1

    def _checked(self, name: str, robots: RobotTable) -> Mask:
        mask = np.asarray(self.terms[name].holds(robots))
        shape = (len(robots.records),)
        if mask.shape != shape or mask.dtype != np.bool_:
            raise TypeError(f"it must return a mask {shape}, got {short_repr(mask)}")
        return mask

    def __str__(self) -> str:
        """Return a line for each term.

        It has the priority, the name, the rows in which the term held, the response, and where it
        holds.
        """
        lines = ["priority  term           rows  response  holds where"]
        for name, term in self.terms.items():
            rows = self.held_rows[name]
            lines.append(f"{term.priority:8g}  {name:13}  {rows:4}  {term.response:8}  {term.help}")
        return "\n".join(lines)
