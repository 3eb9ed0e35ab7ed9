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

PRESSED = 2.5  # standard deviations of its completion that the external torque of a pressed joint is off, at least
STILL = 0.02  # a joint that turns by no more than this does not [rad/s]

Rows = NDArray[np.floating[Any]]


class ContactEstimator:
    """Estimates by rows of one stream which joints are pressed."""

    def __init__(self, completion: Completion) -> None:
        spec = completion.spec
        shows = np.zeros(spec.size, bool)
        for channel in spec.channels:
            if "external_torque" in channel.name or channel.group == "wrench":
                shows[spec.slices[channel.name]] = True
        self._completion = completion
        self._dt = spec.dt
        self._filling = completion.filling(shows)
        self._torques = np.isin(
            self._filling.columns, columns_ending(spec.channels, "external_torque")
        )
        self._joints = columns_ending(spec.channels, "joint_position")
        self._names = [
            spec.labels[column].replace("joint_position", "joint") for column in self._joints
        ]

    def deviations(self, rows: Rows) -> NDArray[np.float64]:
        """Return z (T - 1, J) of rows (T, D) but the first."""
        expected = self._completion.complete(self._filling, self._completion.lift(rows))
        beyond = rows[:, self._filling.columns] - expected
        return np.asarray(beyond[1:, self._torques] / self._filling.error[self._torques])

    def presses(self, rows: Rows) -> bool:
        """Return whether something presses in the last of the rows (T, D)."""
        return bool((np.abs(self.deviations(rows[-2:])[-1]) >= PRESSED).any())

    def blocked(self, rows: Rows, joint: str = "") -> bool:
        """Return whether ``joint``, such as ``joint[3]``, has been pressed in most of the rows (T, D), without turning.

        Without a joint: whether any has been pressed, and none has turned; an arm that pulls at a door turns some.
        """
        pressed = np.median(np.abs(self.deviations(rows)), axis=0) > PRESSED
        if len(pressed) != len(self._joints):
            return False
        still = np.ptp(rows[:, self._joints], axis=0) < STILL * self._dt * len(rows)
        if not joint:
            return bool(pressed.any() and still.all())
        return any((pressed & still)[self._names == joint])
