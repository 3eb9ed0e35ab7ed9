"""What Gymnasium makes of an id: each makes one task, and no other."""

from __future__ import annotations

from typing import Any

from asm_gym.extras import check_mujoco
from asm_gym.tasks import TASKS
from asm_gym.validation import shown

check_mujoco()  # before anything imports it

from asm_gym.envs.robosuite_env import RobosuiteEnv  # noqa: E402


class Maker:
    """Makes environments of one task, with the arguments of ``RobosuiteEnv``."""

    metadata = RobosuiteEnv.metadata

    def __init__(self, task: str) -> None:
        self._task = task

    def __call__(self, **arguments: Any) -> RobosuiteEnv:
        task = arguments.pop("task", self._task)
        if task != self._task:
            raise ValueError(f"{TASKS[self._task].id} makes {self._task}, got task={shown(task)}: leave it out")
        if "robots" in arguments:
            raise TypeError(f"{TASKS[self._task].id} takes robot=, got robots={shown(arguments['robots'])}")
        return RobosuiteEnv(task=self._task, **arguments)


def __getattr__(name: str) -> Maker:
    """The maker of the task ``name``."""
    if name not in TASKS:
        raise AttributeError(name)
    return Maker(name)
