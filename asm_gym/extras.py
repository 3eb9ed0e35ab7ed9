"""Optional packages: a missing one is named with the extra that installs it."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
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
    "learners": ("torchrl",),
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
    with suppress(PackageNotFoundError):  # its importer says so
        if Version(found := version("mujoco")) >= Version(MUJOCO_BELOW):
            remedy = f"pip install 'mujoco<{MUJOCO_BELOW}'"
            raise ImportError(f"robosuite needs MuJoCo below {MUJOCO_BELOW}, got {found}: {remedy}")


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
        remedy = f"pip install 'asm-gym[{BROUGHT_BY[package]}]'"
        if package in NOT_ON_3_13 and sys.version_info >= (3, 13):
            remedy = f"take Python 3.12, for 3.13 there is none: {NOT_ON_3_13[package]}"
        raise ImportError(f"{what} needs {package}: {remedy}", name=package) from error
