"""Robosuite's tasks with Gymnasium's contract."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import TYPE_CHECKING, Any

from asm_gym.extras import check_mujoco, require
from asm_gym.tasks import TASKS
from asm_gym.validation import short_repr

if TYPE_CHECKING:
    from asm_gym.envs.robosuite_env import RobosuiteEnv

# Checked here, so that the error of a missing or unfit package says what to install.
check_mujoco()
require("mujoco", what="a robosuite environment or a fault in one")


def _make(registered: str, task: str, **arguments: Any) -> RobosuiteEnv:
    """Make the task of a Gymnasium id, and no other."""
    from asm_gym.envs.robosuite_env import RobosuiteEnv

    identifier = TASKS[registered].id
    if task != registered:
        raise ValueError(f"{identifier} makes {registered}, got task={short_repr(task)}: leave it out")
    if "robots" in arguments:
        raise TypeError(f"{identifier} takes robot=, got robots={short_repr(arguments['robots'])}")
    return RobosuiteEnv(task, **arguments)


def __getattr__(name: str) -> Callable[..., RobosuiteEnv]:
    """Return what Gymnasium calls for the id of a task."""
    if name not in TASKS:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    from asm_gym.envs.robosuite_env import RobosuiteEnv

    make: Any = partial(_make, name)
    make.metadata = RobosuiteEnv.metadata
    return make  # type: ignore[no-any-return]
