"""The evaluation goes on after a kill, refuses to mix runs, and gives the same table every time."""

import json
import re
import subprocess
import sys
import time
from dataclasses import replace

import gymnasium as gym
import numpy as np
import pyarrow.parquet as pq
import pytest
from asm_gym.rollouts.record import record

from asm_gym.episode import Episode, EpisodeLabel, load_episode
from asm_gym.monitors import load_monitor, registry
from asm_gym.rollouts.parallel import ParallelConfig, parallel_map
from asm_gym.rollouts.seeds import draw_onset
from asm_gym.rollouts.trial import RolloutConfig
from asm_gym.scripts import command
from asm_gym.scripts.evaluate import Args, labels, main
from asm_gym.spec import Channel, StreamSpec

MONITORS = ("neural_asm", "kalman+evidence", "window_pca", "force_limit")
SMALL = [
    *("--tasks", "Lift", "--faults", "push", "frozen_encoder", "gripper_opens", "--severities", "mild", "strong"),
    *("--harmless", "touch", "slower", "--fit-episodes", "4", "--calibration-episodes", "24"),
    *("--monitors", *MONITORS),
    *("--nominal-episodes", "4", "--faulty-episodes", "2", "--harmless-episodes", "1"),
    *("--false-alarm-rate", "0.05", "--workers", "1", "--no-video"),
]


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    folder = tmp_path_factory.mktemp("evaluate")
    assert main([*SMALL, "--out", str(folder)]) == 0
    return folder


def test_it_writes_what_it_promises(run):
    rows = pq.read_table(run / "results.parquet").to_pylist()
    assert len(rows) == len(MONITORS) * (4 + 3 * 2 * 2 + 2)
    push = [r for r in rows if r["kind"] == "push" and r["severity"] == "strong"]
    assert all(r["ideal_separation"] > 100 and len(r["surprise"]) == r["steps"] for r in push)
    assert all(r["ideal_delay_s"] == pytest.approx(0.05) for r in push)
    report = (run / "report.html").read_text()
    # Typical episodes of a push and a frozen encoder, what they sensed and what surprised.
    assert report.count("<svg ") == 4 + 1 + 4
    assert "ideal observer" in report
    said = re.sub(r"base64,[\w+/=]+", "", report)  # of pictures, in which four letters stand by chance
    assert "http" not in said.replace("http://www.w3.org", "")
    assert json.loads((run / "results.json").read_text())["settings"]["seed"] == 0


def test_faulty_episodes_are_twins_until_the_onset(run):
    faulty = [load_episode(p) for p in sorted((run / "episodes/Lift/faulty").glob("*.npz"))]
    assert len(faulty) == 12
    for episode in faulty:
        label = episode.label
        twin = load_episode(run / EpisodeLabel("Lift", "nominal", seed=label.seed).path).stream
        onset = label.onset
        np.testing.assert_array_equal(episode.stream[:onset], twin[:onset])
        assert episode.faults.argmax() == onset
        assert len(episode) == onset + 40


def test_recordings_say_where_the_cube_was_seen(run):
    env = gym.make("asm_gym/Lift-v0", robot="Panda", observation="dict")
    for path in sorted((run / "episodes/Lift").glob("*/*.npz"))[::9]:
        episode = load_episode(path)
        seen, _ = env.reset(seed=episode.label.seed)
        np.testing.assert_array_equal(episode.info["goal"], np.append(seen["cube_pos"], seen["gripper_to_cube_pos"]))


def test_it_goes_on_where_it_was_killed_and_gives_the_same_table(run):
    table, recordings = (run / "results.md").read_text(), sorted(run.glob("episodes/*/*/*.npz"))
    kept = {p: p.stat().st_mtime_ns for p in recordings[::2]}
    for path in recordings[1::2]:
        path.unlink()
    (run / "results.parquet").unlink()
    assert main([*SMALL, "--out", str(run)]) == 0
    assert sorted(run.glob("episodes/*/*/*.npz")) == recordings
    assert {p: p.stat().st_mtime_ns for p in kept} == kept
    assert (run / "results.md").read_text() == table


def test_a_folder_of_other_settings_is_refused(run, capsys):
    before = sorted(run.rglob("*"))
    assert main([*SMALL, "--out", str(run), "--seed", "1"]) == 2
    assert "seed: 0 there, 1 here" in capsys.readouterr().err
    assert sorted(run.rglob("*")) == before


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ("--faults flood", "'flood'.*push"),
        ("--tasks Juggle", "'Juggle'.*Lift"),
        ("--monitors oracle", "'oracle'.*neural_asm"),
        ("--monitors force_limit+magic", "'magic'.*evidence"),
        ("--severities deadly", "'deadly'.*mild"),
        ("--harmless hurricane", "'hurricane'.*touch"),
        ("--false-alarm-rate 0.001", "needs 999 calibration"),
        ("--faulty-episodes 5", "at most 4, got 5"),
        ("--fit-episodes 0", "fit_episodes.*0"),
        ("--workers dask", "address"),
        ("--workers many", "workers must be a number"),
        ("--policy door_sac", "door_sac takes observations of 41"),
        ("--policy nobody.npz", "nobody.npz"),
        ("--settings gru.hidden_size=8", "monitor with settings 'gru'; known: "),
        ("--settings kalman.ridges=1", "hyperparameter of kalman 'ridges'; known: .*did you mean 'ridge'"),
        ("--settings kalman.ridge", "like gru.learning_rate=0.0003, got 'kalman.ridge'"),
        ("--settings kalman.ridge=one", "kalman.ridge must be a number.*'one'"),
        ("--settings kalman.ridge=-1", "ridge must be"),
    ],
)
def test_arguments_that_make_no_sense_are_refused(arguments, message, tmp_path, capsys):
    assert main([*SMALL, *arguments.split(), "--out", str(tmp_path)]) == 2
    assert re.search(message, capsys.readouterr().err)
    assert not list(tmp_path.iterdir())


