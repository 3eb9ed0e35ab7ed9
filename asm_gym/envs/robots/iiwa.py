"""KUKA's LBR iiwa, with the Robotiq 140 gripper."""

from __future__ import annotations

from asm_gym.envs.robots.robot_model import PERSON_AND_TABLE, RobotModel

IIWA = RobotModel(name="IIWA", contact_limits=PERSON_AND_TABLE)
