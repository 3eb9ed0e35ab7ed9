"""The evaluation continues after a kill, refuses to mix runs, and gives the same table every time."""

import re

import numpy as np
import pytest

from asm_gym.data.episode import EpisodeLabel, load_episode
from asm_gym.scripts import command
from asm_gym.scripts.evaluate import Args, main, trials_of
from asm_gym.version import __version__

MONITORS = ("neural_asm", "kalman+evidence", "association_linear")
SMALL = [
    *(
        "--tasks",
        "Lift",
        "--faults",
        "push",
        "frozen_encoder",
        "gripper_opens",
        "--severities",
        "mild",
        "strong",
    ),
    *("--fit-episodes", "4", "--calibration-episodes", "24"),
    *("--monitors", *MONITORS),
    *("--nominal-episodes", "4", "--faulty-episodes", "2"),
    *("--false-alarm-rate", "0.05", "--workers", "1"),
]


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    folder = tmp_path_factory.mktemp("evaluate")
    assert main([*SMALL, "--out", str(folder)]) == 0
    return folder


def test_it_writes_tables_and_a_report(run):
    tables = (run / "results.md").read_text()
    assert all(name in tables for name in MONITORS)
    report = (run / "report.html").read_text()
    assert "ideal observer" in report
    assert f"asm-gym {__version__}" in report
    assert "http" not in report.replace("http://www.w3.org", "")


def test_faulty_episodes_are_twins_until_the_onset(run):
    faulty = [load_episode(p) for p in sorted((run / "episodes/Lift/faulty").glob("*.npz"))]
    assert len(faulty) == 12
    for episode in faulty:
        label = episode.label
        twin = load_episode(run / EpisodeLabel("Lift", "nominal", seed=label.seed).path).stream
        np.testing.assert_array_equal(episode.stream[: label.onset], twin[: label.onset])
        assert episode.faults.argmax() == label.onset
        assert len(episode) == label.onset + 40


def test_it_continues_where_it_was_killed_and_gives_the_same_table(run):
    table, recordings = (run / "results.md").read_text(), sorted(run.glob("episodes/*/*/*.npz"))
    kept = {p: p.stat().st_mtime_ns for p in recordings[::2]}
    for path in recordings[1::2]:
        path.unlink()
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
        ("--monitors kalman+magic", "'magic'.*evidence"),
        ("--severities deadly", "'deadly'.*mild"),
        ("--false-alarm-rate 0.001", "needs 999 calibration"),
        ("--faulty-episodes 5", "at most 4, got 5"),
        ("--fit-episodes 0", "fit_episodes.*0"),
        ("--workers many", "many"),
        ("--policy door_sac", "door_sac takes observations of 41"),
        ("--policy nobody.npz", "nobody.npz"),
        ("--steps 9", "--steps"),
    ],
)
def test_impossible_arguments_are_refused(arguments, message, tmp_path, capsys):
    assert main([*SMALL, *arguments.split(), "--out", str(tmp_path)]) == 2
    assert re.search(message, capsys.readouterr().err)
    assert not list(tmp_path.iterdir())


def test_quick_is_less_of_everything_that_was_not_asked_for():
    asked = [
        "--quick",
        "--monitors",
        "neural_asm",
        "gru",
        "--tasks",
        "PickPlaceCan",
        "--fit-episodes",
        "60",
    ]
    args = command.parse("evaluate", Args, asked)
    assert (args.monitors, args.tasks, args.severities) == (
        ("neural_asm", "gru"),
        ("PickPlaceCan",),
        ("strong",),
    )
    assert [args.episodes[role] for role in ("fit", "nominal", "calibration")] == [60, 8, 19]


def test_a_fault_that_cannot_happen_in_a_task_is_left_out():
    args = Args(tasks=("Door",), faults=("push", "slip"), false_alarm_rate=0.05)
    trials = trials_of(args, "Door")
    assert {trial.label.kind for trial in trials} == {"", "push"}  # nothing could slip from a door
    assert len({trial.label.path for trial in trials}) == len(trials)
