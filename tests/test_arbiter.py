"""Who acts next: one table of transitions, searched by a machine that tries whatever rows there may be."""

import math
import warnings
from itertools import product
from pathlib import Path

import numpy as np
import pytest
from asm_gym.wrappers.arbiter import Arbiter, Sensed
from asm_gym.wrappers.factory import make_fallback
from asm_gym.wrappers.responses import RESPONSES
from asm_gym.wrappers.transitions import GOING_ON, TRANSITIONS, ReleaseRule, Situation, State, following
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, invariant, rule

from asm_gym.policies.reflexes import Graded
from tests.fakes import FakeEnv

ACTING = (State.POLICY, State.TRIAL)
ACT = np.array([0.5, -0.5, 1.0], np.float32)


def situations():
    fields = Situation._fields
    return (Situation(*values) for values in product((False, True), repeat=len(fields)))


def reachable(situation):
    """What ``Arbiter`` never says together: control is handed back only where nothing presses."""
    return not (situation.presses and (situation.quiet or situation.free or situation.waited or situation.goes_on))


@pytest.mark.parametrize("state", State)
def test_from_every_state_nothing_leads_to_the_policy_while_the_arm_presses(state):
    for situation in situations():
        if situation.presses and reachable(situation) and state is not State.ENDED:
            found = following(state, situation)
            after = state if found is None or found.to is None else found.to
            assert after in (State.REFLEX, State.ENDED), (situation, found)


@pytest.mark.parametrize("state", ACTING)
def test_every_alarm_of_the_policy_is_answered_with_something_that_is_said(state):
    for situation in situations():
        if situation.alarm and reachable(situation):
            found = following(state, situation)
            assert found is not None, situation
            assert found.name, situation


def test_nothing_leads_out_of_the_reflex_without_a_name_and_a_reason():
    for t in TRANSITIONS:
        assert t.why
        if State.REFLEX in t.within and t.to is not None:
            assert t.name


def test_an_ended_episode_stays_ended():
    assert all(following(State.ENDED, s) is None for s in situations())


@given(
    st.lists(
        st.tuples(
            st.sampled_from([0.0, 0.9, 2.0, math.inf]),
            st.booleans(),
            st.sampled_from(["", *RESPONSES]),
            st.sampled_from([None, True, False]),
            st.booleans(),
        ),
        max_size=60,
    )
)
@settings(max_examples=200, deadline=None)
def test_whatever_the_rows_a_pressing_arm_is_never_left_to_the_policy(rows):
    env = FakeEnv()
    arbiter = Arbiter(
        Graded(env), 1.0, ReleaseRule(3, try_after=3, max_override=9, strikes=3), make_fallback(env), env.action_space
    )
    strikes = 0
    for surprise, presses, response, touched, ends in rows:
        if arbiter.state is State.ENDED:
            break
        before = arbiter.state
        said = arbiter.decide(
            Sensed(surprise, np.zeros(5), ACT, presses=presses, response=response, touched=touched, ends_step=ends)
        )
        strikes += presses and before in ACTING
        assert said.alarm == (presses or not surprise <= 1.0)
        if presses:
            assert arbiter.state in (State.REFLEX, State.ENDED)
        if before is State.REFLEX and arbiter.state is not State.REFLEX:
            assert said.transition in ("release", "trial", "give_up", *GOING_ON)
        if said.alarm and before in ACTING and arbiter.state in ACTING:
            assert response in GOING_ON
        assert strikes <= 3
        assert (arbiter.state is State.ENDED) == said.gave_up


class Episodes(RuleBasedStateMachine):
    """Rows, commands and resets in any order."""

    def __init__(self):
        super().__init__()
        self.env = FakeEnv()
        self.limits = ReleaseRule(2, try_after=2, max_override=6, strikes=3, impulse=5.0, go_on=4)
        self.arbiter = Arbiter(Graded(self.env), 1.0, self.limits, make_fallback(self.env), self.env.action_space)
        self.went_on = 0

    @rule(
        surprise=st.sampled_from([0.0, 0.9, 2.0, math.inf]),
        presses=st.booleans(),
        response=st.sampled_from(["", *RESPONSES]),
        touched=st.sampled_from([None, True, False]),
        impulse=st.sampled_from([0.0, 4.9, 5.1]),
    )
    def row(self, surprise, presses, response, touched, impulse):
        arbiter = self.arbiter
        if arbiter.state is State.ENDED:
            return
        if response == "go on" and not arbiter.may_go_on:
            response = "hold"  # as the responder does
        said = arbiter.decide(Sensed(surprise, np.zeros(5), ACT, None, presses, impulse, response, touched))
        self.went_on += said.transition == "go on"
        if impulse > 5.0:
            assert arbiter.state is State.ENDED

    @rule(action=st.sampled_from([ACT, 9 * ACT, np.full(3, np.nan, np.float32)]))
    def command(self, action):
        if self.arbiter.state is State.ENDED:
            return
        acts = self.arbiter.state in ACTING and np.isfinite(action).all()
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # that such an action is none is said, which other tests ask for
            done = self.arbiter.command(action, np.zeros(2, np.float32))
        assert self.env.action_space.contains(done.action)
        np.testing.assert_array_equal(done.action, np.clip(action, -1, 1) if acts else [0, 0, done.action[2]])

    @rule()
    def begin(self):
        self.arbiter.reset()
        self.went_on = 0
        assert self.arbiter.state is State.POLICY

    @invariant()
    def nobody_goes_on_for_longer_than_is_allowed(self):
        assert self.went_on <= self.limits.go_on


TestEpisodes = Episodes.TestCase
TestEpisodes.settings = settings(max_examples=60, stateful_step_count=40, deadline=None)


def test_the_documentation_has_every_transition_in_order():
    page = (Path(__file__).parents[1] / "docs" / "guides" / "the_guard.md").read_text(encoding="utf-8")
    rows = [
        line.strip("| ").split(" | ")
        for line in page.splitlines()
        if line.startswith(("| policy", "| trial", "| reflex"))
    ]
    assert [row[1] for row in rows] == [t.why for t in TRANSITIONS]
    for row, t in zip(rows, TRANSITIONS, strict=True):
        assert row[0].split(", ") == [str(state) for state in t.within]
        assert row[2] == ("the same" if t.to is None else str(t.to))
