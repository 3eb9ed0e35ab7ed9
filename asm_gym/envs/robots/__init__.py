"""The arms that the tasks are tested with, one file each."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from asm_gym.envs.robots.iiwa import IIWA
from asm_gym.envs.robots.jaco import JACO
from asm_gym.envs.robots.kinova3 import KINOVA3
from asm_gym.envs.robots.panda import PANDA
from asm_gym.envs.robots.robot_model import RobotModel
from asm_gym.envs.robots.sawyer import SAWYER
from asm_gym.envs.robots.ur5e import UR5E
from asm_gym.tasks import TaskSpec
from asm_gym.validation import check_choice, check_text, short_repr

ROBOTS = {robot.name: robot for robot in (PANDA, SAWYER, UR5E, KINOVA3, IIWA, JACO)}
"""Every arm by its name; ``asm_gym.tasks.ROBOTS`` lists the names for those who need no simulator."""


def robot_named(name: str) -> RobotModel:
    """Return the arm of a name. Raises ValueError, listing the arms, where there is none."""
    check_choice("robot", check_text("robot", name), ROBOTS)
    return ROBOTS[name]


def robots_for(task: TaskSpec, robot: str | Sequence[str] | None) -> tuple[str, ...]:
    """Return the names of a task's robots.

    Args:
        task: says how many arms there are.
        robot: a name for all arms, or one for each; None for Pandas.

    Raises:
        ValueError: an unknown name, or the wrong number of names.
    """
    if robot is None:
        robot = PANDA.name
    if not isinstance(robot, Sequence):
        raise ValueError(f"robot must be a name or a sequence of names, got {short_repr(robot)}")

    names = tuple(robot)
    if isinstance(robot, str):
        names = (robot or PANDA.name,) * task.arms
    for name in names:
        robot_named(name)
    if len(names) != task.arms:
        raise ValueError(
            f"{task.name} takes {task.arms} robot{'s' * (task.arms > 1)}, got {', '.join(names)}"
        )
    return names


def mend_robots(env: Any) -> None:
    """Mend robosuite's model of each robot of an environment, once a model is loaded."""
    for robot in env.robots:
        mend = robot_named(robot.name).mend
        if mend is not None:
            mend(env.sim.model, robot.robot_model.naming_prefix)
