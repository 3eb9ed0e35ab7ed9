"""Tells what presses, in a stream with external torques, by one completion of all that a contact shows in.

z_j = (τ_j - τ̂_j) / ε_j      τ̂, ε: external torque of joint j, completed from senses without contact, and its error
pressed: |z_j| > PRESSED
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from asm_gym.guard.robot_facts import columns_ending
from asm_gym.memory.completion import Completion

# A pressed joint's external torque is off by at least so many deviations of its completion.
PRESSED = 2.5
STILL = 0.02  # a joint that turns by no more than this does not [rad/s]

Rows = NDArray[np.floating[Any]]


class ContactEstimator:
    """Estimates by rows of one stream which joints are pressed.

    Args:
        completion: of the memory that watches the stream.
    """

    def __init__(self, completion: Completion) -> None:
        spec = completion.spec
        shows_contact = np.zeros(spec.size, bool)
        for channel in spec.channels:
            if "external_torque" in channel.name or channel.group == "wrench":
                shows_contact[spec.slices[channel.name]] = True
        torques = columns_ending(spec.channels, "external_torque")
        joints = columns_ending(spec.channels, "joint_position")
        self._completion = completion
        self._filling = completion.filling(shows_contact)
        self._is_torque = np.isin(self._filling.columns, torques)
        self._joints = joints
        self._labels = np.array(spec.labels)[joints]

    def deviations(self, rows: Rows) -> NDArray[np.float64]:
        """Return z (T - 1, J) of rows (T, D) but the first."""
        filling = self._filling
        lifted = self._completion.lift(rows)
        expected = self._completion.complete(filling, lifted)
        z = (rows[:, filling.columns] - expected) / filling.error
        return np.asarray(z[1:, self._is_torque])

    def presses(self, rows: Rows) -> bool:
        """Return whether something presses in the last of the rows (T, D)."""
        newest = self.deviations(rows[-2:])
        pressed = np.abs(newest) >= PRESSED
        return bool(pressed.any())

    def blocked(self, rows: Rows, joint: str = "") -> bool:
        """Return whether ``joint``, such as ``joint[3]``, has been pressed in most of the rows (T, D), without turning.

        Without a joint: whether any has been pressed, and none has turned; an arm that pulls at a door turns some.
        """
        deviations = np.abs(self.deviations(rows))
        pressed = np.median(deviations, axis=0) > PRESSED
        if len(pressed) != len(self._joints):
            return False
        turned = np.ptp(rows[:, self._joints], axis=0)
        most = STILL * self._completion.spec.dt * len(rows)
        still = turned < most
        if not joint:
            return bool(pressed.any() and still.all())
        label = joint.replace("joint", "joint_position")
        own = self._labels == label
        return bool((pressed & still & own).any())
