"""A change of skill: when it is followed, and what is put down to it."""

from __future__ import annotations

import math
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

from asm_gym.episodes import Episode
from asm_gym.scripts.reproduce import skill_change
from asm_gym.scripts.reproduce.skill_switch import Switch
from asm_gym.stream import Channel, StreamSpec

SPEC = StreamSpec((Channel("x", 2, "m"),), dt=0.1)


def episode(value: float, steps: int, skill: str = "a") -> Episode:
    noise = np.random.default_rng(steps).normal(0.0, 0.1, (steps, 2))
    return Episode.from_stream(value + noise, SPEC, info={"skill": skill})


def changed(first: float, then: float, at: int, steps: int) -> Switch:
    stream = np.concatenate([episode(first, at).stream, episode(then, steps - at).stream])
    return Switch(Episode.from_stream(stream, SPEC), np.repeat(["a", "b"], [at, steps - at]), at)


def test_it_is_right_for_good_from_the_last_wrong_step_on():
    assert skill_change.for_good(np.array([False, True, False, True, True]), 0.5) == pytest.approx(1.5)
    assert skill_change.for_good(np.array([True, True]), 0.5) == 0.0
    assert math.isinf(skill_change.for_good(np.array([True, False]), 0.5))


def test_a_forest_follows_a_change_once_the_new_moments_outweigh_the_old():
    told = [episode(v, 40, s) for v, s in ((-1.0, "a"), (1.0, "b")) for _ in range(3)]
    found = skill_change.by_forest(told, told[:1], [changed(-1.0, 1.0, 30, 90)], seed=0)
    assert found.nominal[0].all()
    (right,) = found.switched
    assert len(right) == 60
    assert not right[0]
    # Moments are forgotten by a tenth a step: what is left of thirty is outweighed once 1 - 0.9**n passes a half.
    assert skill_change.for_good(right, 1.0) == pytest.approx(math.ceil(math.log(0.5) / math.log(0.9)) - 1, abs=1)


def test_an_alarm_is_put_down_to_the_change_where_it_comes_within_two_seconds():
    def score(e: Episode) -> Any:
        return SimpleNamespace(value=np.where(np.arange(len(e)) == len(e) - 1, 9.0, 0.0))

    memory = cast(Any, SimpleNamespace(score=score, threshold=4.0))
    late, soon = changed(0.0, 1.0, 30, 90), changed(0.0, 1.0, 30, 45)
    records = skill_change.alarms(memory, [episode(0.0, 20)], [late, soon])
    assert [r["alarm"] for r in records] == [True, True, True]
    assert [r["after_change"] for r in records[1:]] == [False, True]
    table = skill_change.alarms_table(records)
    assert [row[:2] for row in table.rows] == [
        ("a", "1 of 1"),
        ("change", "2 of 2"),
        ("change, alarm in the 2 s after it", "1 of 2"),
    ]
