"""Check this machine, and print what it lacks and what installs it. Exit code 1: asm-gym cannot run here."""

# Nothing that is checked is imported here: the doctor must work where `import robosuite` fails.

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

    @property
    def state(self) -> str:
        """The state in a word, with its colour."""
        if not self.remedy:
            return "[green]ok"
        if self.needed:
            return "[red]needed"
        return "[yellow]optional"


def run_checks() -> list[Check]:
    """Return every check, in the order in which one remedy helps the next."""
    return [*map(package, PACKAGES), cache(), rendering()]


def rendering() -> Check:
    """Check whether MuJoCo can draw, for video."""
    backend = rendering_backend()
    if backend is None:
        return Check("rendering", "no video", GET_RENDERING)
    return Check("rendering", f"MUJOCO_GL={backend}")


def package(name: str) -> Check:
    """Check the installed version of a package against the range that asm-gym asks for."""
    module = name.replace("-", "_")
    extra = BROUGHT_BY.get(module, "")
    try:
        version = metadata.version(name)
    except metadata.PackageNotFoundError:
        if extra:
            return Check(name, "not installed", remedy(module))
        return Check(name, "not installed", REINSTALL, needed=True)

    def fits(versions: SpecifierSet) -> bool:
        return versions.contains(version, prereleases=True)

    if name in TESTED and not fits(TESTED[name]):
        return Check(name, f"{version}, but needs {TESTED[name]}", fitting(name), needed=True)
    if name == "pyarrow" and needs_numpy_2(version):
        return Check(name, f"{version}, but needs NumPy 2", "pip install 'pyarrow<26'")
    wanted = asked_for(name, extra)
    if not fits(wanted):
        install = f"pip install '{name}{wanted}'"
        return Check(name, f"{version}, but needs {wanted}", install, needed=True)
    return Check(name, version)


def asked_for(name: str, extra: str) -> SpecifierSet:
    """Return the versions of a package that asm-gym with an extra asks for; any where it asks for none."""
    for requirement in map(Requirement, metadata.requires("asm-gym") or []):
        marker = requirement.marker
        if requirement.name == name and (marker is None or marker.evaluate({"extra": extra})):
            return requirement.specifier
    return SpecifierSet()


def needs_numpy_2(pyarrow: str) -> bool:
    """Return whether this version of pyarrow needs another NumPy than is installed, which pip does not know."""
    return Version(pyarrow).major >= 26 and Version(metadata.version("numpy")).major < 2


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
    checks = run_checks()
    table = Table("check", "state", "found")
    for check in checks:
        table.add_row(check.name, check.state, escape(check.found))
    console.print(table)
    missing = [check for check in checks if check.remedy]
    for check in missing:  # whole lines, to be copied
        line = f"{check.name}: {check.remedy}"
        console.print(line, markup=False, highlight=False, soft_wrap=True)
    if any(check.needed for check in missing):
        console.print("[red]asm-gym cannot run here yet:[/] follow the lines above, from the top.")
        return BAD_NEWS
    if missing:
        names = ", ".join(check.name for check in missing)
        console.print(f"asm-gym runs here, without {escape(names)}.")
    else:
        console.print("[green]Everything is here.")
    return DONE


main = partial(run, "doctor", Args, report)
