"""Fits nuts around their pegs."""

from __future__ import annotations

from typing import Any

import numpy as np

from asm_gym.policies.scripted.carry import CarryExpert, CarryTask

# From a nut's middle to that of its handle [m].
HANDLE = {
    "SquareNut": 0.054,
    "RoundNut": 0.06,
}


class NutAssemblyExpert(CarryExpert):
    """A scripted expert for NutAssembly, with one nut or with both."""

    pace = 0.5

    def next_task(self, observation: Any) -> CarryTask | None:
        """Return a nut that is not around its peg; None where all are."""
        env = self.robosuite
        for number, nut in enumerate(env.nuts):
            if env.single_object_mode and number != env.nut_id:
                continue
            at = self.read(observation, f"{nut.name}_pos")
            if not env.on_peg(at, number):
                peg = (env.peg1_body_id, env.peg2_body_id)[number]
                return self.at_ease(self._task(nut.name, peg), observation)
        return None

    def _task(self, name: str, peg: int) -> CarryTask:
        """Return a nut, by name, that is to go around a peg, the number of a body."""
        env = self.robosuite
        x, y, _ = env.sim.data.body_xpos[peg]
        # The handle points towards the robot, which could not reach further.
        headings: tuple[float, ...] = (np.pi,)
        heading_fit = 0.06
        if name == "RoundNut":
            # A Panda's elbow reaches its stop sooner than others'.
            aside = np.pi / 2 if self.is_careful else 0.5
            headings = (np.pi - aside, np.pi, np.pi + aside)
            heading_fit = 0.2
        return CarryTask(
            name=name,
            grip=np.array([HANDLE[name], 0.0, 0.0]),
            closing=np.array([0.0, 1.0, 0.0]),
            turns=np.pi,
            clearance=0.1,
            # Lower, and the palm would stand on the peg.
            place=np.array([x, y, env.table_offset[2] + 0.05]),
            over=0.14,
            headings=headings,
            heading_fit=heading_fit,
            fit=0.005,
        )
