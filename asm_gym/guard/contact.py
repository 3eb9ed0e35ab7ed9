"""What presses on an arm: external torque beyond what everything else that is sensed tells of."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from asm_gym.guard.robots import named
from asm_gym.memory.completion import Completion

PRESSING = 2.5
"""Something presses where an external torque is so many of its completion's standard deviations off."""

STILL = 0.02
"""A joint that turns by no more than this does not [rad/s]."""


class ContactEstimator:
    """Tells what presses, by one completion of all that a contact shows in.

    Args:
        completion: of the memory that watches; its stream measures external torques.
    """

    def __init__(self, completion: Completion) -> None:
        spec = completion.spec
        self._completion, self._dt = completion, spec.dt
        # Where a contact shows: in external torques, their peaks too, and in forces and torques at the wrist.
        shows = ["external_torque" in c.name or c.group == "wrench" for c in spec.channels for _ in range(c.size)]
        self._filling = completion.filling(np.array(shows, bool))
        self._own = np.isin(self._filling.columns, named(spec, "external_torque"))
        self._joints = named(spec, "joint_position")

    def beyond(self, rows: NDArray[np.floating[Any]]) -> NDArray[np.float64]:
        """Return (T - 1, J) external torques of all rows (T, D) but the first, beyond what is expected [its standard
        deviations]."""
        expected = self._completion.complete(self._filling, self._completion.lift(rows))
        beyond = (rows[:, self._filling.columns] - expected)[1:, self._own]
        found: NDArray[np.float64] = beyond / self._filling.error[self._own]
        return found

    def presses(self, rows: NDArray[np.floating[Any]]) -> bool:
        """Return whether something presses in the last of the rows (T, D)."""
        return bool((np.abs(self.beyond(rows[-2:])[-1]) >= PRESSING).any())

    def blocked(self, rows: NDArray[np.floating[Any]], joint: str = "") -> bool:
        """Return whether ``joint``, such as ``joint[3]``, has been pressed in most of the rows (T, D), without turning.

        Without a joint: whether any has been pressed, and none has turned; an arm that pulls at a door turns some.
        """
        pressed = np.median(np.abs(self.beyond(rows)), axis=0) > PRESSING
        if len(pressed) != len(self._joints):
            return False
        still = np.ptp(rows[:, self._joints], axis=0) < STILL * self._dt * len(rows)
        if not joint:
            return bool(pressed.any() and still.all())
        labels = [self._completion.spec.labels[column].replace("joint_position", "joint") for column in self._joints]
        return bool((pressed & still)[[label == joint for label in labels]].any())
