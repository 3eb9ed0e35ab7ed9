"""What this machine lacks to run asm-gym, and the command that installs it. Exit code 1: it cannot run here."""

# Nothing that is checked here is imported here: the doctor has to work where `import robosuite` does not.

from __future__ import annotations

import json
import platform
import subprocess
import sys
from dataclasses import dataclass
from importlib import metadata

from packaging.requirements import Requirement
from packaging.specifiers import SpecifierSet
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from asm_gym.extras import BROUGHT_BY, NOT_ON_3_13
from asm_gym.graphics import GET_ENCODER, GET_RENDERING, encoder_problem, loads, rendering_backend, rendering_problem
from asm_gym.scripts.command import run

PACKAGES = ("gymnasium", "numpy", "numba", "scipy", "mujoco", "robosuite", "stable-baselines3", "torch")
REINSTALL = "install asm-gym anew (in a clone: make clean, then make doctor)"
COMPILER = "apt-get install gcc libc6-dev linux-libc-dev python3-dev"

# opencv-python links to these, and `import robosuite` imports it.
LIBRARIES = {"libGL.so.1": "libgl1", "libglib-2.0.so.0": "libglib2.0-0", "libgthread-2.0.so.0": "libglib2.0-0"}


@dataclass(frozen=True)
class Check:
    """One thing looked at.

    Args:
        name: what was looked at.
        ok: it is there, and works.
        needed: asm-gym does not run without it; otherwise only something of it is missing, such as video.
        detail: what was found.
        remedy: the command that puts it right; empty where nothing is wrong.
    """

    name: str
    ok: bool
    needed: bool
    detail: str
    remedy: str = ""


@dataclass(frozen=True)
class Args:
    """The doctor takes no options."""


def run_checks() -> list[Check]:
    """Every check, in the order in which a remedy for one helps the next."""
    libraries = [library(name, package) for name, package in LIBRARIES.items()] if sys.platform == "linux" else []
    return [python(), *map(package, PACKAGES), compiled_code(), matrix_products(), *libraries, rendering(), encoder()]


def python() -> Check:
    """The running Python against ``requires-python``."""
    version = platform.python_version()
    wanted = supported_python()
    ok = SpecifierSet(wanted).contains(version, prereleases=True)
    detail = version if ok else f"{version}, but asm-gym needs {wanted}"
    return Check(
        "Python",
        ok,
        True,
        detail,
        "" if ok else "python3.12 -m venv, and install there (in a clone: make doctor PYTHON=python3.12)",
    )


def supported_python() -> str:
    """``requires-python`` of asm-gym as installed; any version where it is not installed."""
    try:
        return metadata.metadata("asm-gym")["Requires-Python"]
    except metadata.PackageNotFoundError:
        return ""


def package(name: str) -> Check:
    """The installed version of ``name`` against the range that asm-gym, or else what it builds on, asks for."""
    wanted = wanted_versions(name)
    try:
        version = metadata.version(name)
    except metadata.PackageNotFoundError:
        if name in NOT_ON_3_13 and sys.version_info >= (3, 13):
            why = f"not installed: {NOT_ON_3_13[name]} for Python 3.13"
            return Check(name, False, False, why, "python3.12 -m venv, and install there")
        extra = BROUGHT_BY.get(name.replace("-", "_"))
        remedy = f"python -m pip install 'asm-gym[{extra}]'" if extra else REINSTALL
        if name == "robosuite":  # it brings evdev, which is compiled
            remedy = f"{COMPILER}, then {remedy}"
        return Check(name, False, not extra, "not installed", remedy)
    if wanted.contains(version, prereleases=True):
        return Check(name, True, True, version)
    return Check(name, False, True, f"{version}, but needs {wanted}", f"python -m pip install '{name}{wanted}'")


def wanted_versions(name: str) -> SpecifierSet:
    """The range of versions of ``name`` in asm-gym's requirements, or in stable-baselines3's (which brings torch)."""
    for asker in ("asm-gym", "stable-baselines3"):
        try:
            lines = metadata.requires(asker) or []
        except metadata.PackageNotFoundError:
            continue
        for requirement in map(Requirement, lines):
            if requirement.name == name and applies(requirement):
                return requirement.specifier
    return SpecifierSet()


def applies(requirement: Requirement) -> bool:
    """A requirement of this machine, with or without an extra."""
    marker = requirement.marker
    return marker is None or any(marker.evaluate({"extra": extra}) for extra in ("", *BROUGHT_BY.values()))


COMPILED = """
from asm_gym.compilation import kept_in, must_compile
from asm_gym.monitors.fused import _observe
print(int(must_compile(_observe)), kept_in(_observe) or "")
"""


