"""Optional packages: what is missing is named with the extra that brings it."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import contextmanager
from importlib import import_module
from importlib.metadata import PackageNotFoundError, version
from typing import Any

from packaging.version import Version

BROUGHT_BY = {
    **dict.fromkeys(("mujoco", "robosuite"), "robosuite"),
    **dict.fromkeys(("torch", "stable_baselines3", "tensorboard"), "agents"),
    **dict.fromkeys(("minari", "h5py"), "data"),
    **dict.fromkeys(("matplotlib", "imageio", "imageio_ffmpeg", "PIL"), "report"),
    **dict.fromkeys(("pyarrow", "sklearn", "loky"), "report"),
    **dict.fromkeys(("distributed", "dask", "ray"), "cluster"),
    **dict.fromkeys(("moviepy",), "video"),
    **dict.fromkeys(("gymnasium_robotics", "shimmy", "dm_control"), "environments"),
    **dict.fromkeys(("torchrl", "wandb"), "learners"),
    **dict.fromkeys(("huggingface_hub",), "hub"),
    **dict.fromkeys(("ipywidgets", "ipykernel", "nbclient", "nbformat"), "notebooks"),
    **dict.fromkeys(("rosbags",), "ros"),
    **dict.fromkeys(("cyclonedds",), "dds"),
    **dict.fromkeys(("rerun",), "rerun"),
}
"""The extra of asm-gym that installs a package, by the name it is imported under."""

NOT_ON_3_13 = {
    "robosuite": "its mink asks for NumPy below 2, of which there is no build",
    "dm_control": "its labmaze has no build",
}
"""Why no extra brings a package to Python 3.13 and later."""


MUJOCO_BELOW = "3.10"
"""The first version of MuJoCo with which robosuite's environments are not tried; with 4.0 they cannot be made."""


def check_mujoco() -> None:
    """Raises ImportError where another package has brought a MuJoCo that robosuite does not work with."""
    try:
        found = version("mujoco")
    except PackageNotFoundError:  # which whoever imports it says
        return
    if Version(found) >= Version(MUJOCO_BELOW):
        raise ImportError(
            f"robosuite needs MuJoCo below {MUJOCO_BELOW}, got {found}: pip install 'mujoco<{MUJOCO_BELOW}'"
        )


def require(module: str, *, what: str, extra: str = "") -> Any:
    """The module, imported.

    Args:
        module: its dotted name.
        what: needs it, for the message.
        extra: that installs it; looked up where it is not said.

    Raises:
        ImportError: it is not installed; the message says what to install.
    """
    with needed_for(what, extra):
        return import_module(module)


@contextmanager
def needed_for(what: str, extra: str = "") -> Iterator[None]:
    """Says what to install where a package turns out to be missing inside; any other error passes as it is.

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
