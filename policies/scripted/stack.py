"""Stacks the red cube on the green one."""

from __future__ import annotations

from typing import Any

import numpy as np

from asm_gym.policies.scripted.carry import CarryExpert, Errand

_SMALL, _LARGE = 0.02, 0.025  # half the edges of the two cubes [m]


class StackExpert(CarryExpert):
    """A scripted expert for Stack."""

    pace = 0.5

    def next_errand(self, observation: Any) -> Errand | None:
        """The red cube, until it lies on the green one."""
        red, turned = self.pose(observation, "cubeA")
        green, _ = self.pose(observation, "cubeB")
        place = green + np.array([0.0, 0.0, _SMALL + _LARGE])
        if np.linalg.norm(red - place) < 0.02:
            return None
        side = turned[:, int(np.abs(turned[2]).argmin())]  # the one that lies flattest gives the cube's heading
        return Errand(
            name="cubeA",
            grip=np.zeros(3),
            closing=turned.T @ side,
            turns=np.pi / 2,
            clearance=0.08,
            place=place,
            over=0.06,
            fit=0.006,
        )
