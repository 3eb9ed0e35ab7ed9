"""Rotations of hands and objects, and commands that move a hand towards a pose."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

Vector = NDArray[np.float64]
UP = np.array([0.0, 0.0, 1.0])

# What one unit of action moves the hand's set-point by, in robosuite's OSC_POSE.
UNIT_DISTANCE = 0.05  # [m]
UNIT_TURN = 0.5  # [rad]
FASTEST_TURN = 0.5  # of the hand, about each axis [action units]


class Pose(NamedTuple):
    """Position and orientation of a hand or an object."""

    position: Vector  # (3,) [m]
    orientation: Vector  # (3, 3)

    def point(self, own: Vector) -> Vector:
        """Return a point (3,) of the object's own frame in the world."""
        return self.position + self.orientation @ own


def length(vector: Vector) -> float:
    """Return the length of a vector, in its unit."""
    return float(np.linalg.norm(vector))


def rotation_from_columns(columns: Vector) -> Vector:
    """Return a rotation (3, 3) from its first two columns (6,), made orthonormal again after sensor noise."""
    x, y = columns.reshape(2, 3)
    x = x / length(x)
    y = y - (x @ y) * x
    y /= length(y)
    return np.column_stack([x, y, np.cross(x, y)])


def rotation_from_quaternion(quaternion: Vector) -> Vector:
    """Return a rotation (3, 3) from a unit quaternion (x, y, z, w)."""
    x, y, z, w = quaternion
    xx = x * x
    yy = y * y
    zz = z * z
    xy = x * y
    xz = x * z
    yz = y * z
    xw = x * w
    yw = y * w
    zw = z * w
    first_row = [1 - 2 * (yy + zz), 2 * (xy - zw), 2 * (xz + yw)]
    second_row = [2 * (xy + zw), 1 - 2 * (xx + zz), 2 * (yz - xw)]
    third_row = [2 * (xz - yw), 2 * (yz + xw), 1 - 2 * (xx + yy)]
    return np.array([first_row, second_row, third_row])


def rotation_about(axis: Any, angle: float) -> Vector:
    """Return the rotation (3, 3) about a unit ``axis`` by ``angle`` [rad].

    It is R = 1 + sin(angle) K + (1 - cos(angle)) K², where K v = axis × v (Rodrigues).
    """
    x, y, z = axis
    K = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    sine = np.sin(angle)
    cosine = np.cos(angle)
    return np.eye(3) + sine * K + (1 - cosine) * (K @ K)


def rotation_about_vertical(angle: float) -> Vector:
    """Return the rotation (3, 3) about the vertical [rad]."""
    cosine = np.cos(angle)
    sine = np.sin(angle)
    return np.array([[cosine, -sine, 0.0], [sine, cosine, 0.0], [0.0, 0.0, 1.0]])


def yaw(direction: Vector) -> float:
    """Return the angle of a direction (3,) about the vertical [rad]."""
    return float(np.arctan2(direction[1], direction[0]))


def wrapped(angle: float) -> float:
    """Return the same angle in [-π, π) [rad]."""
    return (angle + np.pi) % (2 * np.pi) - np.pi


def angle_between(a: Vector, b: Vector) -> float:
    """Return the angle between two orientations (3, 3) [rad]."""
    cosine = (np.trace(a.T @ b) - 1) / 2
    return float(np.arccos(np.clip(cosine, -1.0, 1.0)))


def flattest_side(orientation: Vector) -> Vector:
    """Return the axis (3,) of an orientation (3, 3) that lies flattest."""
    slopes = np.abs(orientation[2])
    return orientation[:, int(slopes.argmin())]


def pointing_down(hand: Vector, closing: Vector | None = None, turns: float = np.pi) -> Vector:
    """Return the orientation nearest to the hand's for which the fingers point down.

    Args:
        hand: (3, 3) the orientation of the hand.
        closing: (3,) along which the fingers are to close; None for as they close now.
        turns: after a turn by this angle the direction is as good again [rad].
    """
    # The fingers move along the hand's y axis.
    angle = yaw(hand[:, 1])
    if closing is not None:
        heading = yaw(closing)
        whole_turns = np.round((angle - heading) / turns)
        angle = heading + whole_turns * turns
    y = np.array([np.cos(angle), np.sin(angle), 0.0])
    z = np.array([0.0, 0.0, -1.0])
    return np.column_stack([np.cross(y, z), y, z])


def command_towards(
    hand: Pose, position: Vector, orientation: Vector, speed: float, gain: float = 1.0
) -> Vector:
    """Return the hand's command (6,) towards a pose [action units].

    The controller covers about a third of what it is asked for in one step, so a gain of 2 does
    not overshoot.

    Args:
        hand: the pose of the hand.
        position: (3,) where it is to go [m].
        orientation: (3, 3) the orientation that it is to have.
        speed: at most, of its position [action units].
        gain: share of the way to its position to ask for in one step.
    """
    way = gain * (position - hand.position) / UNIT_DISTANCE
    distance = length(way)
    if distance > speed:
        way *= speed / distance
    turn = 0.5 * np.cross(hand.orientation, orientation, axis=0).sum(axis=1)
    turn = np.clip(turn / UNIT_TURN, -FASTEST_TURN, FASTEST_TURN)
    return np.concatenate([way, turn])
