"""Rethink Robotics' Sawyer, with Rethink's parallel gripper."""

from __future__ import annotations

from typing import Any

from asm_gym.envs.robots.robot_model import PERSON_AND_TABLE, RobotModel


def free_first_joint(model: Any, prefix: str) -> None:
    """Let the arm turn in its base.

    Robosuite's Sawyer touches its own base with its shoulder, to within rounding (1e-16 m). Where that makes a contact,
    which depends on the pose, its friction holds the first joint against 20 N m and more.
    """
    shoulder = model.geom_name2id(f"{prefix}link0_collision")
    model.geom_contype[shoulder] = 0
    model.geom_conaffinity[shoulder] = 0


SAWYER = RobotModel(
    name="Sawyer",
    contact_limits=PERSON_AND_TABLE,
    has_inverse_kinematics=True,
    mend=free_first_joint,
)