def compiled_code() -> Check:
    """Where compiled code is kept, and whether there is some already."""
    done = subprocess.run([sys.executable, "-c", COMPILED], capture_output=True, text=True, check=False)
    if done.returncode:
        last = (done.stderr.strip().splitlines() or ["nothing was said"])[-1]
        return Check("compiled code", False, True, last, REINSTALL)
    missing, _, folder = done.stdout.strip().partition(" ")
    if not folder:
        return Check("compiled code", False, False, "kept nowhere: no folder can be written to", "set NUMBA_CACHE_DIR")
    where = f"in {folder}"
    return (
        Check("compiled code", False, False, f"not yet {where}", "asm-gym warmup")
        if missing == "1"
        else Check("compiled code", True, False, where)
    )


KERNELS = """
import json
import numpy
from llvmlite.binding import get_host_cpu_features
from threadpoolctl import threadpool_info
print(json.dumps([[p["architecture"] for p in threadpool_info() if p.get("internal_api") == "openblas"],
                  [name for name, there in get_host_cpu_features().items() if there]]))
"""
OLD_KERNELS = {"Prescott", "Core2", "Penryn", "Dunnington", "Atom", "Nano", "Nehalem", "Barcelona", "Generic"}
"""Of OpenBLAS, without AVX: what it takes for a processor that is newer than itself."""


def matrix_products() -> Check:
    """Whether NumPy's OpenBLAS uses what the processor has: an older one does not know the newest processors."""
    done = subprocess.run([sys.executable, "-c", KERNELS], capture_output=True, text=True, check=False)
    kernels, features = json.loads(done.stdout) if done.returncode == 0 else ([], [])
    slow = [name for name in kernels if name in OLD_KERNELS] if "avx2" in features else []
    if not slow:
        return Check("matrix products", True, False, f"OpenBLAS for {kernels[0]}" if kernels else "not by OpenBLAS")
    better = "SkylakeX" if "avx512f" in features else "Haswell"
    detail = f"NumPy's OpenBLAS takes this processor for a {slow[0]}: learning takes longer"
    return Check("matrix products", False, False, detail, f"export OPENBLAS_CORETYPE={better}")


def library(name: str, package: str) -> Check:
    """A shared library that opencv links to, which only robosuite's own viewer uses."""
    ok = loads(name)
    detail = "found" if ok else "missing: opencv, which robosuite's viewer uses, cannot be imported"
    return Check(name, ok, False, detail, "" if ok else f"apt-get install {package}")


def rendering() -> Check:
    """A way to draw without a screen; without one there is no video, and everything else runs."""
    try:
        metadata.version("mujoco")
    except metadata.PackageNotFoundError:
        return Check("rendering", False, False, "no video without mujoco", "python -m pip install 'asm-gym[robosuite]'")
    problem = rendering_problem()
    detail = problem or f"MUJOCO_GL={rendering_backend()} draws a frame"
    return Check("rendering", not problem, False, detail, GET_RENDERING if problem else "")


def encoder() -> Check:
    """An ffmpeg with the H.264 encoder that browsers and players understand."""
    problem = encoder_problem()
    return Check("H.264 encoder", not problem, False, problem or "found", GET_ENCODER if problem else "")


def exit_code(checks: list[Check]) -> int:
    """1 where something needed is missing, else 0."""
    return int(any(check.needed and not check.ok for check in checks))


def table(checks: list[Check]) -> Table:
    """A row for every check."""
    rows = Table("check", "state")
    rows.add_column("found", overflow="fold")
    rows.add_column("what to do", overflow="fold")
    for check in checks:
        state = "[green]ok" if check.ok else "[red]needed" if check.needed else "[yellow]optional"
        rows.add_row(check.name, state, escape(check.detail), escape(check.remedy))
    return rows


def report(args: Args, console: Console) -> int:
    """Prints the table, and what it comes to."""
    checks = run_checks()
    console.print(table(checks))
    wrong = [check for check in checks if not check.ok]
    if exit_code(checks):
        console.print("[red]asm-gym cannot run here yet:[/] do what stands on the right, from the top.")
    elif wrong:
        console.print(f"asm-gym runs here, without {escape(', '.join(check.name for check in wrong))}.")
    else:
        console.print("[green]Everything is here.")
    return exit_code(checks)


def main(argv: list[str] | None = None) -> int:
    """Looks at this machine; 1 where asm-gym cannot run on it."""
    return run("doctor", Args, report, argv, __doc__)


if __name__ == "__main__":
    sys.exit(main())
