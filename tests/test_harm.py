"""The study of harm: what it counts, and what it compares."""

from collections import Counter

import numpy as np
import pandas as pd
import pytest

from asm_gym.evaluation.contact_harm import harm_of
from asm_gym.policies.hostile import HOSTILE
from asm_gym.rollouts.trial import Trial
from asm_gym.scripts.reproduce import harm
from asm_gym.scripts.reproduce.harm_cases import Case
from asm_gym.scripts.reproduce.kit import main

ALONE, DEFAULT = "policy alone", "default"


def test_harm_is_the_impulse_beyond_forty_newtons():
    force = np.zeros(100)
    force[30:32] = 140.0, 90.0  # 100 + 50 N over 2 ms each
    force[90] = 340.0  # 0.12 s later: no part of the first blow
    found = harm_of(force, frequency=500)
    assert found.harm == pytest.approx((100 + 50 + 300) / 500)
    assert (found.first, found.peak, found.over_s) == (140.0, 340.0, 3 / 500)
    below = harm_of(np.full(50, 39.0), frequency=500)
    assert (below.harm, below.first) == (0.0, 0.0)


def record(guard, seed, value, policy="down", kind="hostile", success=True):
    case = {
        "kind": kind,
        "task": "Lift",
        "policy": policy,
        "fault": "nominal",
        "robot": "Panda",
        "rate": 20,
    }
    forces = dict.fromkeys(("harm", "peak", "first"), value) | {
        "over_s": value / 100,
        "alarms": 2,
        "cost": 5.0,
        "overridden": 0,
        "time": 2.0 if success else np.nan,
    }
    return case | forces | {"guard": guard, "seed": seed, "success": success}


def test_what_is_kept_away_is_of_the_policy_alone_and_cells_without_harm_do_not_count():
    records = [record(ALONE, 0, 100.0), record(DEFAULT, 0, 2.0)]
    records += [record(ALONE, 0, 10.0, "forward"), record(DEFAULT, 0, 1.0, "forward")]
    records += [record(ALONE, 0, 0.5, "uniform"), record(DEFAULT, 0, 0.5, "uniform")]
    table = harm.by_guard("", pd.DataFrame(records), [ALONE, DEFAULT], ("robot", "rate"), harm.CASE)
    told = [dict(zip(table.headings, row, strict=True)) for row in table.rows]
    assert (told[1]["harm [N s]"], told[1]["kept away"], told[1]["cells that keep 95 %"]) == (
        "1.2",
        "96.8 %",
        "1 of 2",
    )
    assert (told[1]["alarms"], told[1]["cost"], told[1]["time over 40 N [s]"]) == (
        "2.0",
        "5.0",
        "0.01",
    )
    assert (told[5][""], told[5]["kept away"]) == ("Panda, 20 Hz, Lift, forward", "90.0 %")


def test_groups_of_the_same_episodes_are_one_row_and_tables_of_the_same_rows_are_one():
    records = [record(g, 0, v, "scripted", "healthy") for g, v in ((ALONE, 9.0), (DEFAULT, 1.0))]
    frame = pd.DataFrame(records)
    table = harm.by_guard("", frame, [ALONE, DEFAULT], harm.CASE, ("kind",))
    assert len(table.rows) == 2
    again = harm.by_guard("again", frame, [ALONE, DEFAULT], ("policy",))
    none = harm.by_guard("none", frame[:0], [ALONE], ("policy",))
    assert harm.without_repeats([none, table, again]) == [table]


def test_success_is_paired_by_scene_and_counted_without_a_blow():
    records = []
    for policy, seed, alone, guarded, blow in (
        *(("scripted", 1, True, True, 10.0), ("scripted", 2, True, False, 300.0)),
        # the last leans for 0.6 s
        *(
            ("lift_sac", 1, False, True, 10.0),
            ("lift_sac", 2, True, True, 60.0),
        ),
    ):
        records.append(record(ALONE, seed, blow, policy, "healthy", alone))
        records.append(record(DEFAULT, seed, 10.0, policy, "healthy", guarded))
    rows = harm.by_guard("", pd.DataFrame(records), [ALONE, DEFAULT], harm.CASE, ("kind",)).rows
    assert [(row[0], *row[-4:]) for row in rows if row[1] == ALONE] == [
        ("Panda, 20 Hz, Lift, scripted", "2 of 2", "-0 +0", "1", "2.00"),
        ("Panda, 20 Hz, Lift, lift_sac", "1 of 2", "-0 +0", "1", "2.00"),
        ("Panda, 20 Hz, Lift", "3 of 4", "-0 +0", "2", "2.00"),
    ]
    assert [row[-4:-1] for row in rows if row[1] == DEFAULT] == [
        ("1 of 2", "-1 +0", "0"),
        ("2 of 2", "-0 +1", "0"),
        ("3 of 4", "-1 +1", "0"),
    ]


def test_every_kind_of_policy_that_is_asked_for_has_its_cases():
    found = harm.cases(harm.Config(episodes=2, against=harm.AGAINST, healthy=3, tasks=("Lift",)))
    kinds = Counter(case.kind for case, _ in found)
    impaired = len(harm.RAMMING) * len(harm.IMPAIRMENTS)
    assert kinds["hostile"] == len(HOSTILE) * (1 + len(harm.ELSEWHERE)) + 2 + impaired
    assert (kinds["healthy"], kinds["faulty"]) == (2, 10)
    assert {case.config.robot for case, n in found if n == 2} == {"Panda", "Sawyer", "IIWA"}


def test_the_study_writes_its_tables_for_the_guards_asked_for(tmp_path, monkeypatch):
    def episode(job):
        return record(job[1], job[0].trial.seed, 9.0) | job[0].key

    monkeypatch.setattr(harm, "episode", episode)
    asked = [
        "--quick",
        "--guards",
        ALONE,
        "0.15 m/s",
        "--against",
        "hostile",
        "--workers",
        "1",
        "--out",
        str(tmp_path),
    ]
    assert main("harm", harm, asked) == 0
    text = (tmp_path / "harm.md").read_text()
    assert "| 0.15 m/s |" in text
    assert "0.25 m/s" not in text
    assert "Lift, down, 0.25 of full speed" in text


def test_harm_is_drawn_against_pace_for_each_guard():
    records = [record(g, 0, v) for g, v in ((ALONE, 100.0), (DEFAULT, 2.0), ("hold", 1.0))]
    times = (ALONE, 4.0), (DEFAULT, 5.0), ("hold", np.nan)  # nothing was solved under the last
    records += [record(g, 0, 0.0, "scripted", "healthy") | {"time": t} for g, t in times]
    ax = harm.frontier(pd.DataFrame(records), [ALONE, DEFAULT, "hold"]).axes[0]
    assert np.isnan(ax.lines[2].get_xdata()).all()
    ax.lines[2].remove()
    assert {line.get_label(): (*line.get_xdata(), *line.get_ydata()) for line in ax.lines} == {
        ALONE: (1.0, 100.0),
        DEFAULT: (1.25, 2.0),
    }


@pytest.mark.parametrize(("policy", "speed"), [("forward", 1.0), ("down", 0.5)])
def test_a_hand_that_is_driven_onto_a_bin_where_healthy_hands_went_meets_it_gently(policy, speed):
    trial = Trial("asm_gym/PickPlaceCan-v0", 71000)
    found = harm.episode((Case("hostile", policy, trial, speed=speed), "default"))
    assert 40.0 < found["peak"] < 280.0
