"""What presses on an arm: external torque beyond what everything else that is sensed tells of."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from asm_gym.guard.robots import Robots
from asm_gym.memory.completion import Completion
from asm_gym.spec import StreamSpec

PRESSING = 2.5
"""Something presses where an external torque is so many of its completion's standard deviations off."""

STILL = 0.02
"""A joint that turns by no more than this does not [rad/s]."""


class ContactEstimator:
    """Tells what presses, by one completion of all that a contact shows in.

    Args:
        robots: they say, where they can, which force is behind the torques.
        completion: of the memory that watches; its stream measures external torques.
    """

    def __init__(self, robots: Robots, completion: Completion) -> None:
        spec = completion.spec
        self._completion, self._dt, self._robots = completion, spec.dt, robots
        self._filling = completion.filling(_contact_columns(spec))
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

    def force(self, robot: int, rows: NDArray[np.floating[Any]]) -> dict[str, Any] | None:
        """Return the link that is pressed in the last of the rows (T, D), and the force (3,) [N] on it in the world."""
        if self._robots.force_behind is None:
            return None
        torques = self.beyond(rows[-2:])[-1] * self._filling.error[self._own]
        link, force = self._robots.force_behind(robot, torques)
        return {"link": link, "newtons": float(np.linalg.norm(force)), "vector": force.round(3).tolist()}


def named(spec: StreamSpec, channel: str) -> NDArray[np.intp]:
    """Return (J,) the columns of a channel, of all arms."""
    return np.array([i for i, label in enumerate(spec.labels) if label.split("[")[0].endswith(channel)], np.intp)


def _contact_columns(spec: StreamSpec) -> NDArray[np.bool_]:
    """Return (D,) what a contact shows in: external torques, their peaks too, and forces and torques at the wrist."""
    groups = [c.group for c in spec.channels for _ in range(c.size)]
    external = np.array(["external_torque" in label for label in spec.labels])
    found: NDArray[np.bool_] = external | np.array([g == "wrench" for g in groups])
    return found
