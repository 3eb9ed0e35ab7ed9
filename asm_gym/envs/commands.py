"""Actions as the controllers take them: checked, scaled, and turned into rotations, compiled.

The same numbers as robosuite's, to the last bit, whose rotations are of single precision.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from asm_gym.compilation import compiled
from asm_gym.envs.mujoco_views import Floats, Ints

LEAST, MOST, MIDDLE, SCALE, OFFSET = range(5)
"""Rows of a controller's scaling: the bounds of its inputs, and (input - middle) * scale + offset."""


def scaling_of(controller: Any, size: int) -> Floats:
    """Return the scaling (5, size) of robosuite's controller of ``size`` inputs."""
    controller.scale_action(np.zeros(size))  # which works out the numbers below
    c = controller
    rows = c.input_min, c.input_max, c.action_input_transform, c.action_scale, c.action_output_transform
    return np.array([np.broadcast_to(np.asarray(row, np.float64), size) for row in rows])


@compiled
def clip(action: NDArray[np.float32], clipped: NDArray[np.float32]) -> bool:
    """Write an action (A,) within [-1, 1] into ``clipped``; return whether it is finite."""
    for i in range(len(action)):
        if not np.isfinite(action[i]):
            return False
        clipped[i] = min(max(action[i], np.float32(-1.0)), np.float32(1.0))
    return True


@compiled
def in_units(action: NDArray[np.float32], low: Floats, half: Floats) -> Floats:
    """Return an action (A,) in [-1, 1] within bounds whose least and half range are ``low`` and ``half`` (A,)."""
    found = np.empty(len(action))
    for i in range(len(action)):
        found[i] = low[i] + half[i] * (np.float64(action[i]) + 1.0)
    return found


@compiled
def within(value: float, least: float, most: float) -> float:
    """Return a number within bounds; NaN stays."""
    if value < least:
        return least
    return most if value > most else value


@compiled
def scaled(action: float, scaling: Floats, i: int) -> float:
    """Return input ``i`` of a controller in its own units."""
    x = within(action, scaling[LEAST, i], scaling[MOST, i])
    found: float = (x - scaling[MIDDLE, i]) * scaling[SCALE, i] + scaling[OFFSET, i]
    return found


@compiled
def rotation(turn: Floats, matrix: Floats) -> None:
    """Write the rotation (3, 3) by ``turn`` (3,), an axis times an angle [rad], into ``matrix``."""
    angle = np.sqrt(turn[0] * turn[0] + turn[1] * turn[1] + turn[2] * turn[2])
    q = np.zeros(4, np.float32)
    q[0] = 1.0
    if angle != 0.0:
        q[0] = np.cos(angle / 2.0)
        for i in range(3):
            q[1 + i] = turn[i] / angle * np.sin(angle / 2.0)
    norm = np.float64(0.0)
    for i in range(4):
        norm += np.float64(q[i] * q[i])
    scale = np.sqrt(2.0 / np.float64(np.float32(norm)))
    for i in range(4):
        q[i] = np.float64(q[i]) * scale
    for i in range(3):
        j, k = (i + 1) % 3, (i + 2) % 3
        a, b, c, w = q[1 + i], q[1 + j], q[1 + k], q[0]
        first, second = q[1 + min(j, k)], q[1 + max(j, k)]
        matrix[i, i] = 1.0 - np.float64(first * first) - np.float64(second * second)
        matrix[i, j] = np.float64(a * b - c * w)
        matrix[j, i] = np.float64(a * b + c * w)


@compiled
def move_arms(action: Floats, first: Ints, count: Ints, scalings: Floats, deltas: Floats, turns: Floats) -> None:
    """Write what an action asks of each arm into deltas (A, JOINTS), and its rotation into turns (A, 3, 3).

    Args:
        first, count: (A,) each arm's part of the action.
        scalings: (A, 5, JOINTS).
    """
    for a in range(len(first)):
        for i in range(count[a]):
            deltas[a, i] = scaled(action[first[a] + i], scalings[a], i)
        rotation(deltas[a, 3:6], turns[a])


@compiled
def move_gripper(asked: Floats, scaling: Floats, ranges: Floats, motors: Ints, ctrl: Floats) -> None:
    """Command a gripper's motors (G,).

    Args:
        asked: (G,) in [-1, 1].
        scaling: (5, G) of robosuite's controller.
        ranges: (4, G) the middle and half of what it commands, and the motors' own bounds.
    """
    for i in range(len(motors)):
        command = ranges[0, i] + ranges[1, i] * scaled(asked[i], scaling, i)
        ctrl[motors[i]] = within(command, ranges[2, i], ranges[3, i])
