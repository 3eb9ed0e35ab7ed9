"""What a user's type checker and an old installation say."""

from __future__ import annotations

import site
import subprocess
import sys
import venv
import zipfile
from typing import get_args

import pytest

from asm_gym.guard.options import ON_ALARM, OnAlarmName
from tests.needs import needs
from tests.wheel import ROOT, build_wheel

OLD = """
import sys, types
old = types.ModuleType("gymnasium")
old.__version__, old.vector = "0.29.1", types.ModuleType("gymnasium.vector")
sys.modules["gymnasium"], sys.modules["gymnasium.vector"] = old, old.vector
import asm_gym
"""

USERS = """
import gymnasium as gym
import numpy as np

from asm_gym import Channel, Episode, FaultInjection, NeuralASM, NeuralASMSafety, StreamSpec
from asm_gym import VectorNeuralASMSafety, collect, make_monitor, make_policy
from asm_gym.faults import Push

env = NeuralASMSafety(gym.make("asm_gym/Lift-v0"), on_alarm="graded")
policy = make_policy("lift_sac", env)
observation, info = env.reset(seed=0)
action, _ = policy.predict(observation)
observation, reward, terminated, truncated, info = env.step(action)
print(float(reward), terminated or truncated, info["asm"]["alarms"])

spec = StreamSpec((Channel("q", 7, "rad"), Channel("action", 7, group="action")), dt=0.05)
episodes = [Episode.from_stream(np.zeros((100, 14), np.float32), spec) for _ in range(3)]
asm = NeuralASM(spec).fit(episodes).calibrate(episodes, false_alarm_rate=0.01)
asm.save("lift.asm")
for limit in NeuralASM.load("lift.asm").limits().limits:
    print(limit.label, limit.high)
recorded: list[Episode] = collect("asm_gym/Lift-v0", policy="scripted", episodes=2)
vector = VectorNeuralASMSafety(gym.make_vec("asm_gym/Lift-v0", num_envs=2))
faulty = FaultInjection(env, [Push(onset=20)])
print(make_monitor("kalman", spec).fit(recorded).threshold, vector.num_envs, faulty)
wrong: int = asm.threshold_at(0.01)
"""


@pytest.mark.slow
@pytest.mark.parametrize("installed_from", ["clone", "wheel"])
def test_the_types_of_a_users_script_are_checked_after_an_install(installed_from, tmp_path):
    needs("mypy")
    venv.create(tmp_path / "venv")
    (packages,) = tmp_path.glob("venv/lib/*/site-packages")
    (packages / "libraries.pth").write_text("\n".join(site.getsitepackages()))
    if installed_from == "wheel":
        with zipfile.ZipFile(build_wheel(tmp_path)) as wheel:
            wheel.extractall(packages)
    else:  # as ``pip install -e`` leaves it
        (packages / "clone.pth").write_text(str(ROOT))
    script = tmp_path / "users.py"
    script.write_text(USERS)
    python = tmp_path / "venv" / "bin" / "python"
    command = [sys.executable, "-m", "mypy", "--strict", "--python-executable", str(python)]
    command += ["--cache-dir", str(tmp_path / "cache"), script.name]
    found = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True)
    last_line = len(USERS.splitlines())
    (error,) = [line for line in found.stdout.splitlines() if ": error:" in line]
    assert error.startswith(f"{script.name}:{last_line}: ")
    assert "float" in error


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
    # elsewhere than in the repository: types come from the install
    found = subprocess.run(command, capture_output=True, text=True, cwd=tmp_path)
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
