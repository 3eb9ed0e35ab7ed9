"""Robosuite's tasks with Gymnasium's contract."""

from __future__ import annotations

from typing import TYPE_CHECKING

from asm_gym.extras import check_simulator, require
from asm_gym.tasks import TASKS

if TYPE_CHECKING:
    from asm_gym.envs.robosuite_env import RobosuiteEnv

# Checked here, so that the error of a missing or unfit package says what to install.
check_simulator()
require("mujoco", what="a robosuite environment or a fault in one")


def __getattr__(name: str) -> type[RobosuiteEnv]:
    """Return what Gymnasium makes for the id of a task."""
    if name not in TASKS:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    from asm_gym.envs.robosuite_env import RobosuiteEnv

    return RobosuiteEnv
