"""The study of harm: what it counts, what it compares, and the search for actions that hit."""

from collections import Counter

import numpy as np
import pytest

from asm_gym.scripts.reproduce import harm, harm_agents
from asm_gym.scripts.reproduce.kit import main

ALONE, DEFAULT = "policy alone", "default"


def test_harm_is_the_impulse_beyond_forty_newtons():
    force = np.zeros(100)
    force[30:32] = 140.0, 90.0  # 100 + 50 N over 2 ms each
    force[90] = 340.0  # 0.12 s later: no part of the first blow
    found = harm.harm_of(force, 25)
    assert found["harm"] == pytest.approx((100 + 50 + 300) / 500)
    assert (found["first"], found["peak"]) == (140.0, 340.0)
    assert (found["time_over"], found["steps_over"]) == (pytest.approx(1 / 25), 1)
    below = harm.harm_of(np.full(50, 39.0), 25)
    assert (below["harm"], below["first"]) == (0.0, 0.0)


def record(guard, seed, value, policy="down", kind="hostile", success=True):
    case = {"kind": kind, "task": "Lift", "policy": policy, "fault": "nominal", "robot": "Panda", "rate": 20}
    forces = dict.fromkeys(("harm", "peak", "first"), value) | {"time_over": 0, "steps_over": 0, "torque": 1.0}
    return case | forces | {"guard": guard, "seed": seed, "success": success, "steps": 10, "held": 1}


def test_the_share_left_is_of_the_policy_alone_and_the_worst_cell_is_one_with_harm():
    records = [record(ALONE, 0, 100.0), record(DEFAULT, 0, 2.0)]
    records += [record(ALONE, 0, 10.0, "forward"), record(DEFAULT, 0, 1.0, "forward")]
    records += [record(ALONE, 0, 0.5, "uniform"), record(DEFAULT, 0, 0.5, "uniform")]
    assert harm.left(records, DEFAULT) == pytest.approx(3.5 / 110.5)
    assert harm.guards_table(records, [ALONE, DEFAULT]).rows[1][1:3] == ("96.8 %", "90.0 %")
    assert harm.settings_table(records, [ALONE, DEFAULT]).rows[1][:4] == ("Panda, 20 Hz", DEFAULT, "96.8 %", "90.0 %")
    assert harm.cases_table(records, [ALONE, DEFAULT]).rows[1][2] == "1.0 (10.0 %)"


def test_success_is_paired_by_scene_and_counted_without_a_blow():
    records = []
    for policy, seed, alone, guarded, blow in (
        *(("scripted", 1, True, True, 10.0), ("scripted", 2, True, False, 300.0)),
        *(("lift_sac", 1, False, True, 10.0), ("lift_sac", 2, True, True, 300.0)),
    ):
        records.append(record(ALONE, seed, blow, policy, "healthy", alone))
        records.append(record(DEFAULT, seed, 10.0, policy, "healthy", guarded))
    rows = harm.success_table(records, [ALONE, DEFAULT], "healthy").rows
    assert [row[:5] for row in rows] == [
        ("Lift, scripted", "2 of 2", "1 (-1 +0)", "1", "1"),
        ("Lift, lift_sac", "1 of 2", "2 (-0 +1)", "0", "2"),
        ("all", "3 of 4", "3 (-1 +1)", "1", "3"),
    ]


def test_every_kind_of_policy_that_is_asked_for_has_its_cases(tmp_path, monkeypatch):
    monkeypatch.setattr(harm_agents, "trained", lambda folder, task, name, steps, seed: folder / f"{name}-{steps}.zip")
    made = {"episodes": 2, "against": harm.AGAINST, "healthy": 3, "training": 400, "tasks": ("Lift",), "out": tmp_path}
    found = harm.cases(harm.Config(**made, workers=1))
    counts = {"hostile": 34, "trained": 2, "untrained": 3, "early": 6, "healthy": 2, "faulty": 10}
    assert Counter(case.kind for case, _ in found) == counts
    assert {case.config.robot for case, n in found if n == 2} == {"Panda", "Sawyer", "IIWA"}
    assert {case.policy for case, _ in found if case.kind == "early"} >= {"SAC after 100", "TD3 after 400"}


def test_the_study_writes_its_tables_for_the_guards_asked_for(tmp_path, monkeypatch):
    def measured(case, guards):
        return [case.key | record(guard, case.trial.seed, 9.0, case.policy, case.kind) for guard in guards]

    monkeypatch.setattr(harm, "measured", measured)
    asked = ["--quick", "--guards", ALONE, "hold", "--against", "hostile", "--workers", "1", "--out", str(tmp_path)]
    assert main(harm, asked) == 0
    text = (tmp_path / "harm.md").read_text()
    assert "| hold |" in text
    assert "terminate" not in text
    assert "Lift, down, 0.25 of full speed" in text


def test_the_search_finds_the_sequence_that_does_most_harm(monkeypatch):
    class Env:
        action_space = np.zeros(3)

    monkeypatch.setattr(harm_agents, "sequence", lambda parts, env, seed: parts)
    monkeypatch.setattr(harm_agents, "harm_of_sequence", lambda env, parts, seed: -np.square(parts - 0.3).sum())
    found = harm_agents.searched(Env(), 12, seed=0)
    assert found.shape == (10, 3)
    assert np.abs(found - 0.3).mean() < 0.15
    np.testing.assert_array_equal(found, harm_agents.searched(Env(), 12, seed=0))
