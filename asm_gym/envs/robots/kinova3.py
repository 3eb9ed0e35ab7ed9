"""Kinova's Gen3, with the Robotiq 85 gripper.

Robosuite's Robotiq 85 lacks its linkage and cannot grasp, so no memory is shipped for this arm.
"""

from __future__ import annotations

from asm_gym.envs.robots.robot_model import PERSON_AND_TABLE, RobotModel

KINOVA3 = RobotModel(name="Kinova3", contact_limits=PERSON_AND_TABLE)
