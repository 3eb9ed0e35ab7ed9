"""Who acts next: one table of transitions, searched by a machine that tries whatever rows there may be."""

import math
from itertools import product

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from asm_gym.guard.alarm_terms import CONTACT, SURPRISE
from asm_gym.guard.arbiter import POLICY_ACTS, Arbiter, Situation, following
from asm_gym.guard.options import ReleaseRule
from asm_gym.guard.reflexes import COMPLIANCE, FeltMotion, leaving
from asm_gym.guard.responses import GOING_ON, NO_RESPONSE, RESPONSES
from asm_gym.guard.robot_facts import RobotFacts
from asm_gym.guard.robot_table import ENDED, POLICY, REFLEX, STATES, RobotTable
from asm_gym.guard.row_evidence import RowEvidence
from asm_gym.spec import MOTOR, Channel, StreamSpec

SPEC = StreamSpec((Channel("external_torque", 2), Channel("action", 2, group=MOTOR)), 0.05)
EVERYONE = np.ones(1, bool)


def situations():
    fields = Situation._fields
    return (Situation(*values) for values in product((False, True), repeat=len(fields)))


def reachable(situation):
    """What ``Arbiter`` never says together: control is handed back only where nothing presses."""
    return not (
        situation.presses
        and (
            situation.surprise_low
            or situation.contact_gone
            or situation.trial_due
            or situation.goes_on
        )
    )


@pytest.mark.parametrize("state", range(len(STATES)))
def test_from_every_state_nothing_leads_to_the_policy_while_the_arm_presses(state):
    for situation in situations():
        if situation.presses and reachable(situation) and state != ENDED:
            found = following(state, situation)
            after = state if found is None or found.to is None else found.to
            assert after in (REFLEX, ENDED), (situation, found)


@pytest.mark.parametrize("state", POLICY_ACTS)
def test_every_alarm_of_the_policy_is_answered_with_something_that_is_said(state):
    for situation in situations():
        if situation.alarm and reachable(situation):
            found = following(state, situation)
            assert found is not None, situation
            assert found.name, situation


def test_an_ended_episode_stays_ended():
    assert all(following(ENDED, s) is None for s in situations())


def table_of(count=1):
    return RobotTable(count, SPEC, 1.0)


def evidence(table, surprise, presses=False, impulse=0.0, index=0):
    """A row of a robot whose record says so."""
    robot = table.robot(index)
    robot.surprise, robot.over, robot.presses, robot.pressed_impulse = (
        surprise,
        not surprise <= 1.0,
        presses,
        impulse,
    )
    robot.overridden = robot.state == REFLEX
    terms = [name for name, holds in ((CONTACT, presses), (SURPRISE, robot.over)) if holds]
    nothing = np.zeros(SPEC.size)
    return RowEvidence(
        index=index,
        robot=robot,
        rows=nothing[None].astype(np.float32),
        attribution=nothing,
        accounted_for=nothing.astype(bool),
        terms=tuple(terms),
        contradiction=None,
        completed=None,
        may_go_on=True,
    )


def decided(arbiter, table, surprise, presses=False, response="", touched=None, impulse=0.0):
    """Whether a row is an alarm, and what it led to."""
    row = evidence(table, surprise, presses, impulse)
    return row.alarm, arbiter.decide(row, NO_RESPONSE._replace(name=response, touched=touched))


@given(
    st.lists(
        st.tuples(
            st.sampled_from([0.0, 0.9, 2.0, math.inf]),
            st.booleans(),
            st.sampled_from(["", *RESPONSES]),
            st.sampled_from([None, True, False]),
        ),
        max_size=60,
    )
)
@settings(max_examples=200, deadline=None)
def test_whatever_the_rows_a_pressing_arm_is_never_left_to_the_policy(rows):
    table = table_of()
    arbiter = Arbiter(table, ReleaseRule(3, try_after=3, max_override=9, strikes=3))
    robot = table.robot(0)
    strikes = 0
    for surprise, presses, response, touched in rows:
        before = int(robot.state)
        if before == ENDED:
            break
        alarm, said = decided(arbiter, table, surprise, presses, response, touched)
        after = int(robot.state)
        strikes += presses and before in POLICY_ACTS
        if presses:
            assert after in (REFLEX, ENDED)
        if before == REFLEX and after != REFLEX:
            assert said.transition in ("release", "trial", "give_up", *GOING_ON)
        if alarm and before in POLICY_ACTS and after in POLICY_ACTS:
            assert response in GOING_ON
        assert strikes <= 3


