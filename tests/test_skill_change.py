"""A change of skill: when it is followed, and what is put down to it."""

from __future__ import annotations

import math
from dataclasses import replace
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

from asm_gym.episode import Episode
from asm_gym.scripts.reproduce import skill_change, skill_names
from asm_gym.scripts.reproduce.skill_switch import Switch
from asm_gym.spec import MOTOR, Channel, StreamSpec

SPEC = StreamSpec((Channel("x", 2, "m"),), dt=0.1)


def episode(value: float, steps: int, skill: str = "a") -> Episode:
    noise = np.random.default_rng(steps).normal(0.0, 0.1, (steps, 2))
    return Episode.from_stream(value + noise, SPEC, info={"skill": skill})


def changed(first: float, then: float, at: int, steps: int) -> Switch:
    stream = np.concatenate([episode(first, at).stream, episode(then, steps - at).stream])
    info = {"skills": ["a", "b"], "changed": at}
    return Switch(Episode.from_stream(stream, SPEC, info=info), np.repeat(["a", "b"], [at, steps - at]), at)


def test_it_is_right_for_good_from_the_last_wrong_step_on():
    assert skill_change.for_good(np.array([False, True, False, True, True]), 0.5) == pytest.approx(1.5)
    assert skill_change.for_good(np.array([True, True]), 0.5) == 0.0
    assert math.isinf(skill_change.for_good(np.array([True, False]), 0.5))


def test_a_forest_follows_a_change_once_the_new_moments_outweigh_the_old():
    told = [episode(v, 40, s) for v, s in ((-1.0, "a"), (1.0, "b")) for _ in range(3)]
    found = skill_names.by_forest(told, told[:1], [changed(-1.0, 1.0, 30, 90)], seed=0)
    assert found.nominal[0].all()
    (right,) = found.switched
    assert len(right) == 60
    assert not right[0]
    # Moments are forgotten by a tenth a step: what is left of thirty is outweighed once 1 - 0.9**n passes a half.
    assert skill_change.for_good(right, 1.0) == pytest.approx(math.ceil(math.log(0.5) / math.log(0.9)) - 1, abs=1)


def hands(points: list[list[float]], closed: int, skill: str) -> Episode:
    spec = StreamSpec((Channel("hand_position", 3, "m"), Channel("action", 1, group=MOTOR)), dt=0.1)
    command = np.where(np.arange(len(points)) < closed, -1.0, 1.0)
    return Episode.from_stream(np.column_stack([points, command]), spec, info={"skill": skill})


def test_a_forest_that_was_shown_other_changes_follows_where_single_skills_say_nothing():
    told = [episode(v, 40, s) for v, s in ((-1.0, "a"), (-3.0, "b")) for _ in range(3)]
    switches = [changed(-1.0, 1.0, 30, 60 + n) for n in range(6)]
    told_alone = skill_names.by_forest(told, [], switches, seed=0)
    shown = skill_names.by_forest_shown(told, told[:1], switches, seed=0)
    assert shown.nominal[0].all()
    assert skill_change.share_right(shown.switched, 15) == 1.0
    assert skill_change.share_right(told_alone.switched, 15) == 0.0


class Teller:
    """A memory that names as a change it was shown, and says which those were."""

    def __init__(self) -> None:
        self.told: list[int] = []

    def name_skills(self, episodes: list[Episode]) -> Teller:
        self.told = [e.info["changed"] for e in episodes if "changed" in e.info]
        return self

    def skills(self, stream: np.ndarray) -> np.ndarray:
        return np.where(np.isin(len(stream), np.add(self.told, 30)), "b", "a").repeat(len(stream))


def test_no_memory_is_asked_for_a_change_that_it_was_shown():
    told = [episode(v, 40, s) for v, s in ((-1.0, "a"), (1.0, "b"))]
    switches = [changed(-1.0, 1.0, at, at + 30) for at in (20, 21, 22, 23, 24)]
    memory = cast(Any, Teller())
    found = skill_names.by_memory_shown(memory, told, told, switches)
    assert not np.concatenate(found.switched).any()  # whoever was shown a change of that length names it
    assert [r.all() for r in found.nominal] == [True, False]
    assert memory.told == []
    asked = memory.name_skills([s.episode for s in switches]).skills(switches[0].episode.stream)
    assert (asked == "b").all()


def test_the_hand_is_nearer_to_the_new_skill_from_half_way_on():
    told = [hands([[x, 0.0, 0.0]] * 3, 1, skill) for x, skill in ((0.0, "a"), (1.0, "b"))]
    way = hands([[x, 0.0, 0.0] for x in (0.0, 0.0, 0.2, 0.4, 0.6, 0.8)], 6, "a")
    found = skill_names.by_place(told, [Switch(way, np.repeat(["a", "b"], [2, 4]), 2)])
    np.testing.assert_array_equal(found.switched[0], [False, False, True, True])


def test_a_lift_is_asked_as_long_after_its_grasp_as_a_stack_leaves_for_the_side():
    stack = hands([[0.0, 0.0, 0.0]] * 4 + [[0.0, 0.0, 0.1]] * 3 + [[0.03, 0.0, 0.1]] * 3, 4, "Stack")
    lift = hands([[0.0, 0.0, 0.0]] * 2 + [[0.01, 0.0, 0.1]] * 8, 2, "Lift")
    assert skill_names.partings([lift, hands([[0.0] * 3] * 3, 1, "Door"), stack]) == [5, None, 7]


def test_an_alarm_is_put_down_to_the_change_where_it_comes_within_two_seconds():
    def score(e: Episode) -> Any:
        return SimpleNamespace(value=np.where(np.arange(len(e)) == len(e) - 1, 9.0, 0.0))

    memory = cast(Any, SimpleNamespace(score=score, threshold=4.0))
    late, soon = changed(0.0, 1.0, 30, 90), changed(0.0, 1.0, 30, 45)
    records = skill_change.alarms(memory, [episode(0.0, 20)], [late, soon])
    assert [r["alarm"] for r in records] == [True, True, True]
    assert [r["after_change"] for r in records[1:]] == [False, True]
    table = skill_change.alarms_table(records)
    assert [(*row[:2], row[3]) for row in table.rows] == [
        ("a", "1 of 1", "1 of 1"),
        ("change", "2 of 2", "2 of 2"),
        ("change, alarm in the 2 s after it", "1 of 2", "1 of 2"),
    ]


def test_episodes_that_crash_stand_apart():
    def score(e: Episode) -> Any:
        return SimpleNamespace(value=np.full(len(e), e.contact_force.max(initial=0.0)))

    memory = cast(Any, SimpleNamespace(score=score, threshold=40.0))
    felt = [replace(episode(0.0, 20), contact_force=np.full(20, f, np.float32)) for f in (9.0, 11.0, 10.0, 50.0)]
    records = skill_change.alarms(memory, felt, [changed(0.0, 1.0, 30, 90)])
    assert [r["crash"] for r in records] == [False, False, False, True, False]
    assert skill_change.alarms_table(records).rows[0][1::2] == ("1 of 4", "0 of 3")
