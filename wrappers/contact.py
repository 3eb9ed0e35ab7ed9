"""What presses on an arm: external torque beyond what everything else that is sensed tells of."""

from __future__ import annotations

from typing import Any, Self

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

from asm_gym.memory.completion import Completion
from asm_gym.protocols import LocatesForces
from asm_gym.spec import StreamSpec

PRESSING = 2.5
"""Something presses where an external torque is so many of its completion's standard deviations off."""

STILL = 0.02
"""A joint that turns by no more than this does not [rad/s]."""


class ContactEstimator:
    """Feels what presses, by one completion of all that a contact shows in.

    Args:
        env: tells, where it can, which force is behind the torques.
        completion: of the memory that watches; its stream measures external torques.
    """

    def __init__(self, env: gym.Env[Any, Any], completion: Completion) -> None:
        spec, inner = completion.spec, env.unwrapped
        self._completion, self._dt = completion, spec.dt
        self._filling = completion.filling(_touched(spec))
        self._own = np.isin(self._filling.columns, _named(spec, "external_torque"))
        self._joints = _named(spec, "joint_position")
        self._body = inner if isinstance(inner, LocatesForces) else None

    @classmethod
    def where_measured(cls, env: gym.Env[Any, Any], completion: Completion) -> Self | None:
        """None where no external torque is measured."""
        return cls(env, completion) if _named(completion.spec, "external_torque").size else None

    def beyond(self, rows: NDArray[np.floating[Any]]) -> NDArray[np.float64]:
        """(T - 1, J) external torques of all rows (T, D) but the first, beyond what is expected [its standard
        deviations]."""
        expected = self._completion.complete(self._filling, self._completion.lift(rows))
        beyond = (rows[:, self._filling.columns] - expected)[1:, self._own]
        found: NDArray[np.float64] = beyond / self._filling.error[self._own]
        return found

    def presses(self, rows: NDArray[np.floating[Any]]) -> bool:
        """Whether something does in the last of the rows (T, D)."""
        return bool((np.abs(self.beyond(rows[-2:])[-1]) >= PRESSING).any())

    def blocked(self, rows: NDArray[np.floating[Any]], joint: str = "") -> bool:
        """Whether ``joint``, such as ``joint[3]``, has been pressed in most of the rows (T, D) and has not turned.

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

    def force(self, rows: NDArray[np.floating[Any]]) -> dict[str, Any] | None:
        """The link that is pressed in the last of the rows (T, D), and the force (3,) [N] on it in the world."""
        if self._body is None:
            return None
        link, force = self._body.force_behind(self.beyond(rows[-2:])[-1] * self._filling.error[self._own])
        return {"link": link, "newtons": float(np.linalg.norm(force)), "vector": force.round(3).tolist()}


def _named(spec: StreamSpec, channel: str) -> NDArray[np.intp]:
    """(J,) the columns of a channel, of all arms."""
    return np.array([i for i, label in enumerate(spec.labels) if label.split("[")[0].endswith(channel)], np.intp)


def _touched(spec: StreamSpec) -> NDArray[np.bool_]:
    """(D,) what a contact shows in: external torques, their peaks too, and forces and torques at the wrist."""
    groups = [c.group for c in spec.channels for _ in range(c.size)]
    external = np.array(["external_torque" in label for label in spec.labels])
    found: NDArray[np.bool_] = external | np.array([g == "wrench" for g in groups])
    return found