def test_any_model_may_be_asked_for_under_any_detection():
    name = "external_torque_limit+evidence"
    assert name not in registry.MONITORS
    assert Args(monitors=(name, "neural_asm")).monitors[0] == name


def test_a_monitor_of_the_table_is_set_otherwise_under_every_detection(run):
    asked = [*SMALL, "--out", str(run), "--monitors", "kalman", "kalman+evidence", "force_limit"]
    assert main([*asked, "--settings", "kalman.ridge=0.03"]) == 0
    fitted = [load_monitor(p) for p in (run / "monitors").glob("kalman-*")]
    assert sorted(m.get_params()["ridge"] for m in fitted)[-1] == 0.03
    assert "kalman.ridge=0.03" in (run / "report.html").read_text()


def test_quick_is_less_of_everything():
    quick = command.parse("evaluate", Args, ["--quick"])
    assert quick.tasks == ("Lift", "Stack", "Door")
    assert quick.severities == ("strong",)
    assert quick.episodes("calibration") * 3 >= 19
    with pytest.raises(ValueError, match="window"):
        Args(window=-1.0)
    made = labels(Args(tasks=("Door",), faults=("push", "slip"), harmless=("touch",), false_alarm_rate=0.05))
    assert {label.kind for label in made} == {"", "push", "touch"}  # a door is nothing that could slip
    assert len({label.path for label in made}) == len(made)


def test_quick_keeps_what_was_asked_for():
    asked = ["--monitors", "neural_asm", "gru", "--tasks", "PickPlaceCan", "--fit-episodes", "60"]
    args = command.parse("evaluate", Args, ["--quick", *asked])
    assert args.monitors == ("neural_asm", "gru")
    assert args.tasks == ("PickPlaceCan",)
    assert (args.fit_episodes, args.nominal_episodes, args.episodes("calibration")) == (60, 8, 19)


def test_onsets_leave_room_before_and_after():
    onsets = [draw_onset(seed, 200) for seed in range(300)]
    assert min(onsets) >= 10
    assert max(onsets) < 100
    assert len(set(onsets)) > 50


@pytest.mark.slow
def test_a_cluster_that_loses_a_worker_makes_the_same_recordings(tmp_path):
    wanted = [EpisodeLabel("Lift", "fit", seed=s) for s in range(12)]
    distributed = [sys.executable, "-m", "distributed.cli.dask_scheduler", "--port", "0", "--no-dashboard"]
    file = tmp_path / "scheduler.json"
    quiet = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
    scheduler = subprocess.Popen([*distributed, "--scheduler-file", str(file), "--host", "127.0.0.1"], **quiet)
    worker = [sys.executable, "-m", "distributed.cli.dask_worker", "--scheduler-file", str(file), "--nthreads", "1"]
    workers = [subprocess.Popen([*worker, "--no-nanny", "--no-dashboard"], **quiet) for _ in range(2)]
    try:
        while not file.is_file():
            time.sleep(0.2)
        address = json.loads(file.read_text())["address"]
        here, there = tmp_path / "here", tmp_path / "there"

        def kill_one(done, _):
            if done == 3:
                workers[0].kill()

        job = _Recorder(there)
        parallel_map(job, wanted, ParallelConfig(2, "dask", address), kill_one)
        assert workers[0].wait(10) != 0
        parallel_map(_Recorder(here), wanted, 1)
        for label in wanted:
            a, b = load_episode(here / label.path), load_episode(there / label.path)
            np.testing.assert_array_equal(a.stream, b.stream)
    finally:
        for process in (*workers, scheduler):
            process.kill()


class _Recorder:
    """Records into a folder; a class, so that a cluster can be handed it."""

    def __init__(self, folder):
        self.folder = folder

    def __call__(self, label):
        return record(label, RolloutConfig(), self.folder)


def test_episodes_come_in_turn_by_task_and_in_another_order_for_each_seed():
    from asm_gym.scripts.reproduce.recordings import in_turn

    first, second = (in_turn(_labelled(), seed) for seed in (0, 1))
    assert [e.labelled.task for e in first] == ["Lift", "Stack"] * 2 + ["Stack"]
    assert [e.labelled.seed for e in first] != [e.labelled.seed for e in second]


def _labelled():
    """Two episodes of one task, and three of another."""
    spec = StreamSpec((Channel("a", 1),), 0.05)
    tasks = ["Lift"] * 2 + ["Stack"] * 3
    made = (Episode.from_stream(np.zeros((3, 1)), spec, success=True) for _ in tasks)
    return [replace(e, label=EpisodeLabel(t, "fit", seed=n)) for n, (e, t) in enumerate(zip(made, tasks, strict=True))]
