"""Fits nuts over their pegs."""

from __future__ import annotations

from typing import Any

import numpy as np

from asm_gym.policies.scripted.base import Vector
from asm_gym.policies.scripted.carry import CarryExpert, CarryTask

_HANDLE = {"SquareNut": 0.054, "RoundNut": 0.06}  # from the nut's middle to that of its handle [m]


class NutAssemblyExpert(CarryExpert):
    """A scripted expert for NutAssembly, with one nut or with both."""

    pace = 0.5

    def next_task(self, observation: Any) -> CarryTask | None:
        """A nut that is not around its peg; None where all are."""
        env = self.env.unwrapped.robosuite_env  # type: ignore[attr-defined]
        for i, nut in enumerate(env.nuts):
            if env.single_object_mode and i != env.nut_id:
                continue
            at, turned = self.pose(observation, nut.name)
            if not env.on_peg(at, i):
                peg = env.sim.data.body_xpos[(env.peg1_body_id, env.peg2_body_id)[i]]
                return CarryTask(
                    name=nut.name,
                    grip=np.array([_HANDLE[nut.name], 0.0, 0.0]),
                    closing=np.array([0.0, 1.0, 0.0]),
                    turns=np.pi,
                    clearance=0.1,
                    place=np.array([peg[0], peg[1], env.table_offset[2] + 0.03]),
                    over=0.14,
                    headings=self._headings(nut.name, turned),
                    heading_fit=0.06 if nut.name == "SquareNut" else 0.4,
                    fit=0.005,
                )
        return None

    @staticmethod
    def _headings(name: str, turned: Vector) -> tuple[float, ...]:
        """Where the handle may point over the peg: not away from the robot, which could not reach that far."""
        sideways = (np.pi / 2, -np.pi / 2)
        if name == "SquareNut":
            return (*sideways, np.pi)
        return sideways if turned[0, 0] > 0.3 else ()
