"""Who acts for each of n robots, the policy or a reflex: four states, and one table of transitions.

A requested override takes effect: what fails, be it the policy's action, the stream, the monitor or the reflex, is an
alarm, and ends in the reflex or in staying, never in the policy. While the arm presses harder than healthy motion does,
nothing leads to the policy, whatever the cause is taken for.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Callable
from enum import StrEnum
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from asm_gym.detection import AdaptiveThreshold
from asm_gym.guard.options import ReleaseRule
from asm_gym.guard.responses import GOING_ON, Response

LOG = logging.getLogger("asm_gym.safety")

RELEASE_BELOW = 0.8  # share of the threshold that surprise must be under before a reflex hands back

MOSTLY_AFTER = 200  # rows under the policy after which it is said that most of them alarm

MOSTLY = (
    "{} of the first {} rows under this policy alarm: something is wrong all the time, or the memory does not know "
    'this policy, task or set-up. Look with on_alarm="monitor" which channels info["asm"]["attribution"] names; if all '
    "is well, record episodes of it, and monitor.fit(episodes, warm_start=True).calibrate(others, 0.05)"
)

Mask = NDArray[np.bool_]


class State(StrEnum):
    """Who acts; on ``TRIAL`` the policy, so recently that an alarm which comes back had not gone."""

    POLICY = "policy"
    TRIAL = "trial"
    REFLEX = "reflex"
    ENDED = "ended"


STATES = tuple(State)
POLICY, TRIAL, REFLEX, ENDED = range(4)

COUNTS = CALM, ACTED, HELD, FREE, RETURNED, SINCE, WENT_ON, STRIKES, ROWS, ALARMS = range(10)
"""What is counted of each robot in an episode, in rows: of low surprise, in a row; under the reflex, those before a
hand-back that came too early included; under the reflex since it took over; without a contact, in a row; hand-backs
that came too early, in a row; under the policy since control was handed back; in alarm under the policy; how often it
has pressed too hard. In all episodes: rows under the policy, and how many of them alarmed."""


class Situation(NamedTuple):
    """All that a row tells the table of transitions."""

    alarm: bool = False  # surprise is over the threshold, or something failed, is missing or presses
    presses: bool = False  # a contact limit was passed within the step
    spent: bool = False  # the arm has pressed too often, or with too much impulse, in this episode
    goes_on: bool = False  # the response lets the policy act
    stops: bool = False  # the response ends the episode, and has been held for long enough
    overdue: bool = False  # the reflex has acted for as long as it may
    calm: bool = False  # surprise has been low for long enough, and nothing touches
    free: bool = False  # the contact has been gone for long enough, and nothing presses
    waited: bool = False  # held for long enough for a trial, nothing presses, and no sense tells of a contact
    settled: bool = False  # the trial has gone well for long enough


class Transition(NamedTuple):
    """A row of the table: in one of the states ``within``, where ``when`` holds, ``to`` is next."""

    name: str  # as ``info["asm"]["transition"]`` says it; empty for none, "*" for the response's own name
    within: tuple[State, ...]
    to: State | None  # None: the state stays
    when: Callable[[Situation], bool]
    why: str


POLICY_ACTS, REFLEX_ACTS = (State.POLICY, State.TRIAL), (State.REFLEX,)
TRANSITIONS = (
    Transition("give_up", (*POLICY_ACTS, *REFLEX_ACTS), State.ENDED, lambda s: s.spent, "pressed too often or much"),
    Transition("override", POLICY_ACTS, State.REFLEX, lambda s: s.presses, "presses harder than healthy motion"),
    Transition("*", POLICY_ACTS, None, lambda s: s.alarm and s.goes_on, "an alarm whose cause lets the policy go on"),
    Transition("override", POLICY_ACTS, State.REFLEX, lambda s: s.alarm, "any other alarm"),
    Transition("", (State.TRIAL,), State.POLICY, lambda s: s.settled, "no alarm for `release_after`"),
    Transition("*", REFLEX_ACTS, State.TRIAL, lambda s: s.alarm and s.goes_on, "the cause turns out to be a sensor"),
    Transition("release", REFLEX_ACTS, State.TRIAL, lambda s: s.calm, "calm for `release_after`, nothing touches"),
    Transition("release", REFLEX_ACTS, State.TRIAL, lambda s: s.free, "the contact has gone"),
    Transition("give_up", REFLEX_ACTS, State.ENDED, lambda s: s.stops, "response `stop`, held for `try_after`"),
    Transition("give_up", REFLEX_ACTS, State.ENDED, lambda s: s.overdue, "acted for `max_override`"),
    Transition("trial", REFLEX_ACTS, State.TRIAL, lambda s: s.waited, "held for `try_after`, nothing known to touch"),
)
"""What leads from one state to another: the first that holds. Where none does, nothing changes."""


def following(state: State, situation: Situation) -> Transition | None:
    """Return the first of ``TRANSITIONS`` that holds; None where nothing changes."""
    return next((t for t in TRANSITIONS if state in t.within and t.when(situation)), None)


class Judged(NamedTuple):
    """A row of one robot, as far as it decides who acts next."""

    surprise: float  # infinite where something has failed
    over: bool  # it is over the threshold
    knocked: bool  # it is over the threshold but for what a knock excuses
    alarm: bool  # for whatever reason
    presses: bool  # a contact limit was passed within the step
    impulse: float  # how much the arm has pressed in this episode, beyond healthy motion [N s]
    intervened: bool  # something else than the policy acted
    refused: bool  # the policy's action was not finite, so that the reflex took over before this row
    response: Response  # to the alarm


class Decision(NamedTuple):
    """What a row of one robot has led to."""

    transition: str = ""  # the name in ``TRANSITIONS``, or the response under which the policy goes on
    takes_over: bool = False  # the reflex acts from now on
    acted_on: bool = False  # the surprise has had its consequence: its evidence is not to be counted again


class Arbiter:
    """Decides who acts.

    Args:
        rule: when control is handed back; None where no reflex ever acts.
        threshold: what surprise must exceed for an alarm.
        adaptive: how it follows the policies, from episode to episode; None where it does not.
    """

    def __init__(
        self, count: int, rule: ReleaseRule | None, threshold: float, adaptive: AdaptiveThreshold | None = None
    ) -> None:
        self.running = None if adaptive is None else adaptive.start(threshold)
        self._rule, self._acts = rule or ReleaseRule(), rule is not None
        self.most_impulse = self._rule.impulse  # that an arm may press with in an episode [N s]
        self.threshold = np.full(count, threshold)  # (n,) of the episodes that run
        self.state = np.zeros(count, np.int8)  # (n,) who acts next, a place in ``STATES``
        self.confirmed = np.zeros(count, bool)
        """(n,) an alarm in this episode was no false one: it went on while the reflex acted, or the user says so."""
        self.counts = np.zeros((len(COUNTS), count), np.int64)  # (10, n) in the order of ``COUNTS``
        self.largest = np.full(count, -np.inf)  # (n,) the largest surprise in this episode, while the policy acted
        self.response = [""] * count  # to the last alarm of each
        self._wait = np.full(count, self._rule.try_after)  # rows of override before a trial
        self._on_trial = np.zeros(count, bool)

    def begin(self, which: Mask) -> None:
        """New episodes of the robots of ``which`` (n,)."""
        if self.running is not None:
            for robot in np.flatnonzero(which & (self.largest > -np.inf)):
                largest, threshold = float(self.largest[robot]), float(self.threshold[robot])
                self.running.follow(largest, threshold, bool(self.confirmed[robot]))
                self.threshold[robot] = self.running.value
        self.counts[:ROWS, which] = 0
        self.state[which], self.largest[which] = POLICY, -np.inf
        self.confirmed[which] = self._on_trial[which] = False
        self._wait[which] = self._rule.try_after
        self.response[:] = ["" if new else name for new, name in zip(which, self.response, strict=True)]

    def may_go_on(self, robot: int) -> bool:
        """Return whether the policy may go on in alarm, for all the time that it did."""
        return bool(self.counts[WENT_ON, robot] < self._rule.go_on)

    def judge_policy(self, robot: int, alarm: bool) -> str:
        """Count a row under the policy; return what is to be said once, and early: most of what it does alarms."""
        self.counts[ROWS, robot] += 1
        self.counts[ALARMS, robot] += alarm
        rows, alarms = self.counts[[ROWS, ALARMS], robot]
        return MOSTLY.format(alarms, rows) if rows == MOSTLY_AFTER and 2 * alarms > rows else ""

    def decide(self, robot: int, row: Judged) -> Decision:
        """Return what a row leads to, and move the robot's state on."""
        if not row.intervened:
            self.largest[robot] = max(self.largest[robot], row.surprise)
        if not self._acts:
            return Decision()
        transition = following(STATES[self.state[robot]], self._count(robot, row))
        name = "" if transition is None else self._follow(robot, transition, row.response.name)
        name = name or ("override" if row.refused else "")
        if name:
            LOG.info("%s: surprise %.3g, threshold %.3g%s", name, row.surprise, self.threshold[robot], row.response.why)
        acted_on = row.over or row.knocked or row.presses or name == "trial"
        return Decision(name, transition is not None and transition.to is State.REFLEX, acted_on)

    def take_over(self, robot: int) -> None:
        """Let the reflex act from now on."""
        i, rule, counts = robot, self._rule, self.counts
        if self.state[i] == TRIAL and counts[SINCE, i] <= rule.release_after:
            self._wait[i] *= 2 if self._on_trial[i] else 1
            counts[RETURNED, i] += 1
        else:
            self._wait[i], counts[[ACTED, RETURNED], i] = rule.try_after, 0
        counts[[HELD, FREE, CALM], i] = 0
        self.state[i] = REFLEX

    def _count(self, robot: int, row: Judged) -> Situation:
        """Count the row, and return what it comes to."""
        i, rule, response, counts = robot, self._rule, row.response, self.counts
        overriding = self.state[i] == REFLEX
        low = row.surprise <= self.threshold[i] * (RELEASE_BELOW if row.intervened else 1.0)
        counts[CALM, i] = counts[CALM, i] + 1 if low and not row.alarm else 0
        counts[FREE, i] = counts[FREE, i] + 1 if response.touched is False and row.intervened else 0
        goes_on = response.name in GOING_ON and not row.presses
        if row.intervened:
            # Where nobody knows what is sensed, no trial comes nearer.
            counts[ACTED, i] += 1
            counts[HELD, i] = counts[HELD, i] + 1 if math.isfinite(row.surprise) else 0
            # What the arm feels when it changes over to the reflex confirms nothing yet.
            self.confirmed[i] |= row.alarm and counts[HELD, i] > rule.release_after
        else:
            counts[SINCE, i] += 1
            counts[WENT_ON, i] += row.alarm and goes_on
            counts[STRIKES, i] += row.presses
        if overriding and row.alarm and response.name not in ("", *GOING_ON):
            self.response[i] = response.name
        stopping = self.response[i] == "stop"  # a fault that is calm while nothing is asked of the robot has not gone
        calm, acted, held, free, returned, since, _, strikes, _, _ = counts[:, i].tolist()
        return Situation(
            alarm=row.alarm,
            presses=row.presses,
            spent=strikes >= rule.strikes or row.impulse > rule.impulse,
            goes_on=goes_on and (response.name == "complete" or not overriding),
            stops=stopping and held >= rule.try_after,
            overdue=acted >= rule.max_override,
            calm=not stopping and calm >= rule.release_after and not response.touched,
            free=not (stopping or row.presses) and free >= rule.free_after << min(returned, 16),
            waited=not (stopping or row.presses) and held >= self._wait[i] and response.touched is None,
            settled=since > rule.release_after,
        )

    def _follow(self, robot: int, transition: Transition, response: str) -> str:
        """Change the state; return what is to be said of it."""
        if transition.to is State.REFLEX:
            self.response[robot] = response
            self.take_over(robot)
        elif transition.to is not None:
            self.state[robot] = STATES.index(transition.to)
            if transition.to is State.TRIAL:
                self.counts[SINCE, robot] = self.counts[CALM, robot] = 0
                self._on_trial[robot] = transition.name == "trial"
        return response if transition.name == "*" else transition.name
