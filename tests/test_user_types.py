"""What a user's type checker and an old installation say."""

from __future__ import annotations

import subprocess
import sys
from typing import get_args

from asm_gym.guard.options import ON_ALARM, OnAlarmName
from tests.needs import needs

OLD = """
import sys, types
old = types.ModuleType("gymnasium")
old.__version__, old.vector = "0.29.1", types.ModuleType("gymnasium.vector")
sys.modules["gymnasium"], sys.modules["gymnasium.vector"] = old, old.vector
import asm_gym
"""


def test_a_misspelt_response_fails_the_type_checker(tmp_path):
    needs("mypy")
    assert get_args(OnAlarmName) == ON_ALARM
    script = tmp_path / "guard.py"
    lines = (
        "from asm_gym.guard.options import OnAlarm",
        'good: OnAlarm = "hold"',
        'bad: OnAlarm = "hodl"',
    )
    script.write_text("\n".join(lines) + "\n")
    command = [
        sys.executable,
        "-m",
        "mypy",
        "--follow-imports=silent",
        "--cache-dir",
        str(tmp_path),
        str(script),
    ]
    found = subprocess.run(command, capture_output=True, text=True)
    assert [
        line.split(":")[1]
        for line in found.stdout.splitlines()
        if "error" in line and "guard.py" in line
    ] == ["3"]


def test_an_old_gymnasium_is_one_line_that_says_what_to_do():
    found = subprocess.run([sys.executable, "-c", OLD], capture_output=True, text=True)
    last = found.stderr.strip().splitlines()[-1]
    assert (
        last
        == "ImportError: asm-gym needs Gymnasium 1.1 or newer, got 0.29.1: pip install --upgrade gymnasium"
    )


def test_an_id_with_its_package_needs_no_import():
    make = 'import gymnasium as gym; print(gym.make("asm_gym:asm_gym/SyntheticArm-v0").reset(seed=0)[0].shape)'
    assert subprocess.run(
        [sys.executable, "-c", make], capture_output=True, text=True
    ).stdout.startswith("(")
