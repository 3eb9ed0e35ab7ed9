"""Who acts for each of n robots, the policy or a reflex: what the table of transitions makes of each row.

A requested override takes effect: what fails, be it the policy's action, the stream, the monitor or the reflex, is an
alarm, and ends in the reflex or in staying, never in the policy. While the arm presses harder than healthy motion does,
nothing leads to the policy, whatever the cause is taken for.
"""

from __future__ import annotations

import logging
import math
from functools import partial
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from asm_gym.compilation import compiled
from asm_gym.guard.options import ReleaseRule
from asm_gym.guard.responses import GOING_ON, Response
from asm_gym.guard.transitions import Situation, State, Transition, following

LOG = logging.getLogger("asm_gym.safety")

STATES = tuple(State)
POLICY, TRIAL, REFLEX, ENDED = (STATES.index(s) for s in (State.POLICY, State.TRIAL, State.REFLEX, State.ENDED))

MOSTLY_AFTER = 200
"""Rows under the policy after which it is said that most of them alarm."""

Mask = NDArray[np.bool_]


class Judged(NamedTuple):
    """A row of one robot, as far as it decides who acts next.

    Attributes:
        surprise: infinite where something has failed.
        over: it is over the threshold.
        knocked: it is over the threshold but for what a knock excuses.
        alarm: for whatever reason.
        presses: a contact limit was passed within the step.
        impulse: how much the arm has pressed in this episode, beyond healthy motion [N s].
        intervened: something else than the policy acted.
        refused: the policy's action was not finite, so that the reflex took over before this row.
        response: to the alarm.
    """

    surprise: float
    over: bool
    knocked: bool
    alarm: bool
    presses: bool
    impulse: float
    intervened: bool
    refused: bool
    response: Response


class Decision(NamedTuple):
    """What a row of one robot has led to.

    Attributes:
        transition: the name in ``TRANSITIONS``, or the response under which the policy goes on; empty where nothing
            changes.
        takes_over: the reflex acts from now on.
        acted_on: the surprise has had its consequence, so that its evidence is not to be counted again.
    """

    transition: str = ""
    takes_over: bool = False
    acted_on: bool = False


