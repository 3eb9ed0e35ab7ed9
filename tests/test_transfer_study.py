"""The study of memories under policies they never met: what is counted, and what is recorded."""

from __future__ import annotations

import numpy as np
import pytest

from asm_gym.episode import Episode, EpisodeLabel
from asm_gym.scripts.reproduce import transfer_judge
from asm_gym.scripts.reproduce.transfer import Config
from asm_gym.scripts.reproduce.transfer_judge import ADAPTIVE, Judge
from asm_gym.scripts.reproduce.transfer_report import alarmed, detection, drawn, per_hour, tables
from asm_gym.scripts.reproduce.transfer_watched import KNOWN, POLICIES, WATCHED, Watched
from asm_gym.spec import Channel, StreamSpec

SPEC = StreamSpec((Channel("a", 2, group="a"), Channel("b", 1, group="b"), Channel("action", 1, group="action")), 0.05)
LIFT, SAC = Watched("Lift"), Watched("Lift", "lift_sac", group=POLICIES)


class Says:
    """A monitor whose surprise is what the first channel holds."""

    def __init__(self, threshold: float = 1.0) -> None:
        self.threshold = threshold

    def score_episodes(self, episodes):
        class Score:
            def __init__(self, stream):
                self.value = stream[:, 0].astype(np.float64)
                self.attribution = stream.astype(np.float64)

        return [Score(e.stream) for e in episodes]


def episode(values, role="nominal", seed=0, success=True, kind="", onset=None, affected=()):
    stream = np.zeros((len(values), SPEC.size), np.float32)
    stream[:, 0] = values
    label = EpisodeLabel("Lift", role, kind, "strong" if kind else "", seed, onset, frozenset(affected))
    return Episode(stream, SPEC, success, seed, label=label)


