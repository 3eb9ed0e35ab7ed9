"""What acting on alarms is worth: pairs, bootstrap intervals, and the program that runs them."""

import json
import math
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from asm_gym.evaluation.contact import ContactForce, contact_force, within_limits
from asm_gym.evaluation.intervention import compare, share_of_ideal
from asm_gym.evaluation.scored import NOMINAL, POLICY_ALONE, InterventionOutcome, ScoredEpisode
from asm_gym.monitors import NeuralASM
from asm_gym.rollouts.staging import staged
from asm_gym.rollouts.trial import PASSING, RolloutConfig, Trial
from asm_gym.rollouts.watch import band_of, watch, watch_each
from asm_gym.scripts.evaluate import main as evaluate
from asm_gym.scripts.reproduce.reflexes import Args, main, trials


def trace(seed: int, acting: str, delay: int = 2, ended: bool = False, **changes) -> ScoredEpisode:
    """Ten steps of 50 ms, the alarm ``delay`` steps after the onset."""
    surprise = np.where(np.arange(10) == 1 + delay, 2.0, 0.0)
    what = {"success": True, "external_force": 40.0, "impulse": 8.0, "acted_s": 0.5, **changes}
    outcome = InterventionOutcome(ended_by_alarm=ended, **what)
    return ScoredEpisode("push", seed, 0.05, 1.0, surprise, 2, task="Lift", acting=acting, outcome=outcome)


def test_pairs_are_matched_by_seed_whatever_their_order():
    alone = [trace(n, POLICY_ALONE, external_force=10.0 * (n + 1), success=n < 3) for n in range(4)]
    held = [trace(n, "hold", external_force=5.0 * (n + 1), delay=n + 1, ended=n == 0) for n in (2, 0, 3, 1)]
    c = compare(alone, held)
    assert c.peak == (0.5, 0.5, 0.5)
    assert c.impulse.value == 0.0
    assert (c.success.k, c.alone.k, c.gained.value) == (4, 3, 0.25)
    assert c.median_delay_ms == 100.0
    assert (c.ended.k, c.ended.n) == (1, 4)
    assert c.alarm_s == pytest.approx(0.05)


def test_what_is_no_pair_is_refused():
    with pytest.raises(ValueError, match="twin"):
        compare([trace(0, POLICY_ALONE)], [trace(1, "hold")])
    with pytest.raises(ValueError, match="twin"):
        compare([], [])


def test_every_task_and_fault_is_tried_at_the_same_seeds():
    args = Args(tasks=("Lift", "Door"), faults=(NOMINAL, PASSING), episodes=3)
    made = trials(args)
    assert len(set(made)) == len(made) == 2 * 2 * 3
    seeds = {fault: {(t.task, t.seed) for t in made if t.kind == fault} for fault in args.faults}
    assert seeds[NOMINAL] == seeds[PASSING]


@pytest.mark.parametrize(
    ("kind", "alarmed", "runs"),
    [
        ("collision", True, ["policy alone", "ideal", "hold"]),
        ("encoder_bias", False, ["policy alone", "ideal", "hold"]),
        ("stuck_joint", True, ["policy alone", "hold"]),
        (NOMINAL, False, ["policy alone", "hold"]),  # limits act before any alarm does
    ],
)
def test_only_episodes_that_may_differ_are_run(monkeypatch, kind, alarmed, runs):
    run = []

    def one(trial, config, memory):
        run.append(trial.acting)
        return trace(trial.seed, trial.acting, delay=2 if alarmed else 99)

    monkeypatch.setattr("asm_gym.rollouts.watch.watch", one)
    trial = Trial("asm_gym/Lift-v0", 0, kind, "" if kind == NOMINAL else "strong")
    made = watch_each(trial, (POLICY_ALONE, "ideal", "hold"), RolloutConfig(), Path("none"))
    assert run == runs
    assert [t.acting for t in made] == [POLICY_ALONE, "ideal", "hold"]


