"""The study of failures: its figures by hand, and what weakens an agent."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.stats import multivariate_normal

from asm_gym.episode import Episode
from asm_gym.evaluation.statistics import Share
from asm_gym.monitors import Surprise
from asm_gym.policies.network import NetworkPolicy
from asm_gym.scripts.reproduce import failure_rivals
from asm_gym.scripts.reproduce.failure import AGENTS, Config, Watched, early, in_order, labels, order, separated, ways
from asm_gym.scripts.reproduce.failure_rivals import entropy, inconsistency, reversals, scored
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


def test_the_tables_count_what_was_known_by_when_and_in_which_order():
    (row,) = early({"one": WATCHED}, Config()).rows
    assert row[2].startswith("0.889 (")
    assert row[4:] == ("1 of 3", "2 of 3", "1 of 2")
    table = ways({"one": WATCHED})
    assert table.headings[1:] == ("as it is, 1 of 3 failed", "weakened, 1 of 2 failed", "disturbed, 1 of 1 failed")
    assert [cell[:5] for cell in table.rows[0][1:]] == ["1.000", "1.000", ""]
    assert order({"one": WATCHED}).rows[0][1:] == ("1 of 2", "0 of 1", "1 of 1", "1 of 2", "no")


def test_the_order_is_that_of_failures_above_successes_and_of_what_is_new_above_what_is_known():
    def shares(*found):
        return [Share(k, 10 if k >= 0 else 0) for k in found]

    assert in_order(shares(1, 1, 2, 2))
    assert in_order(shares(1, 1, -1, 2))
    for wrong in ((2, 1, 3, 3), (1, 2, 2, 3), (1, 2, 4, 3), (1, 3, -1, 2)):
        assert not in_order(shares(*wrong))


SPEC = StreamSpec((Channel("sense", 1), Channel("action", 4, group="action")), dt=0.1)


def commanded(actions):
    """An episode (T, 5) in which these actions (T, 4) are commanded."""
    return Episode.from_stream(np.hstack([np.zeros((len(actions), 1)), actions]), SPEC, success=True)


def test_reversals_count_turns_of_the_hand_in_the_last_second_alone():
    forth, back = [1.0, 0.1, 0.0, 1.0], [-1.0, 0.1, 0.0, 1.0]
    found = reversals(commanded(np.array([forth] * 4 + [back, forth] * 2 + [forth] * 12)))
    np.testing.assert_allclose(found[[3, 4, 7]], [0.0, 1 / 5, 4 / 8])
    np.testing.assert_allclose(found[[9, 13, 19]], [4 / 10, 4 / 10, 0.0])


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
    monkeypatch.setattr(failure_rivals, "make_monitor", lambda name, spec, seed: Novelty())
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
