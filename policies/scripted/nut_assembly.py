"""Fits nuts over their pegs."""

from __future__ import annotations

from typing import Any

import numpy as np

from asm_gym.policies.scripted.carry import CarryExpert, CarryTask

_HANDLE = {"SquareNut": 0.054, "RoundNut": 0.06}  # from the nut's middle to that of its handle [m]


class NutAssemblyExpert(CarryExpert):
    """A scripted expert for NutAssembly, with one nut or with both."""

    pace = 0.5

    def next_task(self, observation: Any) -> CarryTask | None:
        """Return a nut that is not around its peg; None where all are."""
        env = self.robosuite
        for i, nut in enumerate(env.nuts):
            if env.single_object_mode and i != env.nut_id:
                continue
            at, _ = self.pose(observation, nut.name)
            if not env.on_peg(at, i):
                peg = env.sim.data.body_xpos[(env.peg1_body_id, env.peg2_body_id)[i]]
                square = nut.name == "SquareNut"
                task = CarryTask(
                    name=nut.name,
                    grip=np.array([_HANDLE[nut.name], 0.0, 0.0]),
                    closing=np.array([0.0, 1.0, 0.0]),
                    turns=np.pi,
                    clearance=0.1,
                    # Lower, and the palm would stand on the peg.
                    place=np.array([peg[0], peg[1], env.table_offset[2] + 0.05]),
                    over=0.14,
                    # The handle points towards the robot, which could not reach further.
                    headings=(np.pi,) if square else self._headings(),
                    heading_fit=0.06 if square else 0.2,
                    fit=0.005,
                )
                return self.at_ease(task, observation)
        return None

    def _headings(self) -> tuple[float, ...]:
        """Return where the handle of a round nut may point: a Panda's elbow reaches its stop sooner than others'."""
        aside = np.pi / 2 if self._careful else 0.5
        return np.pi - aside, np.pi, np.pi + aside
