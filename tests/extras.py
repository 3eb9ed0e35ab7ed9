"""What an extra brings is enough for what needs it: each in a fresh environment, with nothing else installed.

    python -m tests.extras              all of them, minutes each; make extras
    python -m tests.extras learners     one
    python -m tests.extras pairs        every two resolved together, and each installed after robosuite
    python -m tests.extras matrix       `make test` under every Python and NumPy; make matrix. What is committed counts.

A test may be skipped where it says another extra that it needs, and for no other reason.
"""

from __future__ import annotations

import os
import re
import subprocess
import sys
import venv
from itertools import combinations
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import NamedTuple

from asm_gym.extras import ROBOSUITE
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
    "logs": Check("report,ros", "tests/test_logs.py tests/test_live.py", "mcap pandas polars"),
    "dds": Check("report,dds", "tests/test_dds.py"),
    "rerun": Check("report,rerun", "tests/test_live_view.py"),
    "data": Check("robosuite,data,report", "tests/test_datasets.py"),
    "agents": Check("agents", "tests/test_learners.py"),
    "learners": Check("learners", "tests/test_learners.py"),
    "tianshou": Check("agents", "tests/test_learners.py", "tianshou"),
    "rllib": Check("report", "tests/test_learners.py", "ray[rllib] torch", pins="gymnasium"),
    "notebooks": Check("robosuite,report,notebooks", "tests/test_docs.py -k notebook"),
    "environments": Check("environments,report", "tests/test_elsewhere.py"),
    "robosuite": Check(
        "robosuite,report,video", "tests/test_robosuite_env.py -m 'not slow'", "stable-baselines3"
    ),
}


def check(name: str, wheel: Path) -> str:
    """What is wrong with an extra, or nothing."""
    extras, tests, also, pins = CHECKS[name]
    with TemporaryDirectory() as folder:
        venv.create(folder, with_pip=True)
        tested = (ROOT / "constraints.txt").read_text().splitlines(keepends=True)
        Path(folder, "constraints.txt").write_text(
            "".join(t for t in tested if t.split("==")[0] != pins)
        )
        install = f"pip install -q -c {folder}/constraints.txt '{wheel}[{extras}]' {also} pytest"
        if "robosuite" in extras:
            install += f" && {folder}/bin/python -m pip install -q --no-deps {ROBOSUITE}"
        if subprocess.run(f"{folder}/bin/python -m {install}", shell=True, cwd=ROOT).returncode:
            return f"could not be installed: {install}"
        there = {key: value for key, value in os.environ.items() if key != "PYTHONPATH"}
        command = f"{folder}/bin/python -m pytest -q -rs {tests}"
        print(f"{name}: {command}", flush=True)
        done = subprocess.run(
            command, shell=True, cwd=ROOT, env=there, stdout=subprocess.PIPE, text=True
        )
    print(done.stdout, flush=True)
    wrong = [] if done.returncode == 0 else [f"pytest ended with {done.returncode}"]
    ours = re.compile(rf"asm-gym\[({extras.replace(',', '|')})\]")
    skipped = [line for line in done.stdout.splitlines() if line.startswith("SKIPPED")]
    return "; ".join(
        wrong + [line for line in skipped if "pip install" not in line or ours.search(line)]
    )


EXTRAS = (
    *("robosuite", "report", "data", "agents", "environments", "learners", "notebooks"),
    *("ros", "video", "dds", "rerun"),
)
STILL_RUNS = (
    "import gymnasium as gym; from asm_gym import NeuralASMSafety; e = NeuralASMSafety(gym.make('asm_gym/Lift-v0'));"
    "e.reset(seed=0); print(e.step(e.action_space.sample())[-1]['asm']['state'])"
)


