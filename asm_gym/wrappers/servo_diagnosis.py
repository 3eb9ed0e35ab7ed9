"""Name what is wrong with a servo that an alarm points to: it is too hot, or it has stalled.

    overheated    temperature >= HOT_C
    stalled       min |sent - sensed| > STALL_SHARE (max sensed - min sensed), and
                  |current| > MARGIN max healthy |current|, or, where no current is known, sent changes

A stall is looked for in the steps of the newest ``STALL_S``. With a current it is an alarm by itself.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from asm_gym.monitors.robot_limits import MARGIN
from asm_gym.wrappers.lerobot_arm import SENSED, LoopStep, MotorColumn, number_of, servo_of

OVERHEATED = "overheated"
STALLED = "stalled"

STALL_S = 0.2  # for so long a stalled servo has not moved [s]
STALL_SHARE = 3.0  # least distance to a stalled servo's target, in distances that it moved
HOT_C = 60.0  # servos switch themselves off at 70 °C
TEMPERATURES = ("temperature", "temp")  # names of temperatures beside a servo's position
CURRENT = ".current"  # what the name of a servo's current ends in


def stall_currents(monitor: Any, columns: Sequence[MotorColumn]) -> dict[str, float]:
    """Return the current of each servo that healthy motion does not need, by servo.

    Args:
        monitor: a calibrated monitor; empty of one that keeps no healthy ranges.
        columns: (D,) of its stream.
    """
    ranges = getattr(monitor, "ranges_", None)  # (8, D)
    if ranges is None:
        return {}
    greatest = MARGIN * np.maximum(np.abs(ranges[0]), np.abs(ranges[5]))
    return {
        servo_of(column.motor): float(most)
        for column, most in zip(columns, greatest, strict=True)
        if column.group == SENSED and column.motor.endswith(CURRENT)
    }


class ServoHistory:
    """Remember the newest steps, to tell whether a servo has stalled.

    Args:
        dt: time between two steps [s].
        most_currents: of servos whose current is sensed, see ``stall_currents``.
    """

    def __init__(self, dt: float, most_currents: Mapping[str, float]) -> None:
        self._most_currents = most_currents
        self._size = max(2, round(STALL_S / dt))
        self._steps: deque[LoopStep] = deque(maxlen=self._size)

    def append(self, observation: Mapping[str, Any], sent: Mapping[str, float]) -> None:
        """Remember an observation, and the command that was sent before it."""
        self._steps.append(LoopStep(dict(observation), dict(sent)))

    def overloaded(self, observation: Mapping[str, Any]) -> str:
        """Return the servo that does not move to where it is told and takes too much current; else empty."""
        for servo, most in self._most_currents.items():
            current = abs(number_of(observation, servo + CURRENT))
            if current > most and self._has_stalled(f"{servo}.pos", is_told_to_move=False):
                return servo
        return ""

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
        if self._has_stalled(motor) or (servo and servo == self.overloaded(observation)):
            return STALLED
        return ""

    def _has_stalled(self, motor: str, is_told_to_move: bool = True) -> bool:
        """Return whether a motor was far from its target in all remembered steps, and hardly moved.

        ``is_told_to_move``: the target changed too.
        """
        if len(self._steps) < self._size:
            return False
        sensed = [number_of(step.observation, motor) for step in self._steps]
        sent = np.array([number_of(step.command, motor) for step in self._steps], np.float32)
        if not (np.isfinite(sensed).all() and np.isfinite(sent).all()):
            return False
        distance = np.abs(sent - sensed).min()
        if is_told_to_move and np.ptp(sent) == 0:
            return False
        return bool(distance > STALL_SHARE * np.ptp(sensed))
