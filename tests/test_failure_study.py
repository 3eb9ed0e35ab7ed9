"""The study of failures: its figures by hand, and what weakens an agent."""

from __future__ import annotations

import numpy as np
import pytest

from asm_gym.episode import Episode
from asm_gym.policies.network import NetworkPolicy
from asm_gym.scripts.reproduce import failure
from asm_gym.scripts.reproduce.failure import (
    AGENTS,
    Config,
    Verdict,
    Weakened,
    inconsistency,
    labels,
    separated,
    table,
)
from asm_gym.spec import Channel, StreamSpec

INF = float("inf")


def seen(failed, how, half, alarmed=INF):
    return Verdict(failed, how, [0.0, half, half], alarmed)


WATCHED = [
    seen(False, "as it is", 1.0),
    seen(False, "as it is", 2.0, alarmed=0.9),
    seen(True, "as it is", 3.0, alarmed=0.6),
    seen(False, "weakened", 1.5),
    seen(True, "weakened", 4.0, alarmed=0.4),
    seen(True, "disturbed", 1.75),
]


def test_failures_are_told_from_successes_by_rank_and_nothing_is_said_where_all_are_alike():
    assert separated(WATCHED, 1).value == pytest.approx(8 / 9)  # one of nine pairs is the wrong way round
    assert separated(WATCHED, 0).value == 0.5
    assert np.isnan(separated([w for w in WATCHED if w.failed], 1).value)


def test_the_table_counts_what_was_known_by_when():
    (row,) = table({"one": WATCHED}, Config()).rows
    assert row[2].startswith("0.889 (")
    assert row[4:] == ("1 of 3", "2 of 3", "1 of 2")


def test_inconsistency_adds_up_the_changes_of_commands():
    spec = StreamSpec((Channel("sense", 1), Channel("action", 4, group="action")), dt=0.1)
    stream = np.random.default_rng(0).normal(size=(30, 5))
    changes = np.linalg.norm(np.diff(stream[:, 1:], axis=0), axis=1)
    np.testing.assert_allclose(inconsistency(Episode.from_stream(stream, spec))[-1], changes.sum(), rtol=1e-6)


def test_an_agent_is_weakened_anew_by_each_seed_and_alike_by_the_same(monkeypatch):
    rng = np.random.default_rng(0)
    agent = NetworkPolicy([(rng.normal(size=(2, 3)).astype(np.float32), np.zeros(2, np.float32))], "relu", "tanh")
    whole, said = agent.predict(np.ones(3))[0], []
    monkeypatch.setattr(failure, "make_policy", lambda name, env: agent)
    policy = Weakened(None, "agent")
    for seed in (1, 2, 1):
        policy.set_random_seed(seed)
        said.append(policy.predict(np.ones(3))[0])
    np.testing.assert_array_equal(said[0], said[2])
    assert len({tuple(a) for a in (whole, *said)}) == 3


def test_roles_and_repetitions_share_no_seed_and_every_disturbance_has_its_turn():
    args = Config(tasks=tuple(AGENTS), episodes=8)
    made = [*labels(args, 0), *labels(args, 1)]
    assert len({(x.task, x.seed) for x in made}) == len(made) == 2 * 3 * 5 * 8
    assert len({(x.task, x.kind) for x in made if x.role == "disturbed"}) == 12
    assert {x.role for x in made if x.onset is None} == {"fit", "calibration", "as_it_is", "weakened"}


def test_settings_that_cannot_be_judged_are_refused():
    for wrong, says in (
        ({"tasks": ("Wipe",)}, "Lift, Stack, Door"),
        ({"monitors": ("none",)}, "memory_skill"),
        ({"episodes": 1}, "episodes must be at least 2"),
        ({"false_alarm_rate": 0.0}, "false_alarm_rate"),
    ):
        with pytest.raises(ValueError, match=says):
            Config(**wrong)