def pairs(wheel: Path) -> str:
    """What is wrong with two extras at once, by the newest versions there are; or with one after robosuite."""
    wrong = []
    there = {key: value for key, value in os.environ.items() if key != "PYTHONPATH"}
    there |= {"UV_FIND_LINKS": os.environ.get("PIP_FIND_LINKS", "")}
    with TemporaryDirectory() as folder:
        venv.create(folder, with_pip=True)
        python, uv = f"{folder}/bin/python", [f"{folder}/bin/uv", "pip"]
        subprocess.run([python, "-m", "pip", "install", "-q", "uv"], check=True)
        resolve = [*uv, "compile", "-q", "--no-annotate", "--no-header", "--python", python, "-"]
        for two in combinations(EXTRAS, 2):
            wanted = f"asm-gym[{','.join(two)}] @ {wheel.as_uri()}"
            done = subprocess.run(resolve, input=wanted, env=there, capture_output=True, text=True)
            versions = dict(line.split("==") for line in done.stdout.splitlines() if "==" in line)
            if done.returncode:
                wrong.append(f"{'+'.join(two)}: {done.stderr.strip()}")
            print(
                "+".join(two),
                *(f"{n} {versions.get(n)}" for n in ("mujoco", "numpy", "torch")),
                flush=True,
            )
        # PyTorch as in constraints.txt, of which this machine may have the small build.
        tested = Path(folder, "constraints.txt")
        lines = (ROOT / "constraints.txt").read_text().splitlines()
        tested.write_text("".join(f"{line}\n" for line in lines if line.startswith("torch==")))
        install = [*uv, "install", "-q", "--python", python, "-c", str(tested)]
        subprocess.run(
            [*install, f"asm-gym[robosuite] @ {wheel.as_uri()}"], cwd=folder, env=there, check=True
        )
        subprocess.run([*install, "--no-deps", ROBOSUITE], cwd=folder, env=there, check=True)
        for extra in EXTRAS[1:]:
            steps = ([*install, f"asm-gym[{extra}] @ {wheel.as_uri()}"], [python, "-c", STILL_RUNS])
            if any(subprocess.run(step, cwd=folder, env=there).returncode for step in steps):
                wrong.append(f"{extra} after robosuite")
            print(f"{extra} after robosuite", flush=True)
    return "; ".join(wrong)


MATRIX = (
    *("3.11 numpy<2", "3.12 numpy<2", "3.11 numpy>=2", "3.12 numpy>=2", "3.13 numpy>=2"),
    "3.13 mujoco>=4",
)
"""Pythons, and NumPys or the newest MuJoCo; NumPy 1.26 has no build for Python 3.13."""
# variables that a fresh environment must not see
OURS = (
    "PYTHONPATH",
    "VIRTUAL_ENV",
    "MAKEFLAGS",
    "ARGS",
)


def matrix(asked: str = "") -> int:
    """Run `make test` in fresh clones and environments, and return how many failed; ``asked`` picks some by name."""
    wrong = 0
    for name in (each for each in MATRIX if asked in each):
        python, wanted = name.split()
        # The tested versions but for the package that is asked for; with NumPy 1 what still goes with it, but the
        # same PyTorch.
        keep, others = ("torch==", "'pyarrow<26'") if wanted == "numpy<2" else ("", "")
        package = re.split("[<>]", wanted)[0]
        with TemporaryDirectory(prefix="asm-gym-matrix-") as folder:
            pins = (
                line
                for line in (ROOT / "constraints.txt").read_text().splitlines(keepends=True)
                if keep in line and not (package == "mujoco" and line.startswith("mujoco=="))
            )
            Path(folder, "pins.txt").write_text("".join(pins))
            steps = (
                f"git clone -q --depth 1 file://{ROOT} tree",
                f"uv venv -q --seed --python {python} tree/.venv",
                f"uv pip install -q --python tree/.venv -c pins.txt -e 'tree[dev]' '{wanted}' {others}",
                f"uv pip install -q --python tree/.venv --no-deps {ROBOSUITE}",
                "touch tree/.venv/.installed",
                "make -C tree test",
            )
            there = {key: value for key, value in os.environ.items() if key not in OURS}
            failed = next(
                (
                    s
                    for s in steps
                    if subprocess.run(s, shell=True, cwd=folder, env=there).returncode
                ),
                None,
            )
        print(f"{name:<14} {failed or 'ok'}", flush=True)
        wrong += failed is not None
    return wrong


def main(names: list[str]) -> int:
    """Checks some or all, and returns 1 where one is wrong."""
    if names[:1] == ["matrix"]:
        return int(matrix(*names[1:]) > 0)
    with TemporaryDirectory() as folder:
        wheel = build_wheel(Path(folder))
        wrong = 0
        for name in names or (*CHECKS, "pairs"):
            found = pairs(wheel) if name == "pairs" else check(name, wheel)
            print(f"{name:<14} {found or 'ok'}", flush=True)
            wrong += bool(found)
    return int(wrong > 0)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
