"""Who acts for each of n robots, the policy or a reflex: four states, and one table of transitions.

A requested override takes effect: what fails, be it the policy's action, the stream, the monitor or the reflex, is an
alarm, and ends in the reflex or in staying, never in the policy. While the arm presses harder than healthy motion does,
nothing leads to the policy, whatever the cause is taken for.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from asm_gym.detection import AdaptiveThreshold
from asm_gym.guard.options import ReleaseRule
from asm_gym.guard.responses import GOING_ON, Response
from asm_gym.guard.robot_table import ENDED, POLICY, REFLEX, TRIAL, Mask, RobotTable
from asm_gym.guard.row_evidence import RowEvidence

LOG = logging.getLogger("asm_gym.safety")

RELEASE_BELOW = 0.8  # share of the threshold that surprise must be under before a reflex hands back
MOST_DOUBLINGS = 16  # of the time that a contact must have been gone for

# Rows under the policy after which the user is warned if most of them alarm.
MOSTLY_AFTER = 200

MOST_ROWS_ALARM = (
    "{} of the first {} rows under this policy alarm: something is wrong all the time, or the "
    'memory does not know this policy, task or set-up. Look with on_alarm="monitor" which channels '
    'info["asm"]["attribution"] names; if all is well, record episodes of it, and '
    "monitor.fit(episodes, warm_start=True).calibrate(others, 0.05)"
)


class Situation(NamedTuple):
    """All that a row tells the table of transitions."""

    alarm: bool = False
    """Surprise is over the threshold, or something failed, is missing or presses."""
    presses: bool = False
    """A contact limit was passed within the step."""
    pressed_too_often: bool = False
    """The arm has pressed too often, or with too much impulse, in this episode."""
    goes_on: bool = False
    """The response lets the policy act."""
    stops: bool = False
    """The response ends the episode, and has been held for long enough."""
    overdue: bool = False
    """The reflex has acted for as long as it may."""
    surprise_low: bool = False
    """Surprise has been low for long enough, and nothing touches."""
    contact_gone: bool = False
    """The contact has been gone for long enough, and nothing presses."""
    trial_due: bool = False
    """Held for long enough for a trial, nothing presses, and no sense tells of a contact."""
    trial_passed: bool = False
    """The trial has gone well for long enough."""


class Transition(NamedTuple):
    """A row of the table: in one of the states ``within``, where ``when`` holds, ``to`` is next."""

    # As ``info["asm"]["transition"]`` says it; empty for none, "*" for the response's own name.
    name: str
    within: tuple[int, ...]
    to: int | None  # None: the state stays
    when: Callable[[Situation], bool]
    why: str


POLICY_ACTS = POLICY, TRIAL
REFLEX_ACTS = (REFLEX,)
ANYBODY_ACTS = (*POLICY_ACTS, *REFLEX_ACTS)

TRANSITIONS = (
    Transition(
        "give_up", ANYBODY_ACTS, ENDED, lambda s: s.pressed_too_often, "pressed too often or much"
    ),
    Transition(
        "override", POLICY_ACTS, REFLEX, lambda s: s.presses, "presses harder than healthy motion"
    ),
    Transition(
        "*",
        POLICY_ACTS,
        None,
        lambda s: s.alarm and s.goes_on,
        "an alarm whose cause lets the policy go on",
    ),
    Transition("override", POLICY_ACTS, REFLEX, lambda s: s.alarm, "any other alarm"),
    Transition("", (TRIAL,), POLICY, lambda s: s.trial_passed, "no alarm for `release_after`"),
    Transition(
        "*",
        REFLEX_ACTS,
        TRIAL,
        lambda s: s.alarm and s.goes_on,
        "the cause turns out to be a sensor",
    ),
    Transition(
        "release",
        REFLEX_ACTS,
        TRIAL,
        lambda s: s.surprise_low,
        "calm for `release_after`, nothing touches",
    ),
    Transition("release", REFLEX_ACTS, TRIAL, lambda s: s.contact_gone, "the contact has gone"),
    Transition(
        "give_up", REFLEX_ACTS, ENDED, lambda s: s.stops, "response `stop`, held for `try_after`"
    ),
    Transition("give_up", REFLEX_ACTS, ENDED, lambda s: s.overdue, "acted for `max_override`"),
    Transition(
        "trial",
        REFLEX_ACTS,
        TRIAL,
        lambda s: s.trial_due,
        "held for `try_after`, nothing known to touch",
    ),
)
"""What leads from one state to another: the first that holds. Where none does, nothing changes."""


def following(state: int, situation: Situation) -> Transition | None:
    """Return the first of ``TRANSITIONS`` that holds; None where nothing changes."""
    for transition in TRANSITIONS:
        if state in transition.within and transition.when(situation):
            return transition
    return None


class Decision(NamedTuple):
    """What a row of one robot has led to."""

    transition: str = ""
    """The name in ``TRANSITIONS``, or the response under which the policy goes on."""
    takes_over: bool = False
    """The reflex acts from now on."""
    acted_on: bool = False
    """The surprise has had its consequence: its evidence is not to be counted again."""


NO_DECISION = Decision()


class Arbiter:
    """Decides who acts.

    Args:
        table: the records of n robots; the counters are the arbiter's.
        rule: when control is handed back; None where no reflex ever acts.
        adaptive: how thresholds follow the policies, from episode to episode; None where they do not.

    Attributes:
        running: the threshold that follows; None where none does.
        most_impulse: that an arm may press with in an episode [N s].
        response: name of the response to the last alarm of each robot.
    """

    def __init__(
        self, table: RobotTable, rule: ReleaseRule | None, adaptive: AdaptiveThreshold | None = None
    ) -> None:
        self._table = table
        self._acts = rule is not None
        self._rule = rule or ReleaseRule()
        self.running = None
        if adaptive is not None:
            self.running = adaptive.start(float(table.records["threshold"][0]))
        self.most_impulse = self._rule.impulse
        self.response = [""] * len(table.records)
        table.records["rows_until_trial"] = self._rule.try_after

    def follow_thresholds(self, which: Mask) -> None:
        """Let the threshold follow the episodes of ``which`` (n,) that end, before their records are cleared."""
        if self.running is None:
            return
        for index in np.flatnonzero(which).tolist():
            robot = self._table.robot(index)
            if robot.largest_surprise > -np.inf:
                self.running.follow(
                    float(robot.largest_surprise), float(robot.threshold), bool(robot.confirmed)
                )
                robot.threshold = self.running.value

    def begin(self, which: Mask) -> None:
        """Begin new episodes of the robots of ``which`` (n,), whose records have been cleared."""
        self._table.records["rows_until_trial"][which] = self._rule.try_after
        for index in np.flatnonzero(which).tolist():
            self.response[index] = ""

    def may_go_on(self, index: int) -> bool:
        """Return whether a robot's policy may act in alarm for one more row of this episode."""
        return bool(self._table.records["rows_going_on"][index] < self._rule.go_on)

    def count_policy_row(self, evidence: RowEvidence) -> str:
        """Count a row under the policy; return a warning, once and early, if most of its rows alarm, else ""."""
        robot = evidence.robot
        robot.policy_rows += 1
        robot.policy_alarms += evidence.alarm
        most_alarm = 2 * robot.policy_alarms > robot.policy_rows
        if robot.policy_rows == MOSTLY_AFTER and most_alarm:
            return MOST_ROWS_ALARM.format(robot.policy_alarms, robot.policy_rows)
        return ""

    def decide(self, evidence: RowEvidence, response: Response) -> Decision:
        """Return what a row and the ``response`` to it lead to, and move the robot's state on."""
        robot = evidence.robot
        if not robot.overridden:
            robot.largest_surprise = max(robot.largest_surprise, robot.surprise)
        if not self._acts:
            return NO_DECISION

        self._count_row(evidence, response)
        transition = following(int(robot.state), self._situation(evidence, response))
        name = ""
        if transition is not None:
            name = self._change_state(evidence.index, transition, response.name)
        if robot.refused and not name:
            name = "override"  # the commander has called ``take_over`` already
        if name:
            LOG.info(
                "%s: surprise %.3g, threshold %.3g%s",
                name,
                robot.surprise,
                robot.threshold,
                response.why,
            )
        return Decision(
            transition=name,
            takes_over=transition is not None and transition.to == REFLEX,
            acted_on=bool(robot.over or robot.knocked or robot.presses or name == "trial"),
        )

    def take_over(self, index: int) -> None:
        """Let the reflex of a robot act from now on."""
        robot = self._table.robot(index)
        returned_too_early = (
            robot.state == TRIAL and robot.rows_since_return <= self._rule.release_after
        )
        if returned_too_early:
            robot.early_returns += 1
            if robot.on_trial:
                robot.rows_until_trial *= 2
        else:
            robot.early_returns = 0
            robot.override_rows = 0
            robot.rows_until_trial = self._rule.try_after
        robot.held_rows = 0
        robot.contact_free_rows = 0
        robot.low_surprise_rows = 0
        robot.state = REFLEX

    def _count_row(self, evidence: RowEvidence, response: Response) -> None:
        """Count the row, and keep the newest response to an alarm of a reflex."""
        robot = evidence.robot
        low = robot.threshold
        if robot.overridden:
            low *= RELEASE_BELOW
        if robot.surprise <= low and not evidence.alarm:
            robot.low_surprise_rows += 1
        else:
            robot.low_surprise_rows = 0
        if response.touched is False and robot.overridden:
            robot.contact_free_rows += 1
        else:
            robot.contact_free_rows = 0

        if robot.overridden:
            self._count_override(evidence)
        else:
            self._count_policy(evidence, response)
        keeps_off = response.name not in ("", *GOING_ON)
        if robot.state == REFLEX and evidence.alarm and keeps_off:
            self.response[evidence.index] = response.name

    def _count_policy(self, evidence: RowEvidence, response: Response) -> None:
        """Count a row of the policy."""
        robot = evidence.robot
        robot.rows_since_return += 1
        if evidence.alarm and self._lets_go_on(robot, response):
            robot.rows_going_on += 1
        if robot.presses:
            robot.strikes += 1

    def _count_override(self, evidence: RowEvidence) -> None:
        """Count a row of a reflex."""
        robot = evidence.robot
        robot.override_rows += 1
        if math.isfinite(robot.surprise):
            robot.held_rows += 1
        else:
            robot.held_rows = 0  # rows that nobody can judge bring no trial nearer
        # What the arm feels when it changes over to the reflex confirms nothing yet.
        if evidence.alarm and robot.held_rows > self._rule.release_after:
            robot.confirmed = True

    @staticmethod
    def _lets_go_on(robot: Any, response: Response) -> bool:
        """Return whether the response lets the policy act, and nothing presses."""
        return response.name in GOING_ON and not robot.presses

    def _situation(self, evidence: RowEvidence, response: Response) -> Situation:
        """Return what the counted row comes to."""
        robot = evidence.robot
        rule = self._rule
        # "stop" ends the episode: a fault that surprises nobody while the arm is held has not gone.
        stopping = self.response[evidence.index] == "stop"
        may_return = not (stopping or robot.presses)

        goes_on = self._lets_go_on(robot, response)
        if robot.state == REFLEX and response.name != "complete":
            goes_on = False

        pressed_too_often = robot.strikes >= rule.strikes or robot.pressed_impulse > rule.impulse
        was_low_for_long = robot.low_surprise_rows >= rule.release_after
        contact_over_after = rule.free_after * 2 ** min(int(robot.early_returns), MOST_DOUBLINGS)
        was_held_for_long = robot.held_rows >= robot.rows_until_trial
        return Situation(
            alarm=evidence.alarm,
            presses=bool(robot.presses),
            pressed_too_often=bool(pressed_too_often),
            goes_on=goes_on,
            stops=bool(stopping and robot.held_rows >= rule.try_after),
            overdue=bool(robot.override_rows >= rule.max_override),
            surprise_low=not stopping and was_low_for_long and not response.touched,
            contact_gone=may_return and robot.contact_free_rows >= contact_over_after,
            trial_due=may_return and was_held_for_long and response.touched is None,
            trial_passed=bool(robot.rows_since_return > rule.release_after),
        )

    def _change_state(self, index: int, transition: Transition, response: str) -> str:
        """Change the state of a robot; return what is to be said of it."""
        robot = self._table.robot(index)
        if transition.to == REFLEX:
            self.response[index] = response
            self.take_over(index)
        elif transition.to is not None:
            robot.state = transition.to
            if transition.to == TRIAL:
                robot.rows_since_return = 0
                robot.low_surprise_rows = 0
                robot.on_trial = transition.name == "trial"
        if transition.name == "*":
            return response
        return transition.name
