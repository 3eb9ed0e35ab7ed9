"""Training under the wrapper: what is counted, what is compared, and a comparison from end to end."""

import json
from dataclasses import asdict

import gymnasium as gym
import numpy as np
import pytest
from stable_baselines3 import SAC
from stable_baselines3.common.vec_env import DummyVecEnv

from asm_gym.episode import Episode
from asm_gym.monitors import NeuralASM
from asm_gym.rollouts.training.exploration import Explorer, Gentle, until_contact
from asm_gym.rollouts.training.learners import NOVICE_LOG_STD, make_learner, make_novice
from asm_gym.rollouts.training.outcome import COUNTED, TrainingOutcome, count
from asm_gym.rollouts.training.safe_run import AT_LIMIT, read_outcome
from asm_gym.rollouts.training.violations import TorqueWatch
from asm_gym.scripts.cli import main
from asm_gym.scripts.reproduce import safe_training
from asm_gym.scripts.reproduce.training_report import counts_table, learning_figure, worth, worth_table
from asm_gym.spec import Channel, StreamSpec
from asm_gym.wrappers import NeuralASMSafety
from tests.fakes import CueMonitor, FakeEnv
from tests.streams import sine_episodes, sine_spec


def outcome(condition="alone", seed=0, success=0.5, **counts):
    zeros = dict.fromkeys(COUNTED, (0, 0))
    curve = ((500, 0.2), (1000, success))
    return TrainingOutcome(condition, seed, 1000, 500, **(zeros | counts), curve=curve, success=success, episodes=10)


def test_steps_and_contacts_are_counted_span_by_span():
    force = np.array([0, 50, 60, 0, 41, 40, np.nan, 90, 0, 0], float)
    alarms = np.array([0, 0, 1, 0, 1, 0, 1, 0, 0, 0], bool)
    no = np.zeros(10, bool)
    found = count(force, 40.0, {"alarms": alarms, "limited": ~no, "touched": no, "acted": no}, span=4)
    assert found["over"] == (2, 3, 0)
    assert found["contacts"] == (1, 2, 0)  # at steps 1, 4 and 6; at 40 N nothing is wrong, and nan is no comfort
    assert found["noticed"] == (0, 2, 0)
    assert found["alarms"] == (1, 2, 0)
    assert found["limited"] == (4, 4, 2)


def test_a_condition_is_held_against_the_run_of_the_same_seed():
    alone = [outcome(seed=s, over=(10 * (s + 1), 10), success=0.5) for s in range(3)]
    guarded = [outcome("hold", seed=s, over=(5 * (s + 1), 5), success=0.5 + 0.1 * s) for s in (2, 0, 1)]
    found = worth(alone, guarded)
    assert found.condition == "hold"
    # Half of each pair: whatever is drawn, the share is a half.
    np.testing.assert_allclose(found.over, [0.5, 0.5, 0.5])
    assert found.gained.value == pytest.approx(0.1)
    assert found.gained.low >= 0.0
    assert found.gained.high <= 0.2
    assert alone[1].each_10k("over") == 300.0
    with pytest.raises(ValueError, match=r"pairs, got the seeds \[0, 1, 2\] and \[0, 1\]"):
        worth(alone, guarded[1:])


def test_the_tables_give_rates_per_10000_steps_and_differences():
    runs = {
        "alone": [outcome(seed=s, over=(20, 20), contacts=(4, 4), noticed=(4, 2)) for s in range(2)],
        "hold": [outcome("hold", seed=s, over=(5, 5), contacts=(2, 2), success=0.6) for s in range(2)],
    }
    rows = {row[0]: row[1:] for row in counts_table(runs, 40.0).rows}
    assert rows["alone"][:2] == ("400 ± 0", "80 ± 0")
    assert rows["alone"][-2:] == ("75 %", "50.0 ± 0.0")
    ((name, over, contacts, limited, gained),) = worth_table(runs, "alone", 40.0).rows
    assert (name, over, contacts, gained) == ("hold", "75 % (75 to 75)", "50 % (50 to 50)", "10 % (10 to 10)")
    assert limited == "none alone"


def test_the_figure_sums_violations_up():
    runs = {"alone": [outcome(over=(3, 4)), outcome(seed=1, over=(5, 0))], "hold": [outcome("hold")]}
    fig = learning_figure(runs, 40.0)
    mean = max(
        (line for line in fig.axes[0].lines if line.get_label() == "alone"), key=lambda line: line.get_linewidth()
    )
    np.testing.assert_allclose(mean.get_xydata(), [[500, 4], [1000, 6]])
    assert fig.axes[2].lines[-1].get_ydata().tolist() == [20, 50]


def test_an_outcome_is_read_as_it_was_written(tmp_path):

    made = outcome(over=(1, 2))
    (tmp_path / "one.json").write_text(json.dumps(asdict(made)))
    assert read_outcome(tmp_path / "one.json") == made


def test_the_torque_watch_agrees_with_every_substep(lift):
    env, inner = TorqueWatch(lift), lift.unwrapped
    seen = []

    def note(_):
        data = inner.simulation.data
        seen.append(data.actuator_force[inner.motors].copy())

    inner.substep_hooks.append(note)
    try:
        env.reset(seed=0)
        rng = np.random.default_rng(0)
        limits = inner.simulation.model.actuator_ctrlrange[inner.motors][:, 1]
        touched = 0
        for _ in range(10):
            seen.clear()
            info = env.step(rng.uniform(-1, 1, 7).astype(np.float32))[4]
            used = np.array(seen) / limits  # (substeps, joints)
            assert info["torque_share"] == pytest.approx(np.abs(used.mean(axis=0)).max(), abs=1e-9)
            assert info["torque_peak_share"] == pytest.approx(np.abs(used).max(), abs=1e-9)
            touched += info["torque_peak_share"] >= AT_LIMIT
    finally:
        inner.substep_hooks.remove(note)
    assert touched > 5  # random set-points jump


