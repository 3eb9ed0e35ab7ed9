"""Check this machine, and print what it lacks and what installs it. Exit code 1: asm-gym cannot run here."""

# Nothing that is checked here is imported here: the doctor must work where `import robosuite` does not.

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from importlib import metadata
from typing import NamedTuple

from packaging.requirements import Requirement
from packaging.specifiers import SpecifierSet
from packaging.version import Version
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from asm_gym.extras import BROUGHT_BY, TESTED, fitting, remedy
from asm_gym.graphics import GET_RENDERING, rendering_backend
from asm_gym.scripts.command import BAD_NEWS, DONE, run

PACKAGES = (
    "gymnasium",
    "numpy",
    "numba",
    "scipy",
    "mujoco",
    "robosuite",
    "pyarrow",
    "stable-baselines3",
    "torch",
)
NAME_CACHE = "export NUMBA_CACHE_DIR=FOLDER, one that you can write to, then asm-gym warmup"
REINSTALL = "install asm-gym anew (in a clone: make clean, then make doctor)"


@dataclass(frozen=True)
class Args:
    """There are no options."""


class Check(NamedTuple):
    """Result of one check."""

    name: str
    found: str
    remedy: str = ""  # command that puts it right; empty where nothing is wrong
    needed: bool = False  # without it asm-gym does not run; else only a part of it, such as video


def run_checks() -> list[Check]:
    """Return every check, in the order in which one remedy helps the next."""
    backend = rendering_backend()
    return [
        *map(package, PACKAGES),
        cache(),
        Check(
            "rendering",
            f"MUJOCO_GL={backend}" if backend else "no video",
            "" if backend else GET_RENDERING,
        ),
    ]


def package(name: str) -> Check:
    """Check the installed version of a package against the range that asm-gym asks for."""
    extra = BROUGHT_BY.get(module := name.replace("-", "_"), "")
    try:
        version = metadata.version(name)
    except metadata.PackageNotFoundError:
        return Check(
            name, "not installed", remedy(module) if extra else REINSTALL, needed=not extra
        )
    asked = [r for r in map(Requirement, metadata.requires("asm-gym") or []) if r.name == name]
    wanted = next(
        (r.specifier for r in asked if not r.marker or r.marker.evaluate({"extra": extra})),
        SpecifierSet(),
    )
    if name in TESTED and not TESTED[name].contains(version, prereleases=True):
        return Check(name, f"{version}, but needs {TESTED[name]}", fitting(name), needed=True)
    if (
        name == "pyarrow"
        and Version(version).major >= 26
        and Version(metadata.version("numpy")).major < 2
    ):
        # pip does not know
        return Check(name, f"{version}, but needs NumPy 2", "pip install 'pyarrow<26'")
    if wanted.contains(version, prereleases=True):
        return Check(name, version)
    return Check(
        name, f"{version}, but needs {wanted}", f"pip install '{name}{wanted}'", needed=True
    )


def cache() -> Check:
    """Check whether compiled code is kept for the next process."""
    try:
        from asm_gym.compilation import KEEP_NOWHERE, kept_in
        from asm_gym.monitors.row_kernel import observe_rows
    except ImportError as error:  # of what another check names
        return Check("cache", str(error), REINSTALL, needed=True)
    folder = kept_in(observe_rows)
    if folder is None or KEEP_NOWHERE in str(folder):
        return Check(
            "cache",
            "compiled code is lost with the process: neither the install nor HOME is writable",
            NAME_CACHE,
        )
    return Check("cache", str(folder))


def report(args: Args, console: Console) -> int:
    """Print the table and its verdict; return the exit code."""
    table, checks = Table("check", "state", "found"), run_checks()
    for check in checks:
        state = (
            "[green]ok"
            if not check.remedy
            else "[red]needed"
            if check.needed
            else "[yellow]optional"
        )
        table.add_row(check.name, state, escape(check.found))
    missing = [check for check in checks if check.remedy]
    console.print(table)
    for check in missing:  # whole lines, to be copied
        console.print(
            f"{check.name}: {check.remedy}", markup=False, highlight=False, soft_wrap=True
        )
    if any(check.needed for check in missing):
        console.print("[red]asm-gym cannot run here yet:[/] follow the lines above, from the top.")
        return BAD_NEWS
    names = escape(", ".join(check.name for check in missing))
    console.print(
        f"asm-gym runs here, without {names}." if missing else "[green]Everything is here."
    )
    return DONE


main = partial(run, "doctor", Args, report)
