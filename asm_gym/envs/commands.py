"""Actions as the controllers take them: scaled, and turned into rotations, compiled.

The same numbers as robosuite's, to the last bit, whose rotations are of single precision.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from asm_gym.compilation import compiled, inner
from asm_gym.envs.mujoco_views import Floats, Ints, Views

# Rows of a controller's scaling: bounds of its inputs, and (input - middle) * scale + offset.
LEAST = 0
MOST = 1
MIDDLE = 2
SCALE = 3
OFFSET = 4


def scaling_of(controller: Any, size: int) -> Floats:
    """Return the scaling (5, size) of robosuite's controller of ``size`` inputs."""
    controller.scale_action(np.zeros(size))  # which works out the last three
    scaling = np.zeros((5, size))
    scaling[LEAST] = controller.input_min
    scaling[MOST] = controller.input_max
    scaling[MIDDLE] = controller.action_input_transform
    scaling[SCALE] = controller.action_scale
    scaling[OFFSET] = controller.action_output_transform
    return scaling


@inner
def within(value: float, least: float, most: float) -> float:
    """Return a number within bounds; NaN stays."""
    if value < least:
        return least
    if value > most:
        return most
    return value


@inner
def scaled(value: float, scaling: Floats, i: int) -> float:
    """Return input ``i`` of a controller in its own units; scaling is (5, N)."""
    x = within(value, scaling[LEAST, i], scaling[MOST, i])
    return (x - scaling[MIDDLE, i]) * scaling[SCALE, i] + scaling[OFFSET, i]


@inner
def product(x: Any, y: Any) -> float:
    """Return the product of two numbers of single precision, in double."""
    return np.float64(x * y)


@inner
def rotation(turn: Floats, matrix: Floats) -> None:
    """Write the rotation (3, 3) by ``turn`` (3,), axis times angle [rad], into ``matrix``."""
    rx = turn[0]
    ry = turn[1]
    rz = turn[2]
    angle = np.sqrt(rx * rx + ry * ry + rz * rz)
    w = np.float32(1.0)
    x = np.float32(0.0)
    y = np.float32(0.0)
    z = np.float32(0.0)
    if angle != 0.0:
        sine = np.sin(angle / 2.0)
        w = np.float32(np.cos(angle / 2.0))
        x = np.float32(rx / angle * sine)
        y = np.float32(ry / angle * sine)
        z = np.float32(rz / angle * sine)

    norm = product(w, w) + product(x, x) + product(y, y) + product(z, z)
    scale = np.sqrt(2.0 / np.float64(np.float32(norm)))
    w = np.float32(w * scale)
    x = np.float32(x * scale)
    y = np.float32(y * scale)
    z = np.float32(z * scale)
    matrix[0, 0] = 1.0 - product(y, y) - product(z, z)
    matrix[1, 1] = 1.0 - product(x, x) - product(z, z)
    matrix[2, 2] = 1.0 - product(x, x) - product(y, y)
    matrix[0, 1] = x * y - z * w
    matrix[1, 0] = x * y + z * w
    matrix[1, 2] = y * z - x * w
    matrix[2, 1] = y * z + x * w
    matrix[2, 0] = z * x - y * w
    matrix[0, 2] = z * x + y * w


class Gripper:
    """The gripper of an arm.

    Args:
        robot, arm: robosuite's robot, and the name of its arm.
        part: of the action, which commands the gripper.
        views: arrays of the loaded model.
    """

    def __init__(self, robot: Any, arm: str, part: slice, views: Views) -> None:
        name = robot.get_gripper_name(arm)
        controller = robot.composite_controller.part_controllers[name]
        highest = controller.actuator_max
        lowest = controller.actuator_min
        self._gripper = robot.gripper[arm]
        self._part = part
        self._motors = np.asarray(robot._ref_actuators_indexes_dict[name], np.int64)
        self._ctrl = views.ctrl
        self._scaling = scaling_of(controller, controller.control_dim)
        bounds = views.actuator_ctrlrange[self._motors].T
        self._ranges = np.array([0.5 * (highest + lowest), 0.5 * (highest - lowest), *bounds])

    def command(self, action: Floats) -> None:
        """Command the motors as an action asks.

        As robosuite's controller does it, less its reading of the joints, which nothing here uses.
        """
        fingers = np.asarray(self._gripper.format_action(action[self._part]), np.float64)
        move_gripper(fingers, self._scaling, self._ranges, self._motors, self._ctrl)


@compiled
def move_gripper(
    fingers: Floats, scaling: Floats, ranges: Floats, motors: Ints, ctrl: Floats
) -> None:
    """Command a gripper's motors (G,), with the scaling (5, G) of its controller.

    ``ranges`` (4, G) are the middle and half of what it commands, and the motors' own bounds.
    """
    for i in range(len(motors)):
        value = ranges[0, i] + ranges[1, i] * scaled(fingers[i], scaling, i)
        ctrl[motors[i]] = within(value, ranges[2, i], ranges[3, i])
