"""Optional packages: a missing one is named with the extra that installs it."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import contextmanager
from importlib import import_module
from importlib.metadata import PackageNotFoundError, version
from typing import Any

from packaging.version import Version

EXTRAS = {
    "robosuite": ("mujoco", "robosuite"),
    "agents": ("torch", "stable_baselines3", "tensorboard"),
    "data": ("minari", "h5py"),
    "report": ("matplotlib", "imageio", "imageio_ffmpeg", "PIL", "pyarrow", "sklearn", "loky"),
    "cluster": ("distributed", "dask", "ray"),
    "video": ("moviepy",),
    "environments": ("gymnasium_robotics", "shimmy", "dm_control"),
    "learners": ("torchrl", "wandb"),
    "hub": ("huggingface_hub",),
    "notebooks": ("ipywidgets", "ipykernel", "nbclient", "nbformat"),
    "ros": ("rosbags",),
    "dds": ("cyclonedds",),
    "rerun": ("rerun",),
}
"""Packages that each extra of asm-gym installs, by the names they are imported under."""
BROUGHT_BY = {package: extra for extra, packages in EXTRAS.items() for package in packages}
"""Extra that installs a package."""

NOT_ON_3_13 = {
    "robosuite": "its mink asks for NumPy below 2, of which there is no build",
    "dm_control": "its labmaze has no build",
}
"""Reasons why no extra installs a package on Python 3.13 and later."""

MUJOCO_BELOW = "3.10"
"""First version of MuJoCo with which robosuite's environments are not tested; with 4.0 they cannot be made."""


def check_mujoco() -> None:
    """Raise ImportError where the installed MuJoCo does not work with robosuite."""
    try:
        found = version("mujoco")
    except PackageNotFoundError:  # its importer says so
        return
    if Version(found) >= Version(MUJOCO_BELOW):
        raise ImportError(
            f"robosuite needs MuJoCo below {MUJOCO_BELOW}, got {found}: pip install 'mujoco<{MUJOCO_BELOW}'"
        )


def require(module: str, *, what: str, extra: str = "") -> Any:
    """Return an imported module.

    Args:
        module: dotted name.
        what: feature that needs it, for the message.
        extra: extra that installs it; looked up by default.

    Raises:
        ImportError: it is not installed; the message says what to install.
    """
    with needed_for(what, extra):
        return import_module(module)


@contextmanager
def needed_for(what: str, extra: str = "") -> Iterator[None]:
    """Say what to install where the block misses a package; other errors pass.

    Raises:
        ImportError: a package that an extra brings is not installed.
    """
    try:
        yield
    except ModuleNotFoundError as error:
        package = (error.name or "").split(".")[0]
        extra = extra or BROUGHT_BY.get(package, "")
        if not extra or package == "asm_gym":
            raise
        remedy = f"pip install 'asm-gym[{extra}]'"
        if package in NOT_ON_3_13 and sys.version_info >= (3, 13):
            remedy = f"take Python 3.12, for 3.13 there is none: {NOT_ON_3_13[package]}"
        raise ImportError(f"{what} needs {package}: {remedy}", name=package) from error
