"""Actions as the controllers take them: scaled, and turned into rotations, compiled.

The same numbers as robosuite's, to the last bit, whose rotations are of single precision.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from asm_gym.compilation import compiled, inner
from asm_gym.envs.mujoco_views import Floats, Ints

LEAST, MOST, MIDDLE, SCALE, OFFSET = range(5)
"""Rows of a controller's scaling: the bounds of its inputs, and (input - middle) * scale + offset."""


def scaling_of(controller: Any, size: int) -> Floats:
    """Return the scaling (5, size) of robosuite's controller of ``size`` inputs."""
    controller.scale_action(np.zeros(size))  # which works out the numbers below
    c = controller
    rows = (
        c.input_min,
        c.input_max,
        c.action_input_transform,
        c.action_scale,
        c.action_output_transform,
    )
    return np.array([np.broadcast_to(np.asarray(row, np.float64), size) for row in rows])


@inner
def within(value: float, least: float, most: float) -> float:
    """Return a number within bounds; NaN stays."""
    if value < least:
        return least
    return most if value > most else value


@inner
def scaled(action: float, scaling: Floats, a: int, i: int) -> float:
    """Return input ``i`` of controller ``a`` in its own units; scaling is (A, 5, N)."""
    x = within(action, scaling[a, LEAST, i], scaling[a, MOST, i])
    return (x - scaling[a, MIDDLE, i]) * scaling[a, SCALE, i] + scaling[a, OFFSET, i]


@inner
def rotation(turn: Floats, at: int, matrix: Floats) -> None:
    """Write the rotation (3, 3) by three numbers of ``turn`` at ``at``, axis times angle [rad], into ``matrix``."""
    rx, ry, rz = turn[at], turn[at + 1], turn[at + 2]
    angle = np.sqrt(rx * rx + ry * ry + rz * rz)
    w, x, y, z = np.float32(1.0), np.float32(0.0), np.float32(0.0), np.float32(0.0)
    if angle != 0.0:
        sine = np.sin(angle / 2.0)
        w, x = np.float32(np.cos(angle / 2.0)), np.float32(rx / angle * sine)
        y, z = np.float32(ry / angle * sine), np.float32(rz / angle * sine)
    norm = np.float64(w * w) + np.float64(x * x) + np.float64(y * y) + np.float64(z * z)
    scale = np.sqrt(2.0 / np.float64(np.float32(norm)))
    w, x = np.float32(np.float64(w) * scale), np.float32(np.float64(x) * scale)
    y, z = np.float32(np.float64(y) * scale), np.float32(np.float64(z) * scale)
    matrix[0, 0] = 1.0 - np.float64(y * y) - np.float64(z * z)
    matrix[1, 1] = 1.0 - np.float64(x * x) - np.float64(z * z)
    matrix[2, 2] = 1.0 - np.float64(x * x) - np.float64(y * y)
    matrix[0, 1], matrix[1, 0] = x * y - z * w, x * y + z * w
    matrix[1, 2], matrix[2, 1] = y * z - x * w, y * z + x * w
    matrix[2, 0], matrix[0, 2] = z * x - y * w, z * x + y * w


@compiled
def move_gripper(
    asked: Floats, scaling: Floats, ranges: Floats, motors: Ints, ctrl: Floats
) -> None:
    """Command a gripper's motors (G,) as ``asked`` (G,) in [-1, 1], with the scaling (1, 5, G) of its controller.

    ``ranges`` (4, G) are the middle and half of what it commands, and the motors' own bounds.
    """
    for i in range(len(motors)):
        command = ranges[0, i] + ranges[1, i] * scaled(asked[i], scaling, 0, i)
        ctrl[motors[i]] = within(command, ranges[2, i], ranges[3, i])