@pytest.mark.parametrize(
    ("kind", "runs", "undisturbed"),
    [
        ("encoder_bias", ["policy alone", "graded+spinal"], 1),
        (NOMINAL, ["graded+spinal"], 1),
        ("collision", ["policy alone", "ideal", "graded+spinal"], 0),
    ],
)
def test_what_is_known_of_the_seed_is_not_run_again_and_a_band_always_is(monkeypatch, kind, runs, undisturbed):
    run, asked = [], []

    def one(trial, config, memory):
        run.append(trial.acting)
        return trace(trial.seed, trial.acting, delay=99)

    def quiet():
        asked.append(kind)
        return trace(0, POLICY_ALONE, delay=99, impulse=1.0)

    monkeypatch.setattr("asm_gym.rollouts.watch.watch", one)
    trial = Trial("asm_gym/Lift-v0", 0, kind, "" if kind == NOMINAL else "strong")
    made = watch_each(trial, (POLICY_ALONE, "ideal", "graded+spinal"), RolloutConfig(), Path("none"), quiet)
    assert (run, len(asked)) == (runs, undisturbed)
    assert made[1].acting == "ideal"
    assert (made[1].outcome.impulse == 1.0) == (undisturbed == 1)


def test_the_ideal_episode_of_a_sensors_fault_is_the_one_in_which_nothing_is_wrong(tmp_path):
    memory = tmp_path / "memory.asm"
    NeuralASM.pretrained("panda").save(memory)
    faulty = Trial("asm_gym/Lift-v0", 3, "encoder_bias", "strong", acting="ideal", after_s=0.5)
    ran, known = (
        watch(trial, RolloutConfig(robot="Panda"), memory)
        for trial in (faulty, Trial("asm_gym/Lift-v0", 3, after_s=0.5))
    )
    assert ran.outcome == known.outcome
    np.testing.assert_array_equal(ran.surprise, known.surprise)


def test_a_trace_that_was_kept_is_the_same():
    made = trace(3, "graded", contact=ContactForce(7.5, 0.1), cause="contact", impulse=math.inf)
    again = ScoredEpisode.from_json(made.to_json())
    assert repr(again.outcome) == repr(made.outcome)
    assert (again.acting, again.delay, again.to_json()) == (made.acting, made.delay, made.to_json())
    np.testing.assert_array_equal(again.surprise, made.surprise)


def test_a_command_that_was_stopped_goes_on(tmp_path, monkeypatch):
    ran = []

    def one(trial, config, memory):
        ran.append((trial.kind, trial.acting))
        onset = None if trial.kind == NOMINAL else 2
        return replace(trace(trial.seed, trial.acting), kind=trial.kind, onset=onset)

    monkeypatch.setattr("asm_gym.rollouts.watch.watch", one)
    monkeypatch.setattr("asm_gym.scripts.reproduce.reflexes.watch", one)
    how = ["--tasks", "Lift", "--memory", "panda", "--reflexes", "hold", "--out", str(tmp_path), "--workers", "1"]
    for faults, new in (
        (["nominal", "encoder_bias"], [("nominal", "policy alone"), ("nominal", "hold")]),
        (["nominal", "encoder_bias", "passing_push"], [("passing_push", a) for a in ("policy alone", "ideal", "hold")]),
    ):
        ran.clear()
        assert main([*how, "--episodes", "1", "--faults", *faults]) == 0
        biased = [("encoder_bias", a) for a in ("policy alone", "hold")] if len(faults) == 2 else []
        assert ran == new + biased
    made = json.loads((tmp_path / "reactions.json").read_text())["episodes"]
    assert [e["acting"] for e in made] == ["policy alone", "ideal", "hold"] * 3


def test_a_reflex_above_a_band_needs_one():
    with pytest.raises(ValueError, match="band"):
        band_of(RolloutConfig(), NeuralASM.pretrained("panda"))


def test_each_task_has_the_agent_that_was_trained_in_it():
    args = Args(policy="agents")
    assert [args.config(task).policy for task in ("Lift", "Stack", "Door")] == ["lift_sac", "stack_sac", "door_sac"]
    assert Args().config("Lift").policy == "scripted"


def test_a_share_of_the_ideal_reflexs_gain_is_between_none_and_all():
    alone = [trace(n, POLICY_ALONE, external_force=40.0, impulse=8.0, success=n < 2) for n in range(4)]
    ideal = [trace(n, "ideal", external_force=20.0, impulse=8.0) for n in range(4)]
    acted = [trace(n, "graded", external_force=25.0, impulse=1.0, success=n < 3) for n in range(4)]
    share = share_of_ideal(alone, acted, ideal)
    assert (share.success, share.peak) == (0.5, 0.75)
    assert math.isnan(share.impulse)  # there is nothing to gain
    assert share_of_ideal(alone, alone, ideal).peak == 0.0
    assert share_of_ideal(alone, ideal, ideal).peak == 1.0
    with pytest.raises(ValueError, match="twins"):
        share_of_ideal(alone, acted[1:], ideal)