class Arbiter:
    """Decides who acts.

    Args:
        count: n.
        rule: when control is handed back; None where no reflex ever acts.
        threshold: what surprise must exceed for an alarm.
    """

    def __init__(self, count: int, rule: ReleaseRule | None, threshold: float) -> None:
        self._rule, self._acts = rule or ReleaseRule(), rule is not None
        self.threshold = np.full(count, threshold)
        """(n,) of the episodes that run."""
        self.state = np.zeros(count, np.int8)
        """(n,) who acts next, a place in ``STATES``."""
        self.confirmed = np.zeros(count, bool)
        """(n,) what alarmed in this episode went on while the reflex acted, and so was no habit of the policy."""
        self.strikes = np.zeros(count, np.int64)
        """(n,) how often the policy has pressed too hard in this episode."""
        self.response = [""] * count
        """To the last alarm of each."""
        zeros = np.zeros((7, count), np.int64)
        self._calm, self._acted, self._held, self._free, self._returned, self._since, self._went_on = zeros
        self._wait = np.zeros(count)  # rows of override before a trial
        self._on_trial = np.zeros(count, bool)
        self.rows = np.zeros(count, np.int64)
        """(n,) under the policy, in all episodes."""
        self._alarms = np.zeros(count, np.int64)  # of those rows
        self.begin(np.ones(count, bool))

    def begin(self, which: Mask) -> None:
        """New episodes of the robots of ``which`` (n,)."""
        for counts in (self._calm, self._acted, self._held, self._free, self._returned, self._since, self._went_on):
            counts[which] = 0
        self.state[which], self.strikes[which] = POLICY, 0
        self.confirmed[which] = self._on_trial[which] = False
        self._wait[which] = self._rule.try_after or math.inf
        for robot in np.flatnonzero(which):
            self.response[robot] = ""

    @property
    def most_impulse(self) -> float:
        """How much an arm may press in an episode [N s]."""
        return (self._rule.impulse or math.inf) if self._acts else math.inf

    def may_go_on(self, robot: int) -> bool:
        """Return whether the policy may go on in alarm, for all the time that it did."""
        return bool(self._went_on[robot] < self._rule.go_on)

    def let_pass(self, undecided: Mask) -> None:
        """Count rows of ``undecided`` (n,) robots, whose policy acts and for which there is nothing to decide."""
        _let_pass(undecided, self._calm, self._free, self._since, self.rows)

    def judge_policy(self, robot: int, alarm: bool) -> str:
        """Count a row under the policy; return what is to be said once, and early: most of what it does alarms."""
        self.rows[robot] += 1
        self._alarms[robot] += alarm
        if self.rows[robot] != MOSTLY_AFTER or 2 * self._alarms[robot] <= self.rows[robot]:
            return ""
        return (
            f"{self._alarms[robot]} of the first {self.rows[robot]} rows under this policy alarm: something is wrong "
            'all the time, or the memory does not know this policy, task or set-up. Look with on_alarm="monitor" which '
            'channels info["asm"]["attribution"] names; if all is well, record episodes of it, and '
            "monitor.fit(episodes, warm_start=True).calibrate(others, 0.05)"
        )

    def decide(self, robot: int, row: Judged) -> Decision:
        """Return what a row leads to, and move the robot's state on."""
        if not self._acts:
            return Decision()
        situation = self._count(robot, row)
        state = STATES[self.state[robot]]
        transition = following(state, situation)
        name = self._follow(robot, transition, row) or ("override" if row.refused else "")
        if name:
            why = f" ({row.response.why})" if row.response.why else ""
            LOG.info("%s: surprise %.3g, threshold %.3g%s", name, row.surprise, self.threshold[robot], why)
        acted_on = row.over or row.knocked or row.presses or name == "trial"
        return Decision(name, transition is not None and transition.to is State.REFLEX, acted_on)

    def take_over(self, robot: int) -> None:
        """Let the reflex act from now on."""
        i, rule = robot, self._rule
        if self.state[i] == TRIAL and self._since[i] <= rule.release_after:
            self._wait[i] *= 2 if self._on_trial[i] else 1
            self._returned[i] += 1
        else:
            self._acted[i], self._wait[i], self._returned[i] = 0, rule.try_after or math.inf, 0
        self._held[i] = self._free[i] = self._calm[i] = 0
        self.state[i] = REFLEX

    def _count(self, robot: int, row: Judged) -> Situation:
        """Count the row, and return what it comes to."""
        i, rule, response = robot, self._rule, row.response
        overriding = self.state[i] == REFLEX
        low = row.surprise <= self.threshold[i] * (rule.release_below if row.intervened else 1.0)
        self._calm[i] = self._calm[i] + 1 if low and not row.alarm else 0
        self._free[i] = self._free[i] + 1 if response.touched is False and row.intervened else 0
        goes_on = response.name in GOING_ON and not row.presses
        if row.intervened:
            # Where nobody knows what is sensed, no trial comes nearer.
            self._acted[i] += 1
            self._held[i] = self._held[i] + 1 if math.isfinite(row.surprise) else 0
            # What the arm feels when it changes over to the reflex confirms nothing yet.
            self.confirmed[i] |= row.alarm and self._held[i] > rule.release_after
        else:
            self._since[i] += 1
            self._went_on[i] += row.alarm and goes_on
            self.strikes[i] += row.presses
        if overriding and row.alarm and response.name not in ("", *GOING_ON):
            self.response[i] = response.name
        stopping = self.response[i] == "stop"  # a fault that is calm while nothing is asked of the robot has not gone
        frees = rule.free_after << min(int(self._returned[i]), 16)
        return Situation(
            alarm=row.alarm,
            presses=row.presses,
            spent=self.strikes[i] >= (rule.strikes or math.inf) or row.impulse > (rule.impulse or math.inf),
            goes_on=goes_on and (response.name == "complete" or not overriding),
            stops=stopping and self._held[i] >= (rule.try_after or rule.release_after),
            overdue=self._acted[i] >= (rule.max_override or math.inf),
            calm=not stopping and self._calm[i] >= rule.release_after and not response.touched,
            free=not (stopping or row.presses) and self._free[i] >= frees,
            waited=not (stopping or row.presses) and self._held[i] >= self._wait[i] and response.touched is None,
            settled=self._since[i] > rule.release_after,
        )

    def _follow(self, robot: int, transition: Transition | None, row: Judged) -> str:
        """Change the state; return what is to be said of it."""
        if transition is None:
            return ""
        if transition.to is State.REFLEX:
            self.response[robot] = row.response.name
            self.take_over(robot)
        elif transition.to is not None:
            self.state[robot] = STATES.index(transition.to)
            if transition.to is State.TRIAL:
                self._since[robot], self._calm[robot] = 0, 0
                self._on_trial[robot] = transition.name == "trial"
        return row.response.name if transition.name == "*" else transition.name


@partial(compiled, calls=(".",))
def _let_pass(undecided: Any, calm: Any, free: Any, since: Any, rows: Any) -> None:
    for n in range(len(undecided)):
        if undecided[n]:
            calm[n] += 1
            free[n] = 0
            since[n] += 1
            rows[n] += 1
