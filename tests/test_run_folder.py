"""One folder, one run, one command at a time; what is there is not made again."""

import os
import re
import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest

from asm_gym.episode import Episode, EpisodeLabel
from asm_gym.evaluation.comparison import LeftOut
from asm_gym.evaluation.recordings import NOMINAL_ROLES, Recordings
from asm_gym.rollouts.run_folder import HOLDER, LOCK, claimed, locked, make_missing
from asm_gym.scripts.cli import main
from tests.streams import sine_episodes

HOLD = """
import sys, time
from pathlib import Path
from asm_gym.rollouts.run_folder import locked

with locked(Path(sys.argv[1])):
    print("held", flush=True)
    time.sleep(600)
"""


@pytest.fixture
def holder(tmp_path):
    """Another process that works in the folder."""
    process = subprocess.Popen([sys.executable, "-c", HOLD, str(tmp_path)], stdout=subprocess.PIPE, text=True)
    assert process.stdout.readline() == "held\n"
    yield process
    process.kill()
    process.wait()


def test_a_second_command_is_refused_with_a_line_that_names_the_first(holder, tmp_path):
    with pytest.raises(BlockingIOError) as refused, locked(tmp_path):
        pass
    said = str(refused.value)
    assert "\n" not in said
    assert re.search(rf"{re.escape(str(tmp_path))} is in use by process {holder.pid} on \S+, since \d{{4}}-", said)


def test_the_lock_of_a_killed_command_is_taken_over(holder, tmp_path):
    holder.kill()
    holder.wait()
    assert str(holder.pid) in (tmp_path / HOLDER).read_text()
    with locked(tmp_path):
        assert f"process {os.getpid()} " in (tmp_path / HOLDER).read_text()
    assert not list(tmp_path.iterdir())


def test_the_lock_goes_with_an_error_too(tmp_path):
    with pytest.raises(ZeroDivisionError), locked(tmp_path):
        raise ZeroDivisionError
    with locked(tmp_path), pytest.raises(BlockingIOError), locked(tmp_path):
        pass


def test_a_run_goes_on_with_its_settings_and_is_refused_with_others(tmp_path):
    for _ in range(2):
        with claimed(tmp_path, "run.json", {"seed": 1, "task": "Lift"}):
            pass
    with pytest.raises(ValueError, match="seed: 1 there, 2 here"), claimed(tmp_path, "run.json", {"seed": 2}):
        pass


def test_only_what_is_missing_is_made(tmp_path):
    def make(n):
        (tmp_path / str(n)).write_text("new")
        return tmp_path / str(n)

    (tmp_path / "1").write_text("old")
    seen = []
    made = make_missing(make, [0, 1, 2], lambda n: tmp_path / str(n), 1, lambda done, total: seen.append((done, total)))
    assert [p.read_text() for p in made] == ["new", "old", "new"]
    assert seen == [(1, 3), (2, 3), (3, 3)]


@pytest.mark.parametrize(
    "command",
    [["collect", "Pendulum-v1", "--policy", "hold"], ["train", "Pendulum-v1", "--demonstrations", "0", "--steps", "9"]],
)
def test_two_commands_on_one_folder_are_one_too_many(command, holder, tmp_path, capsys):
    assert main([*command, "--out", str(tmp_path)]) == 2
    assert f"in use by process {holder.pid} on" in capsys.readouterr().err
    assert sorted(p.name for p in tmp_path.iterdir()) == [LOCK, HOLDER]


def recording(role: str, seed: int, force: float, success: bool = True) -> Episode:
    made = sine_episodes(1)[0]
    kind = {"kind": "push", "severity": "mild", "onset": 5} if role == "faulty" else {}
    forces = np.full(len(made), force, np.float32)
    return replace(made, success=success, label=EpisodeLabel("Lift", role, seed=seed, **kind), contact_force=forces)


def test_episodes_that_fail_or_crash_by_themselves_are_not_what_is_normal():
    nominal = [recording(role, seed, 10.0) for seed, role in enumerate(["fit", "fit", "calibration", "nominal"])]
    crash, failure = recording("nominal", 7, 21.0), recording("fit", 8, 90.0, success=False)
    faulty = [recording("faulty", seed, 300.0) for seed in (3, 7)]
    found = Recordings.of([*nominal, crash, failure, *faulty])
    assert found.left_out == LeftOut(failed=1, crashed=1)
    assert [e.labelled.seed for e in found.roles["faulty"]] == [3]
    assert [e.labelled.seed for role in ("fit", "calibration", "nominal") for e in found.roles[role]] == [0, 1, 2, 3]
    assert [e.labelled.seed for e in found.twins] == [3, 7]


def test_where_no_force_is_known_nothing_counts_as_a_crash():
    episodes = [replace(recording(role, 0, 1.0), contact_force=np.zeros(0, np.float32)) for role in NOMINAL_ROLES]
    assert Recordings.of(episodes).left_out == LeftOut(0, 0)