def nominal(largest, seed, success=True):
    values = np.full(72_000 // 20, 0.1)  # three minutes
    values[50] = largest
    return episode(values, seed=seed, success=success)


OWN = {
    LIFT: [nominal(0.5, 0), nominal(2.0, 1)],
    SAC: [nominal(0.5, 2), nominal(0.5, 3), nominal(3.0, 4, success=False)],
}


def test_healthy_episodes_are_counted_by_memory_group_and_success():
    records = Judge(1.0, OWN, 0).records("m", Says(), (LIFT, SAC))
    assert alarmed(records, group=KNOWN, solved=True) == (1, 2)
    assert alarmed(records, group=POLICIES, solved=True) == (0, 2)
    assert alarmed(records, solved=False) == (1, 1)
    assert per_hour(records, group=KNOWN) == "10"  # one in twice three minutes
    assert detection(records) == ("", "")


def broken(policy):
    """Two healthy episodes, a fault that shows at once, and one that shows only after the window."""
    calm = np.full(60, 0.1)
    soon, late = calm.copy(), calm.copy()
    soon[22:], late[45:] = 5.0, 5.0
    faults = [
        episode(v, "faulty", n, kind=k, onset=20) for n, (k, v) in enumerate({"push": soon, "slip": late}.items())
    ]
    return {policy: [episode(calm, seed=0), episode(calm, seed=1), *faults]}


def test_faults_that_an_ideal_observer_could_see_are_looked_for_within_the_window():
    judge = Judge(1.0, broken(SAC), 0)
    (push,) = (r for r in judge.records("m", Says(), (SAC,)) if "found" in r)
    assert (push["kind"], push["found"], push["auroc"]) == ("push", True, 1.0)
    (push,) = (r for r in judge.records("m", Says(9.0), (SAC,)) if "found" in r)
    assert (push["found"], push["auroc"]) == (False, 1.0)
    both = Judge(2.0, broken(SAC), 0).records("m", Says(), (SAC,))
    assert detection(both) == ("1.000", "100 % of 2")


def test_a_running_threshold_goes_on_from_policy_to_policy():
    own = {LIFT: [nominal(2.0, n) for n in range(3)], SAC: [nominal(1.2, n) for n in range(3)]}
    records = Judge(1.0, own, 0).adaptive("m", Says())
    raised = np.exp(ADAPTIVE.step * (1 - ADAPTIVE.rate))
    assert [r["alarms"] for r in records] == [1, 1, 1, 0, 0, 0]
    assert records[1]["threshold"] == pytest.approx(raised)
    assert records[3]["threshold"] == pytest.approx(min(raised**3, ADAPTIVE.ceiling))


def test_a_fault_that_shows_only_in_a_missing_sense_is_left_out():
    hidden, open_ = (episode(np.zeros(9), "faulty", affected=a) for a in (["b"], ["b", "a[0]"]))
    assert not transfer_judge._shows(hidden, {"b"})
    assert transfer_judge._shows(open_, {"b"})
    assert transfer_judge._shows(episode(np.zeros(9)), {"b"})
    spec = StreamSpec(SPEC.channels[1:], SPEC.dt)
    cut = transfer_judge._cut(episode([1.0, 2.0]), spec)
    assert cut.spec == spec
    assert cut.stream.shape == (2, 2)


def test_tables_and_figure_have_a_row_and_a_point_for_each_memory():
    judge = Judge(1.0, {LIFT: OWN[LIFT], SAC: [*OWN[SAC], *broken(SAC)[SAC]]}, 0)
    records = [*judge.records("of one policy", Says(), (LIFT, SAC)), *judge.records("gru", Says(9.0), (LIFT, SAC))]
    by_memory, by_policy, by_sense = tables(records, judge.records("without the wrist", Says(), (LIFT,)), Config())
    assert [row[0] for row in by_memory.rows] == ["of one policy", "gru"]
    assert by_memory.rows[0][1:4] == ("1 of 2", "0 of 4", "1 of 1")
    assert by_memory.rows[1][1:4] == ("0 of 2", "0 of 4", "0 of 1")
    assert [tuple(row) for row in by_policy.rows] == [("Lift, expert", "1 of 2"), ("Lift, lift_sac", "0 of 4")]
    assert by_sense.rows[0][:2] == ("the wrist", "1 of 2")
    assert len(drawn(records).axes[0].containers) == 2


def test_the_expert_is_watched_at_another_speed_and_with_noise_alike_each_time(lift):
    def acted(watched, seed=1):
        observation, _ = lift.reset(seed=3)
        return watched.act(lift, seed).predict(observation)[0]

    half, noisy = Watched("Lift", speed=0.5), Watched("Lift", noise=0.2)
    np.testing.assert_array_equal(acted(noisy), acted(noisy))
    assert not np.array_equal(acted(noisy), acted(noisy, 2))
    assert np.linalg.norm(acted(half)[:3]) < np.linalg.norm(acted(replace_speed(half))[:3])
    assert half.folder == "Lift-expert_at_0.5_of_its_speed"


def replace_speed(watched):
    return watched._replace(speed=1.5)


def test_twins_with_faults_share_the_seeds_of_healthy_episodes():
    labels = SAC.labels(nominal=3, own=2, faults=("push", "snatch"), faulty=2)
    healthy = [x.seed for x in labels if x.role == "nominal"]
    assert len(healthy) == len(set(healthy)) == 3
    assert [x.seed for x in labels if x.role == "faulty"] == healthy[:2] * 4
    assert not set(healthy) & {x.seed for x in labels if x.role in ("fit", "calibration")}
    assert not [x for x in SAC.labels(3, 0, ("push",), 0) if x.role != "nominal"]


def test_fewer_episodes_to_learn_from_are_the_first_of_more():
    few, many = (SAC.labels(1, own, (), 0, calibration=2) for own in (2, 5))
    assert [x for x in many if x.role == "fit"][:2] == [x for x in few if x.role == "fit"]
    assert [x for x in many if x.role != "fit"] == [x for x in few if x.role != "fit"]


def test_agents_of_ones_own_are_watched_besides(tmp_path):
    watched = Config(agents=(("Lift", str(tmp_path / "td3" / "clone.npz")),)).watched
    assert watched[:-1] == WATCHED
    assert watched[-1].name == "Lift, td3 clone"
    assert watched[-1].folder == "Lift-td3_clone"
    assert watched[-1].group == POLICIES


@pytest.mark.parametrize(
    ("wrong", "says"),
    [
        ({"agents": (("Lifts", "a.npz"),)}, "Lift"),
        ({"without": ("Wipe",)}, "task to leave out"),
        ({"rivals": ("oracle",)}, "monitor"),
        ({"lessons": 3}, "needs 19 episodes"),
        ({"faults": ("ghost",)}, "kind of fault"),
        ({"nominal_episodes": 0}, "nominal_episodes"),
    ],
)
def test_settings_that_cannot_be_judged_are_refused(wrong, says):
    with pytest.raises(ValueError, match=says):
        Config(**wrong)
