"""Say what this machine lacks to run asm-gym, and what installs it. Exit code 1: it cannot run here."""

# Nothing that is checked here is imported here: the doctor must work where `import robosuite` does not.

from __future__ import annotations

import platform
import subprocess
import sys
from dataclasses import dataclass
from importlib import metadata
from typing import NamedTuple

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
OLDER_PYTHON = "python3.12 -m venv, and install there (in a clone: make doctor PYTHON=python3.12)"
COMPILER = "apt-get install gcc libc6-dev linux-libc-dev python3-dev"
LIBRARIES = {"libGL.so.1": "libgl1", "libglib-2.0.so.0": "libglib2.0-0", "libgthread-2.0.so.0": "libglib2.0-0"}
"""Libraries that opencv-python links to, and their Debian packages; robosuite's viewer imports it."""


@dataclass(frozen=True)
class Args:
    """There are no options."""


class Check(NamedTuple):
    """Result of one check."""

    name: str
    ok: bool
    needed: bool  # without it asm-gym does not run; else only a part of it, such as video
    detail: str
    remedy: str = ""  # command that puts it right


def run_checks() -> list[Check]:
    """Return every check, in the order in which one remedy helps the next."""
    libraries = [library(name, package) for name, package in LIBRARIES.items()] if sys.platform == "linux" else []
    return [python(), *map(package, PACKAGES), compiled_code(), *libraries, rendering(), encoder()]


def python() -> Check:
    """Check the running Python against ``requires-python``."""
    version = platform.python_version()
    try:
        wanted = metadata.metadata("asm-gym")["Requires-Python"]
    except metadata.PackageNotFoundError:
        wanted = ""
    ok = SpecifierSet(wanted).contains(version, prereleases=True)
    return Check(
        "Python", ok, True, version if ok else f"{version}, but asm-gym needs {wanted}", "" if ok else OLDER_PYTHON
    )


def package(name: str) -> Check:
    """Check the installed version of a package against the range that asm-gym asks for."""
    try:
        version = metadata.version(name)
    except metadata.PackageNotFoundError:
        if name in NOT_ON_3_13 and sys.version_info >= (3, 13):
            return Check(name, False, False, f"not installed: {NOT_ON_3_13[name]} for Python 3.13", OLDER_PYTHON)
        extra = BROUGHT_BY.get(name.replace("-", "_"))
        remedy = f"python -m pip install 'asm-gym[{extra}]'" if extra else REINSTALL
        if name == "robosuite":  # it brings evdev, which is compiled
            remedy = f"{COMPILER}, then {remedy}"
        return Check(name, False, not extra, "not installed", remedy)
    wanted = wanted_versions(name)
    if wanted.contains(version, prereleases=True):
        return Check(name, True, True, version)
    return Check(name, False, True, f"{version}, but needs {wanted}", f"python -m pip install '{name}{wanted}'")


def wanted_versions(name: str) -> SpecifierSet:
    """Return the versions of a package that asm-gym or one of its extras asks for."""
    try:
        requirements = map(Requirement, metadata.requires("asm-gym") or [])
    except metadata.PackageNotFoundError:
        return SpecifierSet()
    for requirement in requirements:
        marker, extras = requirement.marker, ("", *BROUGHT_BY.values())
        if requirement.name == name and (marker is None or any(marker.evaluate({"extra": e}) for e in extras)):
            return requirement.specifier
    return SpecifierSet()


COMPILED = """
from asm_gym.compilation import kept_in, must_compile
from asm_gym.monitors.row_kernel import observe_rows
print(int(must_compile(observe_rows)), kept_in(observe_rows) or "")
"""


def compiled_code() -> Check:
    """Check whether compiled code is kept, and whether there is some already."""
    done = subprocess.run([sys.executable, "-c", COMPILED], capture_output=True, text=True, check=False)
    if done.returncode:
        last = (done.stderr.strip().splitlines() or ["no error message"])[-1]
        return Check("compiled code", False, True, last, REINSTALL)
    missing, _, folder = done.stdout.strip().partition(" ")
    if not folder:
        return Check("compiled code", False, False, "kept nowhere: no folder can be written to", "set NUMBA_CACHE_DIR")
    if missing == "1":
        return Check("compiled code", False, False, f"not yet in {folder}", "asm-gym warmup")
    return Check("compiled code", True, False, f"in {folder}")


def library(name: str, package: str) -> Check:
    """Check a shared library of opencv."""
    if loads(name):
        return Check(name, True, False, "found")
    return Check(
        name, False, False, "missing: opencv cannot be imported, for robosuite's viewer", f"apt-get install {package}"
    )


def rendering() -> Check:
    """Check whether this machine draws without a screen; without, there is no video."""
    try:
        metadata.version("mujoco")
    except metadata.PackageNotFoundError:
        return Check("rendering", False, False, "no video without mujoco", "python -m pip install 'asm-gym[robosuite]'")
    problem = rendering_problem()
    detail = problem or f"MUJOCO_GL={rendering_backend()} draws a frame"
    return Check("rendering", not problem, False, detail, GET_RENDERING if problem else "")


def encoder() -> Check:
    """Check for an ffmpeg with the H.264 encoder, which browsers and players understand."""
    problem = encoder_problem()
    return Check("H.264 encoder", not problem, False, problem or "found", GET_ENCODER if problem else "")


def table(checks: list[Check]) -> Table:
    """Return a row for every check."""
    rows = Table("check", "state")
    rows.add_column("found", overflow="fold")
    rows.add_column("what to do", overflow="fold")
    for check in checks:
        state = "[green]ok" if check.ok else "[red]needed" if check.needed else "[yellow]optional"
        rows.add_row(check.name, state, escape(check.detail), escape(check.remedy))
    return rows


def report(args: Args, console: Console) -> int:
    """Print the table and its verdict; return the exit code."""
    checks = run_checks()
    console.print(table(checks))
    missing = [check for check in checks if not check.ok]
    if any(check.needed for check in missing):
        console.print("[red]asm-gym cannot run here yet:[/] do what stands on the right, from the top.")
        return 1
    names = escape(", ".join(check.name for check in missing))
    console.print(f"asm-gym runs here, without {names}." if missing else "[green]Everything is here.")
    return 0


def main(argv: list[str] | None = None) -> int:
    """Check this machine; return 1 where asm-gym cannot run on it."""
    return run("doctor", Args, report, argv, __doc__)


if __name__ == "__main__":
    sys.exit(main())
