"""What leads from the policy to the reflex and back: four states, and one table of transitions."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from enum import StrEnum
from typing import NamedTuple, Self

from asm_gym.validation import check_number

GOING_ON = ("go on", "complete")
"""Responses to an alarm under which the policy acts."""


class State(StrEnum):
    """Who acts."""

    POLICY = "policy"
    TRIAL = "trial"
    """The policy again, so recently that what comes back had not gone."""
    REFLEX = "reflex"
    ENDED = "ended"


class Situation(NamedTuple):
    """What a row has come to, as far as it decides who acts next.

    Attributes:
        alarm: surprise is over the threshold, or something failed or is missing.
        presses: a contact limit was passed within the step.
        spent: it has pressed too often, or with too much impulse, in this episode.
        goes_on: the response lets the policy act: one of ``GOING_ON``.
        stops: the response ends the episode, and has been held for long enough.
        overdue: the reflex has acted for as long as it may.
        quiet: surprise has been low for long enough, and nothing touches.
        free: what touched has been gone for long enough, and nothing presses.
        waited: the reflex has acted for long enough for a trial, nothing presses, and nobody knows whether something
            touches.
        settled: the trial has gone well for long enough.
    """

    alarm: bool = False
    presses: bool = False
    spent: bool = False
    goes_on: bool = False
    stops: bool = False
    overdue: bool = False
    quiet: bool = False
    free: bool = False
    waited: bool = False
    settled: bool = False


class Transition(NamedTuple):
    """A row of the table: in one of the states ``within``, ``when`` it holds, ``to`` is next."""

    name: str  # as ``info["asm"]["transition"]`` says it; empty for nothing to say, "*" for the response's own name
    within: tuple[State, ...]
    to: State | None  # None for the same
    when: Callable[[Situation], bool]
    why: str


_POLICY = State.POLICY, State.TRIAL
TRANSITIONS = (
    Transition("give_up", (*_POLICY, State.REFLEX), State.ENDED, lambda s: s.spent, "pressed too often or too much"),
    Transition("override", _POLICY, State.REFLEX, lambda s: s.presses, "presses harder than healthy motion"),
    Transition("*", _POLICY, None, lambda s: s.alarm and s.goes_on, "an alarm whose cause lets the policy go on"),
    Transition("override", _POLICY, State.REFLEX, lambda s: s.alarm, "any other alarm"),
    Transition("", (State.TRIAL,), State.POLICY, lambda s: s.settled, "no alarm for `release_after`"),
    Transition(
        "*", (State.REFLEX,), State.TRIAL, lambda s: s.alarm and s.goes_on, "the cause turns out to be a sensor"
    ),
    Transition(
        "release", (State.REFLEX,), State.TRIAL, lambda s: s.quiet, "quiet for `release_after`, nothing touches"
    ),
    Transition("release", (State.REFLEX,), State.TRIAL, lambda s: s.free, "what touched has gone"),
    Transition("give_up", (State.REFLEX,), State.ENDED, lambda s: s.stops, "response `stop`, held for `try_after`"),
    Transition("give_up", (State.REFLEX,), State.ENDED, lambda s: s.overdue, "acted for `max_override`"),
    Transition(
        "trial", (State.REFLEX,), State.TRIAL, lambda s: s.waited, "held for `try_after`, nothing known to touch"
    ),
)
"""What leads from one state to another: the first that holds. Where none does, nothing changes."""


_FROM = {state: tuple(t for t in TRANSITIONS if state in t.within) for state in State}


def following(state: State, situation: Situation) -> Transition | None:
    """The first of ``TRANSITIONS`` that holds; None where nothing changes."""
    return next((t for t in _FROM[state] if t.when(situation)), None)


@dataclass(frozen=True)
class ReleaseRule:
    """When control is handed back, and when the episode ends.

    Args:
        release_after: control steps of quiet after which it is.
        release_below: share of the threshold, in (0, 1], that surprise must be under to count as quiet.
        max_override: control steps for which a reflex may act. Those before a hand-back after which the alarm is back
            within ``release_after`` steps count too: what comes back at once has not gone. None for as many as it
            takes.
        try_after: control steps after which control is handed back on trial though surprise is not quiet, for a robot
            that holds still where it never did may surprise itself; after each trial that fails, twice as many. None
            for no trials.
        free_after: control steps in which nothing presses any more, after which a contact is over though surprise is
            not quiet; after each hand-back that was too early, twice as many.
        strikes: how often the policy may pass a contact limit before the episode ends. None for as often as it does.
        impulse: how much it may press in an episode, beyond what healthy motion does [N s]. None for any.
        go_on: control steps in alarm in an episode for which the policy may go on; the robot holds at all later alarms.
    """

    release_after: int = 10
    release_below: float = 0.8
    max_override: int | None = None
    try_after: int | None = None
    free_after: int = 5
    strikes: int | None = None
    impulse: float | None = None
    go_on: int = 100

    def __post_init__(self) -> None:
        check_number("release_after", self.release_after, low=1, whole=True)
        check_number("release_below", self.release_below, above=0, high=1)
        for name in ("max_override", "try_after"):
            number = getattr(self, name)
            if number is not None:
                check_number(name, number, low=1, whole=True)

    def in_rows(self, each: int) -> Self:
        """The same, counted in rows of a stream that has ``each`` of them in a control step."""
        longest = None if self.max_override is None else each * self.max_override
        wait = None if self.try_after is None else each * self.try_after
        names = "release_after", "free_after", "go_on"
        rows = {name: each * getattr(self, name) for name in names}
        return replace(self, max_override=longest, try_after=wait, **rows)