def test_exploration_ends_before_the_first_hard_contact():
    spec = StreamSpec((Channel("position", 1, "m"), Channel("external_torque_peak", 2, "N m")), dt=0.05)
    stream = np.zeros((6, 3), np.float32)
    stream[4] = 0.0, 1.0, -11.0
    arrays = {"actions": np.zeros((6, 3)), "observations": np.zeros((7, 2)), "rewards": np.zeros(6)}
    episode = Episode(stream, spec, faults=np.zeros(6, bool), **arrays)
    cut = until_contact(episode, np.array([1.0, 19, 20, 21, 0, 0]), Gentle(20.0, 10.0))
    assert [len(getattr(cut, n)) for n in ("stream", "actions", "rewards", "faults")] == [3] * 4
    assert len(cut.observations) == 4
    assert len(until_contact(episode, np.zeros(6), Gentle(20.0, 10.0))) == 4
    assert len(until_contact(episode, np.zeros(6), Gentle(20.0, 12.0))) == 6


def test_explorers_differ_by_seed_and_pause_with_their_grip_kept(lift):
    observation, _ = lift.reset(seed=1)

    def actions(seed, steps=60):
        explorer, state = Explorer(lift, seed), None
        taken = []
        for t in range(steps):
            action, state = explorer.predict(observation, state, np.array([t == 0]))
            taken.append(action)
        return np.array(taken)

    np.testing.assert_array_equal(actions(3), actions(3))
    assert not np.array_equal(actions(3), actions(4))
    taken = np.concatenate([actions(seed) for seed in range(12)])
    rest = (taken[:, :6] == 0).all(axis=1)
    assert 0.05 < rest.mean() < 0.5
    paused = taken[rest]
    assert (paused[:, 6] != 0).mean() > 0.9


@pytest.mark.parametrize("kind", ["novice", "sac", "td3"])
def test_our_learners_keep_the_action_that_was_executed(kind):
    def watched():
        return NeuralASMSafety(FakeEnv(10), CueMonitor((3,)), on_alarm="hold", release_after=2)

    envs = DummyVecEnv([watched])
    learner = make_novice(envs, 0) if kind == "novice" else make_learner(kind, envs, 0, False, 10)
    learner.learn(10)
    kept = learner.replay_buffer.actions[:10, 0]
    assert (kept[4:6, :2] == 0.0).all()  # the reflex rested in the two steps after the alarm
    assert np.abs(kept[[0, 1, 2, 3, 6, 7], :2]).min() > 0.0


def test_a_novice_is_untrained_and_hesitant():
    learner = make_novice(gym.make("Pendulum-v1"), 0)
    assert isinstance(learner, SAC)
    std = learner.actor.get_action_dist_params(learner.policy.obs_to_tensor(np.zeros((1, 3), np.float32))[0])[1]
    np.testing.assert_allclose(std.detach(), NOVICE_LOG_STD)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--task", "Juggle"], "Juggle"),
        (["--conditions", "hold"], "alone"),
        (["--conditions", "alone", "pray"], "terminate, hold"),
        (["--seeds", "0"], "seeds"),
        (["--harmless-torque", "0"], "harmless_torque"),
    ],
)
def test_what_makes_no_sense_is_refused(arguments, message, tmp_path, capsys):
    assert main(["reproduce", "safe_training", *arguments, "--out", str(tmp_path / "out")]) == 2
    assert message in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_a_memory_that_is_there_already_watches_and_nothing_is_explored_for_it(tmp_path):
    spec = sine_spec()
    body = tmp_path / "body.asm"
    NeuralASM(spec, 8, 8, epochs=1).fit(sine_episodes(10, 1, spec)).calibrate(sine_episodes(9, 2, spec), 0.1).save(body)
    assert safe_training.memory_of(safe_training.Config(memory=str(body), out=tmp_path / "out")) == body
    assert not (tmp_path / "out").exists()
    with pytest.raises(FileNotFoundError):
        safe_training.Config(memory=str(tmp_path / "nothing.asm"))


@pytest.mark.slow
def test_a_comparison_runs_end_to_end_and_goes_on(tmp_path):
    how = ["reproduce", "safe_training", "--quick", "--workers", "2", "--out", str(tmp_path)]
    assert main(how) == 0
    written = {p.name for p in tmp_path.iterdir() if p.is_file()}
    tables = {f"safe_training.{kind}" for kind in ("md", "csv", "json", "png", "svg")}
    assert written == {"train_safely.json", "exploration.asm", *tables}
    runs = json.loads((tmp_path / "safe_training.json").read_text())["runs"]
    assert {(r["condition"], r["seed"]) for r in runs} == {
        (c, s) for c in ("alone", "terminate", "hold") for s in (0, 1)
    }
    assert all(sum(r["over"]) >= sum(r["contacts"]) >= sum(r["noticed"]) for r in runs)
    assert all(sum(r["acted"]) == 0 for r in runs if r["condition"] != "hold")
    # A run that is lost is made again, the same, and no other.
    stamps = {p.name: p.stat().st_mtime_ns for p in (tmp_path / "outcomes").iterdir()}
    (tmp_path / "outcomes" / "hold-1.json").unlink()
    before = (tmp_path / "safe_training.csv").read_text()
    assert main(how) == 0
    again = {p.name: p.stat().st_mtime_ns for p in (tmp_path / "outcomes").iterdir()}
    assert {n for n in stamps if again[n] != stamps[n]} == {"hold-1.json"}
    assert (tmp_path / "safe_training.csv").read_text() == before
