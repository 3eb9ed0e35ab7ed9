"""Franka Emika's Panda, with Franka's parallel gripper."""

from __future__ import annotations

from asm_gym.envs.robots.robot_model import RobotModel

PANDA = RobotModel(name="Panda", has_inverse_kinematics=True)
