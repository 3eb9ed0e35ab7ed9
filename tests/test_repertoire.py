"""One memory of many skills against one for each: the table, and the skills it names."""

import numpy as np
import pytest

from asm_gym.episode import load_episode
from asm_gym.scripts import evaluate
from asm_gym.scripts.cli import main as cli
from asm_gym.scripts.reproduce import repertoire
from asm_gym.scripts.reproduce.skill_recognition import naming_figure, share_right
from asm_gym.scripts.reproduce.skill_switch import NAMES, Switch, record_switch

RIGHT = [np.array([False, True, True]), np.array([False, False, True, False])]


def test_a_share_is_taken_of_what_was_named_so_many_steps_after_the_beginning():
    assert [share_right(RIGHT, n) for n in (1, 2, 3, 9)] == [0.0, 0.5, 1.0, 0.5]
    line = naming_figure({"all": RIGHT}, dt=0.5, longest_s=2.0).axes[0].lines[0]
    np.testing.assert_allclose(line.get_xdata(), [0.5, 1.0, 1.5, 2.0])
    np.testing.assert_allclose(line.get_ydata(), [0, 50, 100, 50])


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"seeds": 0}, "seeds must be at least 1, got 0"),
        ({"workers": 0}, "workers must be at least 1, got 0"),
        ({"false_alarm_rate": 1.5}, r"must be a number in \(0, 1\)"),
        ({"window": 0.0}, "window must be a number above 0"),
        ({"alone_seeds": 4}, r"alone_seeds must be in \[0, 3\], got 4"),
        ({"switches": -1}, "switches must be at least 0, got -1"),
        ({"experience": -3}, "experience must be at least 0, got -3"),
        ({"monitors": ("oracle",)}, "unknown monitor 'oracle'"),
        ({"monitors": ()}, "number of monitors must be at least 1"),
    ],
)
def test_arguments_that_make_no_sense_are_refused(arguments, message):
    with pytest.raises(ValueError, match=message):
        repertoire.Config(**arguments)


def test_a_folder_without_recordings_is_refused(capsys, tmp_path):
    assert cli(["reproduce", "repertoire", "--run", str(tmp_path / "nowhere"), "--out", str(tmp_path / "r")]) == 2
    assert "nowhere holds recordings of 0 tasks, and a repertoire needs two" in capsys.readouterr().err
    assert not (tmp_path / "r").exists()


def test_an_episode_with_a_change_of_skill_is_recorded_once(tmp_path):
    path = record_switch(tmp_path / "0.npz")
    written = path.stat().st_mtime_ns
    assert record_switch(path).stat().st_mtime_ns == written
    switch = Switch.read(path, load_episode(path).spec)
    assert set(switch.skills[: switch.changed]) | set(switch.skills[switch.changed :]) == set(NAMES.values())
    assert len(set(switch.skills[: switch.changed])) == len(set(switch.skills[switch.changed :])) == 1
    assert len(switch.skills) == len(switch.episode)


def cells(table: str) -> list[list[str]]:
    """The rows of a table of Markdown, without its head."""
    return [[cell.strip() for cell in line.strip("| ").split("|")] for line in table.splitlines()[2:]]


@pytest.mark.slow
def test_it_compares_one_memory_with_one_for_each_task(tmp_path):
    recorded = [
        *("--tasks", "Lift", "PickPlaceCan", "PickPlaceMilk", "--faults", "push", "--severities", "strong"),
        *("--harmless", "touch", "--harmless-episodes", "1", "--monitors", "force_limit", "--no-video"),
        *("--fit-episodes", "8", "--calibration-episodes", "20", "--nominal-episodes", "3", "--faulty-episodes", "2"),
        *("--false-alarm-rate", "0.05"),
    ]
    assert evaluate.main([*recorded, "--out", str(tmp_path / "run")]) == 0
    asked = [
        "--run",
        str(tmp_path / "run"),
        "--monitors",
        "neural_asm",
        "--seeds",
        "2",
        "--switches",
        "2",
        "--experience",
        "3",
    ]
    assert cli(["reproduce", "repertoire", *asked, "--false-alarm-rate", "0.05", "--out", str(tmp_path / "out")]) == 0
    seeds, alone, naming, alarms = map(cells, (tmp_path / "out" / "repertoire.md").read_text().split("\n\n")[1::2])
    assert [r[0] for r in alone] == ["Lift", "PickPlaceCan", "PickPlaceMilk"]
    assert len(seeds) == 1
    assert float(seeds[0][1].split(" ± ")[0]) > 0.9  # strong pushes
    named = [float(cell.split(" ± ")[0]) for cell in naming[0][1:]]
    assert named[-1] > 80  # three skills, five seconds
    assert [r[0] for r in alarms] == ["of single skills", "that has seen 3 changes"]
    assert {p.stem for p in (tmp_path / "out" / "experience").iterdir()} == {"5000", "5001", "5002"}
    assert (tmp_path / "out" / "repertoire.png").stat().st_size > 5000
