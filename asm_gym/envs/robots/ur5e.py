"""Universal Robots' UR5e, with the Robotiq 85 gripper.

Robosuite's Robotiq 85 lacks its linkage and cannot grasp, so no memory is shipped for this arm.
"""

from __future__ import annotations

from asm_gym.envs.robots.robot_model import PERSON_AND_TABLE, RobotModel

UR5E = RobotModel(name="UR5e", contact_limits=PERSON_AND_TABLE)
