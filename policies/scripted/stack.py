"""Stacks the red cube on the green one."""

from __future__ import annotations

from typing import Any

import numpy as np

from asm_gym.policies.scripted.carry import CarryExpert, CarryTask

_SMALL, _LARGE = 0.02, 0.025  # half the edges of the two cubes [m]


class StackExpert(CarryExpert):
    """A scripted expert for Stack."""

    pace = 0.5

    def next_task(self, observation: Any) -> CarryTask | None:
        """The red cube, until it lies on the green one."""
        red, turned = self.pose(observation, "cubeA")
        green, _ = self.pose(observation, "cubeB")
        place = green + np.array([0.0, 0.0, _SMALL + _LARGE])
        if np.linalg.norm(red - place) < (0.025 if self._careful else 0.02):
            return None
        side = turned[:, int(np.abs(turned[2]).argmin())]  # the one that lies flattest gives the cube's heading
        turns = np.pi / 2
        if self._careful:  # a wide gripper would stand on the green cube with one finger
            sides = (side, np.cross([0.0, 0.0, 1.0], side))
            side, turns = min(sides, key=lambda s: abs(s @ (green - red))), np.pi
        return CarryTask(
            name="cubeA",
            grip=np.zeros(3),
            closing=turned.T @ side,
            turns=turns,
            clearance=0.08,
            place=place,
            over=0.06,
            fit=0.006,
        )