def held_by_a_contact():
    table = table_of()
    arbiter = Arbiter(table, ReleaseRule(10, try_after=10))
    assert decided(arbiter, table, 2.0, response="hold")[1].transition == "override"
    return lambda surprise, **kw: decided(arbiter, table, surprise, **kw)[1].transition


def test_control_goes_back_once_nothing_presses_though_surprise_is_not_low_and_later_each_time_it_was_too_early():
    decide = held_by_a_contact()
    assert [decide(0.9, touched=False) for _ in range(5)] == [*[""] * 4, "release"]
    assert decide(2.0, response="hold") == "override"
    assert [decide(0.9, touched=False) for _ in range(10)] == [*[""] * 9, "release"]


def test_control_does_not_go_back_while_something_presses_though_surprise_is_low():
    decide = held_by_a_contact()
    assert {decide(0.0, touched=True) for _ in range(30)} == {""}
    assert decide(0.0, touched=None) == "release"


def test_an_episode_that_begins_leaves_the_other_robots_as_they_are():
    table = table_of(2)
    arbiter = Arbiter(table, ReleaseRule())
    for index in range(2):
        arbiter.decide(evidence(table, 2.0, index=index), NO_RESPONSE)
    for part in (table, arbiter):
        part.begin(np.array([True, False]))
    assert table.records["state"].tolist() == [POLICY, REFLEX]


def reflexes(
    on_alarm: str, spec: StreamSpec = SPEC, refused: dict[str, str] | None = None
) -> FeltMotion:
    low, rest, high = (np.full(2, value, np.float32) for value in (-1, 0, 1))
    robots = RobotFacts(
        1,
        low,
        high,
        rest,
        dt=0.05,
        turning_action=lambda _, turns: np.float32(turns),
        refused=refused or {},
    )
    made = FeltMotion.of(robots, spec, on_alarm)
    made.begin(np.ones(1, bool))
    return made


def test_retract_undoes_the_last_actions_newest_first_and_then_stays():
    felt = reflexes("retract")
    felt.arrays.path[0, -2:, 0], felt.arrays.path_steps[0] = (0.2, 0.3), 2
    moves = [felt.move(0, "retract").action[0] for _ in range(3)]
    np.testing.assert_allclose(moves, [-0.3, -0.2, 0.0], rtol=1e-6)


def test_comply_gives_way_beyond_what_is_usual_and_tolerated():
    felt = reflexes("comply")
    felt.arrays.torque[0], felt.arrays.usual_torque[0] = [5.0, -9.0], [0.0, -5.0]
    beyond = np.array([3.0, -2.0])
    np.testing.assert_allclose(felt.move(0, "comply").action, COMPLIANCE * 0.05 * beyond, rtol=1e-6)
    felt.arrays.torque[0] = felt.arrays.usual_torque[0]
    assert not felt.move(0, "comply").action.any()


def test_what_a_policy_asks_away_from_a_contact_is_done_and_nothing_else():
    felt = reflexes("graded")
    felt.arrays.torque[0] = [10.0, 0.0]
    away = leaving(felt, 0, np.float32([0.8, -0.6]))
    np.testing.assert_allclose(away.action, [0.8, 0.0], rtol=1e-6)
    assert not away.brakes
    for towards in ([-0.8, 0.6], [0.0, 1.0]):
        assert leaving(felt, 0, np.float32(towards)) is None
    felt.arrays.torque[0] = [3.0, 0.0]  # which is tolerated
    assert leaving(felt, 0, np.float32([0.8, -0.6])) is None


def test_a_reflex_that_the_robots_cannot_do_is_refused_and_graded_stays_instead():
    blind = StreamSpec((Channel("position", 2), Channel("action", 2, group=MOTOR)), 0.05)
    with pytest.raises(ValueError, match="external_torque"):
        reflexes("comply", blind)
    with pytest.raises(ValueError, match="OSC_POSE"):
        reflexes("retract", refused={"retract": "retract needs OSC_POSE"})
    graded = reflexes("graded", blind)
    graded.expected[0] = 0.7
    assert not graded.move(0, "comply").action.any()
