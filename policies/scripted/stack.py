"""Stacks the red cube on the green one."""

from __future__ import annotations

from typing import Any

import numpy as np

from asm_gym.policies.scripted.carry import CarryExpert, CarryTask
from asm_gym.policies.scripted.geometry import UP, flattest_side

_SMALL, _LARGE = 0.02, 0.025  # half the edges of the two cubes [m]


class StackExpert(CarryExpert):
    """A scripted expert for Stack."""

    pace = 0.5

    def next_task(self, observation: Any) -> CarryTask | None:
        """Return the red cube, until it lies on the green one."""
        red, green = (self.pose(observation, name) for name in ("cubeA", "cubeB"))
        place = green.at + np.array([0.0, 0.0, _SMALL + _LARGE])
        if np.linalg.norm(red.at - place) < (0.025 if self._careful else 0.02):
            return None
        side, turns = flattest_side(red.turned), np.pi / 2
        if self._careful:  # a wide gripper would stand on the green cube with one finger
            sides = (side, np.cross(UP, side))
            side, turns = min(sides, key=lambda s: abs(s @ (green.at - red.at))), np.pi
        return CarryTask(
            name="cubeA",
            grip=np.zeros(3),
            closing=red.turned.T @ side,
            turns=turns,
            clearance=0.08,
            place=place,
            over=0.06,
            fit=0.006,
        )
