"""The study of failures: its figures by hand, and what weakens an agent."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.stats import multivariate_normal

from asm_gym.episode import Episode
from asm_gym.monitors import Surprise
from asm_gym.policies.network import NetworkPolicy
from asm_gym.scripts.reproduce import failure
from asm_gym.scripts.reproduce.failure import (
    AGENTS,
    Config,
    Watched,
    entropy,
    inconsistency,
    labels,
    scored,
    separated,
    table,
)
from asm_gym.scripts.reproduce.weakened import Weakened
from asm_gym.spec import Channel, StreamSpec

INF = float("inf")


def seen(failed, how, half, alarmed=INF):
    return Watched(failed, how, (0.0, half, half), alarmed)


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


SPEC = StreamSpec((Channel("sense", 1), Channel("action", 4, group="action")), dt=0.1)


def commanded(actions):
    """An episode (T, 5) in which these actions (T, 4) are commanded."""
    return Episode.from_stream(np.hstack([np.zeros((len(actions), 1)), actions]), SPEC, success=True)


def test_inconsistency_adds_up_and_entropy_is_that_of_a_gaussian_in_closed_form():
    rng = np.random.default_rng(0)
    walk = commanded(rng.normal(size=(30, 4)))
    np.testing.assert_allclose(
        inconsistency(walk)[-1], np.linalg.norm(np.diff(walk.stream[:, 1:], axis=0), axis=1).sum(), rtol=1e-6
    )
    window = np.cov(walk.stream[20:30, 1:].astype(float).T, bias=True) + 1e-6 * np.eye(4)
    expected = np.exp(multivariate_normal(cov=window).entropy() / 4)
    assert entropy(walk)[-1] == pytest.approx(expected, rel=1e-6)


class Novelty:
    """A monitor whose surprise is the sense."""

    threshold = 1.0

    def fit(self, episodes):
        return self

    def calibrate(self, episodes, rate):
        return self

    def score_episodes(self, episodes):
        return [Surprise(e.stream[:, 0].astype(float), e.stream) for e in episodes]


def test_two_signals_alarm_where_both_are_over_their_thresholds_and_never_where_one_is(monkeypatch):
    monkeypatch.setattr(failure, "make_monitor", lambda name, spec, seed: Novelty())
    rng = np.random.default_rng(0)

    def acted(sense, wildness):
        actions = wildness * rng.normal(size=(30, 4))
        return Episode.from_stream(np.hstack([np.full((30, 1), sense), actions]), SPEC, success=True)

    calm = [acted(0.5, 1.0) for _ in range(9)]
    tested = [acted(2.0, 3.0), acted(2.0, 0.5), acted(0.5, 3.0), acted(0.5, 0.5)]
    values, threshold = scored("two_signals", 0, calm, calm, tested, 0.1)
    assert [bool(v.max() > threshold) for v in values] == [True, False, False, False]


def test_an_agent_is_weakened_anew_by_each_seed_and_alike_by_the_same():
    rng = np.random.default_rng(0)
    agent = NetworkPolicy([(rng.normal(size=(2, 3)).astype(np.float32), np.zeros(2, np.float32))], "relu", "tanh")
    whole, policy, said = agent.predict(np.ones(3))[0], Weakened(agent), []
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
