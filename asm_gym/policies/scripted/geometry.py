"""Rotations of hands and objects, and commands that move a hand towards a pose."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

Vector = NDArray[np.float64]
UP = np.array([0.0, 0.0, 1.0])

# What one unit of action moves the hand's set-point by, in robosuite's OSC_POSE.
METRES = 0.05  # [m]
RADIANS = 0.5  # [rad]
FASTEST_TURN = 0.5  # of the hand, about each axis [action units]


class Pose(NamedTuple):
    """Position and orientation of a hand or an object."""

    at: Vector  # (3,) [m]
    turned: Vector  # (3, 3)

    def point(self, own: Vector) -> Vector:
        """Return a point (3,) of the object's own frame in the world."""
        return self.at + self.turned @ own


def length(vector: Vector) -> float:
    """Return the length of a vector, in its unit."""
    return float(np.linalg.norm(vector))


def rotation(columns: Vector) -> Vector:
    """Return a rotation (3, 3) from its first two columns (6,), made orthonormal again after sensor noise."""
    x, y = columns.reshape(2, 3)
    x = x / length(x)
    y = y - (x @ y) * x
    y /= length(y)
    return np.column_stack([x, y, np.cross(x, y)])


def matrix(quaternion: Vector) -> Vector:
    """Return a rotation (3, 3) from a unit quaternion (x, y, z, w)."""
    x, y, z, w = quaternion
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
    )


def about(axis: Any, angle: float) -> Vector:
    """Return the rotation (3, 3) about a unit ``axis`` by ``angle`` [rad] (Rodrigues)."""
    x, y, z = axis
    K = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])  # K @ v is axis × v
    return np.eye(3) + np.sin(angle) * K + (1 - np.cos(angle)) * (K @ K)


def about_vertical(angle: float) -> Vector:
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
    return float(np.arccos(np.clip((np.trace(a.T @ b) - 1) / 2, -1.0, 1.0)))


def flattest_side(turned: Vector) -> Vector:
    """Return the axis (3,) of an orientation (3, 3) that lies flattest."""
    return turned[:, int(np.abs(turned[2]).argmin())]


def gripping(hand: Vector, closing: Vector | None = None, turns: float = np.pi) -> Vector:
    """Return the orientation nearest ``hand`` (3, 3) for which the fingers point down.

    Args:
        hand: (3, 3) the orientation of the hand.
        closing: (3,) along which the fingers are to close; None for as they close now.
        turns: after a turn by this angle the direction is as good again [rad].
    """
    # The fingers move along the hand's y axis.
    angle = yaw(hand[:, 1])
    if closing is not None:
        heading = yaw(closing)
        angle = heading + np.round((angle - heading) / turns) * turns
    y = np.array([np.cos(angle), np.sin(angle), 0.0])
    z = np.array([0.0, 0.0, -1.0])
    return np.column_stack([np.cross(y, z), y, z])


def move(hand: Pose, target: Vector, turned: Vector, speed: float, gain: float = 1.0) -> Vector:
    """Return the hand's command (6,) towards a pose [action units].

    The controller covers about a third of what it is asked for in one step, so a gain of 2 does
    not overshoot.

    Args:
        hand: the pose of the hand.
        target: (3,) where it is to go [m].
        turned: (3, 3) the orientation that it is to have.
        speed: at most, of its position [action units].
        gain: share of the way to its position to ask for in one step.
    """
    step = gain * (target - hand.at) / METRES
    norm = length(step)
    if norm > speed:
        step *= speed / norm
    turn = 0.5 * np.cross(hand.turned, turned, axis=0).sum(axis=1) / RADIANS
    return np.concatenate([step, np.clip(turn, -FASTEST_TURN, FASTEST_TURN)])
