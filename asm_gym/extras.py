"""Optional packages: a missing one is named with the extra that installs it."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager, suppress
from importlib import import_module
from importlib.metadata import PackageNotFoundError, version
from typing import Any

from packaging.requirements import Requirement
from packaging.specifiers import SpecifierSet

EXTRAS = {
    "robosuite": ("mujoco", "robosuite", "termcolor"),
    "agents": ("torch", "stable_baselines3", "tensorboard"),
    "data": ("minari", "h5py"),
    "report": ("matplotlib", "PIL", "pyarrow", "sklearn", "loky"),
    "video": ("moviepy",),
    "environments": ("gymnasium_robotics", "shimmy", "dm_control"),
    "learners": ("torchrl",),
    "notebooks": ("ipywidgets", "ipykernel", "nbclient", "nbformat"),
    "ros": ("rosbags",),
    "dds": ("cyclonedds",),
    "rerun": ("rerun",),
}
"""Packages that each extra of asm-gym installs, by the names they are imported under."""
BROUGHT_BY = {package: extra for extra, packages in EXTRAS.items() for package in packages}
"""Extra that installs a package."""

ROBOSUITE = "robosuite==1.5.2"
INSTALL_ROBOSUITE = f"pip install 'asm-gym[robosuite]' && pip install --no-deps {ROBOSUITE}"
"""Its declared mink==0.0.5 wants NumPy below 2; only the GR1 humanoid's inverse kinematics uses it."""

TESTED = {"mujoco": SpecifierSet(">=3.4,<4.1"), "robosuite": Requirement(ROBOSUITE).specifier}
"""Versions with which the environments are tested."""


def check_simulator() -> None:
    """Raise ImportError where the installed MuJoCo or robosuite does not fit the environments."""
    for name, tested in TESTED.items():
        with suppress(PackageNotFoundError):  # its importer says so
            installed = version(name)
            if not tested.contains(installed, prereleases=True):
                raise ImportError(
                    f"the environments need {name}{tested}, got {installed}: {fitting(name)}"
                )


def fitting(name: str) -> str:
    """Return the line that replaces MuJoCo or robosuite by a version that fits."""
    options = ""
    if name == "robosuite":
        options = "--no-deps "
    return f"pip install {options}'{name}{TESTED[name]}'"


def remedy(package: str) -> str:
    """Return the line that installs a package of an extra."""
    if package == "robosuite":
        return INSTALL_ROBOSUITE
    return f"pip install 'asm-gym[{BROUGHT_BY[package]}]'"


def require(module: str, *, what: str) -> Any:
    """Return an imported module, which a feature ``what`` needs; the ImportError says what to install."""
    with needed_for(what):
        return import_module(module)


@contextmanager
def needed_for(what: str) -> Iterator[None]:
    """Say what to install where the block misses a package of an extra; other errors pass."""
    try:
        yield
    except ModuleNotFoundError as error:
        package = (error.name or "").split(".")[0]
        if package not in BROUGHT_BY:
            raise
        raise ImportError(f"{what} needs {package}: {remedy(package)}", name=package) from error
