"""One folder, one run, one command at a time; what is there is not made again."""

import os
import re
import subprocess
import sys

import pytest

from asm_gym.rollouts.folder import LOCK, claimed, locked, make_missing
from asm_gym.scripts.cli import main

HOLD = """
import sys, time
from pathlib import Path
from asm_gym.rollouts.folder import locked

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
    assert str(holder.pid) in (tmp_path / LOCK).read_text()
    with locked(tmp_path):
        assert f"process {os.getpid()} " in (tmp_path / LOCK).read_text()
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
    assert [p.name for p in tmp_path.iterdir()] == [LOCK]
