"""The study of harm: what it counts, what it compares, and what is taught to hit."""

import numpy as np
import pytest

from asm_gym.scripts.reproduce import harm, harm_agents, harm_felt, harm_report


def test_harm_is_the_impulse_beyond_forty_newtons_and_the_first_blow_is_told_from_later_ones():
    force = np.zeros(100)
    force[30:32] = 140.0, 90.0  # 100 + 50 N over 2 ms each
    force[90] = 340.0  # 0.12 s later
    found = harm_felt.harm_of(force, 25)
    assert found["harm"] == pytest.approx((100 + 50 + 300) / 500)
    assert (found["first"], found["later"], found["peak"], found["first_step"]) == (140.0, 340.0, 340.0, 1)
    assert (found["time_over"], found["steps_over"]) == (pytest.approx(1 / 25), 1)
    calm = harm_felt.harm_of(np.full(50, 39.0), 25)
    assert (calm["harm"], calm["first"], calm["later"]) == (0.0, 0.0, 39.0)


def record(guard, seed, value, policy="down", kind="hostile"):
    cell = harm.HarmCell(kind, "Lift", policy)._asdict()
    rest = {"success": True, "first": value, "later": 0.0, "strain": 1.0, "steps": 10, "held": 1, "hand": 0.1}
    return {
        **cell,
        "guard": guard,
        "seed": seed,
        "harm": value,
        "peak": value,
        "ended_s": None,
        "time_over": 0,
        "steps_over": 0,
        **rest,
    }


def test_what_is_left_is_a_share_of_alone_and_the_worst_cell_is_one_in_which_there_was_something():
    records = [record("policy alone", 0, 100.0), record("default", 0, 2.0)]
    records += [record("policy alone", 0, 10.0, "forward"), record("default", 0, 1.0, "forward")]
    records += [record("policy alone", 0, 0.5, "uniform"), record("default", 0, 0.5, "uniform")]
    assert harm_report.left(records, "default") == pytest.approx(3.5 / 110.5)
    shown = harm_report.sums_table(records, ["policy alone", "default"]).rows[1]
    assert shown[1:3] == ("96.8 %", "90.0 %")
    assert harm_report.harm_table(records, ["policy alone", "default"]).rows[1][2] == "1.0 (10.0 %)"


def test_success_is_paired_by_scene_and_told_from_success_with_a_blow():
    records = []
    for policy, seed, alone, guarded, blow in (
        *(("scripted", 1, True, True, 10.0), ("scripted", 2, True, False, 300.0)),
        *(("lift_sac", 1, False, True, 10.0), ("lift_sac", 2, True, True, 300.0)),
    ):
        pair = record("policy alone", seed, blow, policy, "healthy"), record("default", seed, 10.0, policy, "healthy")
        records += [pair[0] | {"success": alone}, pair[1] | {"success": guarded}]
    rows = harm_report.kept_table(records, ["policy alone", "default"], "healthy").rows
    assert [row[:5] for row in rows] == [
        ("Lift, scripted", "2 of 2", "1 (-1 +0)", "1", "1"),
        ("Lift, lift_sac", "1 of 2", "2 (-0 +1)", "0", "2"),
        ("all", "3 of 4", "3 (-1 +1)", "1", "3"),
    ]


def test_a_run_that_goes_on_measures_no_scene_twice(tmp_path, monkeypatch):
    config = harm.Config(out=tmp_path, guards=("policy alone",), resume=True)
    monkeypatch.setattr(harm, "one", lambda cell, seed, *rest: {"seed": seed, "harm": 1.5, "hand": float("nan")})
    job = harm.HarmCell("healthy", "Lift", "scripted"), 7
    first = harm.measured(job, config)
    monkeypatch.setattr(harm, "one", None)
    np.testing.assert_equal(harm.measured(job, config), first)


def test_every_cell_is_one_row_and_other_arms_are_asked_for():
    config = harm.Config(episodes=2, against=harm.AGAINST, healthy=3, training=400, tasks=("Lift",))
    chosen = harm.cells(config)
    kinds = [cell.kind for cell, _ in chosen]
    assert {k: kinds.count(k) for k in set(kinds)} == {
        "hostile": 34,
        "trained": 2,
        "untrained": 3,
        "early": 6,
        "healthy": 2,
        "faulty": 10,
    }
    assert {cell.robot for cell, n in chosen if n == 2} == {"Panda", "Sawyer", "IIWA"}
    assert sorted({cell.steps for cell, _ in chosen if cell.kind == "early"}) == [100, 400]


def test_the_search_finds_what_does_harm(monkeypatch):
    class Env:
        action_space = np.zeros(3)

    monkeypatch.setattr(harm_agents, "sequence", lambda parts, env, seed: parts)
    monkeypatch.setattr(harm_agents, "_harm", lambda env, parts, seed: -np.square(parts - 0.3).sum())
    found = harm_agents.searched(Env(), 12, seed=0)
    assert found.shape == (10, 3)
    assert np.abs(found - 0.3).mean() < 0.15
    np.testing.assert_array_equal(found, harm_agents.searched(Env(), 12, seed=0))
