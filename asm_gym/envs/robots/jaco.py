"""Kinova's Jaco, with its own gripper of three fingers.

The fingers of robosuite's model are too weak to lift what they hold, so no memory is shipped for this arm.
"""

from __future__ import annotations

from asm_gym.envs.robots.robot_model import PERSON_AND_TABLE, RobotModel

JACO = RobotModel(name="Jaco", contact_limits=PERSON_AND_TABLE)
