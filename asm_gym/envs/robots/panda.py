"""Franka Emika's Panda, with Franka's parallel gripper."""

from __future__ import annotations

from asm_gym.envs.robots.robot_model import PERSON_AND_TABLE, RobotModel

PANDA = RobotModel(
    name="Panda",
    contact_limits=PERSON_AND_TABLE,
    has_inverse_kinematics=True,
)
