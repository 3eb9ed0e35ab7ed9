"""Name what is wrong with a servo that an alarm points to: it is too hot, or it has stalled.

    overheated    temperature >= HOT_C
    stalled       min |sent - sensed| > STALL_SHARE (max sensed - min sensed), and sent changes

A stall is looked for in the steps of the newest ``STALL_S``.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping
from typing import Any

import numpy as np

from asm_gym.wrappers.lerobot_arm import LoopStep, number_of, servo_of

OVERHEATED = "overheated"
STALLED = "stalled"

STALL_S = 0.2  # for so long a stalled servo has not moved [s]
STALL_SHARE = 3.0  # least distance to a stalled servo's target, in distances that it moved
HOT_C = 60.0  # servos switch themselves off at 70 °C
TEMPERATURES = ("temperature", "temp")  # names of temperatures beside a servo's position


class ServoHistory:
    """Remember the newest steps, to tell whether a servo has stalled.

    Args:
        dt: time between two steps [s].
    """

    def __init__(self, dt: float) -> None:
        self._size = max(2, round(STALL_S / dt))
        self._steps: deque[LoopStep] = deque(maxlen=self._size)

    def append(self, observation: Mapping[str, Any], sent: Mapping[str, float]) -> None:
        """Remember an observation, and the command that was sent before it."""
        self._steps.append(LoopStep(dict(observation), dict(sent)))

    def fault_of(self, motor: str, observation: Mapping[str, Any]) -> str:
        """Return the fault of a motor's servo, or empty.

        Args:
            motor: name of the number that an alarm points to.
            observation: the newest one, perhaps with a temperature such as
                ``elbow_flex.temperature``.
        """
        servo = servo_of(motor)
        for name in TEMPERATURES:
            if number_of(observation, f"{servo}.{name}") >= HOT_C:
                return OVERHEATED
        if self._has_stalled(motor):
            return STALLED
        return ""

    def _has_stalled(self, motor: str) -> bool:
        """Return whether a motor was told to move in all remembered steps, and hardly moved."""
        if len(self._steps) < self._size:
            return False
        sensed = [number_of(step.observation, motor) for step in self._steps]
        sent = np.array([number_of(step.command, motor) for step in self._steps], np.float32)
        if not (np.isfinite(sensed).all() and np.isfinite(sent).all()):
            return False
        distance = np.abs(sent - sensed).min()
        return bool(distance > STALL_SHARE * np.ptp(sensed) and np.ptp(sent) > 0)
