"""Actions as the controllers take them: scaled, and turned into rotations, compiled.

The same numbers as robosuite's, to the last bit, whose rotations are of single precision.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from asm_gym.compilation import compiled, inner
from asm_gym.envs.mujoco_views import Floats, Ints, Views

# Rows of a controller's scaling: bounds of its inputs, and (input - middle) * scale + offset.
LOWEST_INPUT = 0
HIGHEST_INPUT = 1
INPUT_MIDDLE = 2
INPUT_SCALE = 3
INPUT_OFFSET = 4


def scaling_of(controller: Any, size: int) -> Floats:
    """Return the scaling (5, size) of robosuite's controller of ``size`` inputs."""
    controller.scale_action(np.zeros(size))  # which works out the last three
    scaling = np.zeros((5, size))
    scaling[LOWEST_INPUT] = controller.input_min
    scaling[HIGHEST_INPUT] = controller.input_max
    scaling[INPUT_MIDDLE] = controller.action_input_transform
    scaling[INPUT_SCALE] = controller.action_scale
    scaling[INPUT_OFFSET] = controller.action_output_transform
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
    lowest = scaling[LOWEST_INPUT, i]
    highest = scaling[HIGHEST_INPUT, i]
    from_middle = within(value, lowest, highest) - scaling[INPUT_MIDDLE, i]
    return from_middle * scaling[INPUT_SCALE, i] + scaling[INPUT_OFFSET, i]


@inner
def rotation(turn: Floats, matrix: Floats) -> None:
    """Write the rotation (3, 3) by ``turn`` (3,), axis times angle [rad], into ``matrix``."""
    rx = turn[0]
    ry = turn[1]
    rz = turn[2]
    angle = np.sqrt(rx * rx + ry * ry + rz * rz)
    # The quaternion of the turn: w is 1 where there is none.
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

    norm = np.float64(w * w) + np.float64(x * x) + np.float64(y * y) + np.float64(z * z)
    scale = np.sqrt(2.0 / np.float64(np.float32(norm)))
    w = np.float32(w * scale)
    x = np.float32(x * scale)
    y = np.float32(y * scale)
    z = np.float32(z * scale)
    xx = np.float64(x * x)
    yy = np.float64(y * y)
    zz = np.float64(z * z)
    xy = x * y
    xz = z * x
    yz = y * z
    wx = x * w
    wy = y * w
    wz = z * w
    matrix[0, 0] = 1.0 - yy - zz
    matrix[1, 1] = 1.0 - xx - zz
    matrix[2, 2] = 1.0 - xx - yy
    matrix[0, 1] = xy - wz
    matrix[1, 0] = xy + wz
    matrix[1, 2] = yz - wx
    matrix[2, 1] = yz + wx
    matrix[2, 0] = xz - wy
    matrix[0, 2] = xz + wy


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
        middle = 0.5 * (highest + lowest)
        half = 0.5 * (highest - lowest)
        bounds = views.actuator_ctrlrange[self._motors].T
        self._ranges = np.array([middle, half, *bounds])

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
    middle = ranges[0]
    half = ranges[1]
    lowest = ranges[2]
    highest = ranges[3]
    for i in range(len(motors)):
        target = middle[i] + half[i] * scaled(fingers[i], scaling, i)
        ctrl[motors[i]] = within(target, lowest[i], highest[i])
