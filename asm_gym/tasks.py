"""The robosuite tasks that are registered as Gymnasium environments, one row each."""

from __future__ import annotations

from dataclasses import dataclass

ROBOTS = ("Panda", "Sawyer", "UR5e", "Kinova3", "IIWA", "Jaco")
"""Arms that the tasks are tested with."""


@dataclass(frozen=True)
class TaskSpec:
    """What is special about one task.

    Args:
        name: robosuite's name; the Gymnasium id is ``asm_gym/<name>-v0``.
        horizon: control steps before an episode is truncated, at the default 20 Hz.
        success: what ``info["success"]`` means.
        robot: the default arm.
    """

    name: str
    horizon: int
    success: str
    robot: str = "Panda"

    @property
    def id(self) -> str:
        return f"asm_gym/{self.name}-v0"


TASKS = {
    task.name: task for task in (TaskSpec("Lift", horizon=100, success="the cube is more than 4 cm above the table"),)
}
"""Every task by its name."""


def task(name: str) -> TaskSpec:
    """The row of ``name``, which may also be written as a Gymnasium id.

    Raises:
        ValueError: there is no such task; the message lists those that exist.
    """
    short = name.removeprefix("asm_gym/").removesuffix("-v0")
    if short not in TASKS:
        raise ValueError(f"unknown task {name!r}; known tasks: {', '.join(TASKS)}")
    return TASKS[short]
