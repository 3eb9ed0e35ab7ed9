"""What an extra brings is enough for what needs it: each in a fresh environment, with nothing else installed.

    python -m tests.extras              all of them, minutes each; make extras
    python -m tests.extras learners     one
    python -m tests.extras pairs        every two resolved together, and each installed after robosuite

A test may be skipped where it says another extra that it needs, and for no other reason.
"""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
import venv
from itertools import combinations
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import NamedTuple

from packaging.version import Version

from tests.wheel import ROOT, build_wheel


class Check(NamedTuple):
    """What is installed, and what must run then.

    Attributes:
        extras: of asm-gym.
        tests: as pytest takes them.
        also: packages that no extra brings, and that are read where they are there.
        pins: a package that one of those pins, so that ``constraints.txt`` may not.
    """

    extras: str
    tests: str
    also: str = ""
    pins: str = ""


CHECKS = {
    "logs": Check(
        "report,ros", "tests/test_logs.py tests/test_live.py tests/test_log_formats.py", "mcap pandas polars"
    ),
    "dds": Check("report,dds", "tests/test_dds.py"),
    "rerun": Check("report,rerun", "tests/test_rerun.py"),
    "onnx": Check("onnx", "tests/test_export.py"),
    "data": Check("robosuite,data,report", "tests/test_datasets.py"),
    "agents": Check("agents", "tests/test_learners.py"),
    "learners": Check("learners", "tests/test_learners.py"),
    "rllib": Check("cluster", "tests/test_learners.py", "ray[rllib] torch", pins="gymnasium"),
    "cluster": Check("robosuite,report,cluster", "tests/test_parallel.py -k cluster"),
    "notebooks": Check("robosuite,report,notebooks", "tests/test_notebooks.py"),
    "hub": Check("hub", "tests/test_hub.py"),
    "environments": Check("environments,report", "tests/test_elsewhere.py"),
    "robosuite": Check("robosuite,report,video", "tests/test_robosuite_env.py -m 'not slow'", "stable-baselines3"),
}


def check(name: str, wheel: Path) -> str:
    """What is wrong with an extra, or nothing."""
    extras, tests, also, pins = CHECKS[name]
    with TemporaryDirectory() as folder:
        venv.create(folder, with_pip=True)
        tested = (ROOT / "constraints.txt").read_text().splitlines(keepends=True)
        Path(folder, "constraints.txt").write_text("".join(t for t in tested if t.split("==")[0] != pins))
        install = f"pip install -q -c {folder}/constraints.txt '{wheel}[{extras}]' {also} pytest"
        if subprocess.run(f"{folder}/bin/python -m {install}", shell=True, cwd=ROOT).returncode:
            return f"could not be installed: {install}"
        there = {key: value for key, value in os.environ.items() if key != "PYTHONPATH"}
        command = f"{folder}/bin/python -m pytest -q -rs {tests}"
        print(f"{name}: {command}", flush=True)
        done = subprocess.run(command, shell=True, cwd=ROOT, env=there, stdout=subprocess.PIPE, text=True)
    print(done.stdout, flush=True)
    wrong = [] if done.returncode == 0 else [f"pytest ended with {done.returncode}"]
    ours = re.compile(rf"asm-gym\[({extras.replace(',', '|')})\]")
    skipped = [line for line in done.stdout.splitlines() if line.startswith("SKIPPED")]
    return "; ".join(wrong + [line for line in skipped if "pip install" not in line or ours.search(line)])


EXTRAS = (
    *("robosuite", "report", "data", "agents", "environments", "learners", "hub", "notebooks"),
    *("cluster", "rerun", "ros", "video"),
)
BREAKS = {"mujoco": "3.10", "dm-control": "1.0.40", "numpy": "3", "pyarrow": "22"}
"""From which version on a package has not been tried, or breaks environments."""
STILL_RUNS = (
    "import gymnasium as gym; from asm_gym import NeuralASMSafety; e = NeuralASMSafety(gym.make('asm_gym/Lift-v0'));"
    "e.reset(seed=0); print(e.step(e.action_space.sample())[-1]['asm']['state'])"
)


def pairs(wheel: Path) -> str:
    """What is wrong with two extras at once, by the newest versions there are; or with one after robosuite."""
    wrong = []
    with TemporaryDirectory() as folder:
        venv.create(folder, with_pip=True)
        pip, plan = f"{folder}/bin/python -m pip install -q", Path(folder, "plan.json")
        for two in combinations(EXTRAS, 2):
            wanted = f"'{wheel}[{','.join(two)}]'"
            plan.unlink(missing_ok=True)
            subprocess.run(f"{pip} --dry-run --ignore-installed --report {plan} {wanted}", shell=True, cwd=ROOT)
            found = json.loads(plan.read_text())["install"] if plan.is_file() else []
            versions = {re.sub("_", "-", i["metadata"]["name"].lower()): i["metadata"]["version"] for i in found}
            late = [f"{n} {v}" for n, v in versions.items() if n in BREAKS and Version(v) >= Version(BREAKS[n])]
            wrong += [f"{'+'.join(two)}: {', '.join(late) or 'cannot be installed'}"] if late or not found else []
            print("+".join(two), *(f"{n} {versions.get(n)}" for n in ("mujoco", "numpy", "torch")), flush=True)
        for extra in EXTRAS:
            python = f"{folder}/bin/python"
            tried = f"{pip} '{wheel}[{extra}]' && {python} -m pip check -q && {python} -c \"{STILL_RUNS}\""
            there = {key: value for key, value in os.environ.items() if key != "PYTHONPATH"}
            done = subprocess.run(tried, shell=True, cwd=folder, env=there)
            wrong += [f"{extra} after robosuite"] if done.returncode else []
    return "; ".join(wrong)


def main(names: list[str]) -> int:
    """Checks some or all, and returns 1 where one is wrong."""
    with TemporaryDirectory() as folder:
        wheel = build_wheel(Path(folder))
        said = {name: pairs(wheel) if name == "pairs" else check(name, wheel) for name in names or (*CHECKS, "pairs")}
    for name, wrong in said.items():
        print(f"{name:<14} {wrong or 'ok'}")
    return int(any(said.values()))


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
