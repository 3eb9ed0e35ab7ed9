"""What leads from the policy to the reflex and back: four states, and one table of transitions."""

from __future__ import annotations

from collections.abc import Callable
from enum import StrEnum
from typing import NamedTuple


class State(StrEnum):
    """Who acts."""

    POLICY = "policy"
    TRIAL = "trial"
    """The policy again, so recently that an alarm which comes back had not gone."""
    REFLEX = "reflex"
    ENDED = "ended"


class Situation(NamedTuple):
    """All that a row tells the table of transitions.

    Attributes:
        alarm: surprise is over the threshold, or something failed, is missing or presses.
        presses: a contact limit was passed within the step.
        spent: the arm has pressed too often, or with too much impulse, in this episode.
        goes_on: the response lets the policy act.
        stops: the response ends the episode, and has been held for long enough.
        overdue: the reflex has acted for as long as it may.
        calm: surprise has been low for long enough, and nothing touches.
        free: the contact has been gone for long enough, and nothing presses.
        waited: the reflex has acted for long enough for a trial, nothing presses, and no sense tells of a contact.
        settled: the trial has gone well for long enough.
    """

    alarm: bool = False
    presses: bool = False
    spent: bool = False
    goes_on: bool = False
    stops: bool = False
    overdue: bool = False
    calm: bool = False
    free: bool = False
    waited: bool = False
    settled: bool = False


class Transition(NamedTuple):
    """A row of the table: in one of the states ``within``, where ``when`` holds, ``to`` is next."""

    name: str  # as ``info["asm"]["transition"]`` says it; empty for none, "*" for the response's own name
    within: tuple[State, ...]
    to: State | None  # None: the state stays
    when: Callable[[Situation], bool]
    why: str


POLICY_ACTS = State.POLICY, State.TRIAL
REFLEX_ACTS = (State.REFLEX,)
TRANSITIONS = (
    Transition(
        "give_up", (*POLICY_ACTS, State.REFLEX), State.ENDED, lambda s: s.spent, "pressed too often or too much"
    ),
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