def test_a_contact_is_transient_for_half_a_second():
    forces = np.array([0.0, 0.5, 250.0, *[100.0] * 9, 120.0, 90.0])
    assert contact_force(forces, 0.05) == ContactForce(250.0, 120.0)
    assert contact_force(np.zeros(5), 0.05) == ContactForce(0.0, 0.0)
    found = within_limits([ContactForce(250, 120), ContactForce(250, 150), ContactForce(290, 10)], "hand")
    assert (found.k, found.n) == (1, 3)
    with pytest.raises(ValueError, match=r"tail.*hand"):
        within_limits([], "tail")


def test_the_ideal_reflex_stays_while_something_touches_and_is_told_no_lies():
    collision, biased = (
        Trial("asm_gym/Lift-v0", 3, kind, "strong", onset=20, acting="ideal") for kind in ("collision", "encoder_bias")
    )
    with staged(collision, RolloutConfig()) as env:
        env.reset(seed=3)
        act = np.array([0.3, 0, 0, 0, 0, 0, 1], np.float32)
        spec = env.unwrapped.stream_spec
        done = [env.step(act)[4]["stream"][spec.slices["action"]][0] for _ in range(45)]
    np.testing.assert_allclose(done, [0.3] * 20 + [0.0] * 20 + [0.3] * 5)
    with staged(biased, RolloutConfig()) as env:
        assert "FaultInjection" not in str(env)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--reflexes", "dance"], "dance.*hold"),
        (["--reflexes", "dance+spinal"], "dance.*hold"),
        (["--faults", "meteor"], "meteor.*passing_push"),
        (["--episodes", "0"], "episodes"),
        (["--max-override-s", "0"], "max_override_s"),
        (["--tasks", "Lift"], "run asm-gym evaluate first"),
        (["--tasks", "Juggle"], "Juggle.*Lift"),
        (["--tasks", "PickPlaceCan", "--policy", "agents"], "agents"),
        (["--tasks", "Lift", "--memory", "missing.asm"], "missing.asm"),
        (["--tasks", "Lift", "--policy", "missing.zip"], "missing.zip"),
        (["--tasks", "Lift", "--policy", "missing.zip", "--monitor-freq", "100"], "missing.zip"),
    ],
)
def test_bad_arguments_are_refused(arguments, message, tmp_path, capsys):
    assert main([*arguments, "--run", str(tmp_path / "none"), "--out", str(tmp_path / "out")]) == 2
    assert re.search(message, capsys.readouterr().err.replace("\n", " "))


@pytest.mark.slow
def test_it_runs_on_what_an_evaluation_has_recorded(tmp_path):
    small = ["--tasks", "Lift", "--faults", "push", "--severities", "strong", "--harmless", "touch"]
    counts = ["--fit-episodes", "10", "--calibration-episodes", "19", "--nominal-episodes", "2"]
    few = ["--faulty-episodes", "1", "--harmless-episodes", "1", "--false-alarm-rate", "0.05", "--no-video"]
    assert evaluate([*small, *counts, *few, "--monitors", "neural_asm", "--out", str(tmp_path / "run")]) == 0
    how = ["--tasks", "Lift", "--reflexes", "hold", "hold+spinal", "terminate", "--faults", "nominal", "collision"]
    where = ["--run", str(tmp_path / "run"), "--out", str(tmp_path / "out")]
    felt = ["--fit-episodes", "4", "--calibration-episodes", "19", "--false-alarm-rate", "0.05"]
    assert main([*how, *where, *felt, "--episodes", "2"]) == 0
    made = json.loads((tmp_path / "out" / "reactions.json").read_text())["episodes"]
    assert len(made) == 2 * 2 * 5
    for one in made:
        assert one["acting"] != POLICY_ALONE or one["acted_s"] == 0
        assert one["peak_force"] >= 0
        if one["acting"] == POLICY_ALONE:  # a reflex may end it before anything is touched
            assert one["fault"] == "nominal" or one["peak_force"] > 0
        assert math.isfinite(one["impulse"])
    assert (tmp_path / "out" / "reactions.md").read_text().count("\n| ") == 2 + 2 * 4
