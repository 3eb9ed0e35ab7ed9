"""Stacks the red cube on the green one."""

from __future__ import annotations

from typing import Any

import numpy as np

from asm_gym.policies.scripted.carry import CarryExpert, CarryTask
from asm_gym.policies.scripted.geometry import UP, flattest_side, length

HALF_RED = 0.02  # half the edge of the cube that is carried [m]
HALF_GREEN = 0.025  # half the edge of the cube beneath [m]


class StackExpert(CarryExpert):
    """A scripted expert for Stack."""

    pace = 0.5

    def next_task(self, observation: Any) -> CarryTask | None:
        """Return the red cube, until it lies on the green one."""
        red = self.read.pose(observation, "cubeA")
        green = self.read.pose(observation, "cubeB")
        place = green.position + (HALF_RED + HALF_GREEN) * UP
        side = flattest_side(red.orientation)
        turns = np.pi / 2
        tolerance = 0.02  # [m]
        if self.is_careful:
            # A wide gripper would stand on the green cube with one finger.
            sides = (side, np.cross(UP, side))
            side = min(sides, key=lambda across: abs(across @ (green.position - red.position)))
            turns = np.pi
            tolerance = 0.025
        if length(red.position - place) < tolerance:
            return None
        return CarryTask(
            name="cubeA",
            grip=np.zeros(3),
            closing=red.orientation.T @ side,
            turns=turns,
            clearance=0.08,
            place=place,
            over=0.06,
            fit=0.006,
        )
