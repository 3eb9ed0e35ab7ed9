"""Where a hand is by the angles of its arm's joints: a product of exponentials.

    x(q) = e^(S₁ q₁) … e^(S_J q_J) x(0)      S_j: a turn about joint j as it stands where all angles are 0

x is the hand's place, and the first two columns of its rotation: what ``hand_position`` and ``hand_orientation`` say.

Source: Murray, Li and Sastry 1994, A Mathematical Introduction to Robotic Manipulation, chapter 3.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from asm_gym.compilation import compiled, inner

HAND_SIZE = 9  # how many numbers say where a hand is
ORIGIN = np.zeros(3)


class Chain(NamedTuple):
    """One arm, from its base to its hand."""

    prefix: str  # of its channels, where there are several arms
    axes: NDArray[np.float64]  # (J, 3) of its joints where all angles are 0, in the world
    anchors: NDArray[np.float64]  # (J, 3) points on them [m]
    hand: NDArray[np.float64]
    """(3, 3) the hand's place there [m], and the first two columns of its rotation."""
    late_s: float = 0.0  # the angles are sensed by so much later than the hand [s]
    noise: float = 1.0  # how many times the noise that its channels say a reading has

    def at(self, angles: NDArray[np.floating[Any]]) -> NDArray[np.float64]:
        """(9,) the hand by the angles (J,) [rad]."""
        place = np.empty(HAND_SIZE)
        exact = np.asarray(angles, np.float64)
        hand_at(exact, self.axes, self.anchors, self.hand, place)
        return place


@compiled
def hand_at(
    angles: Any,
    axes: Any,
    anchors: Any,
    hand: Any,
    place: Any,
) -> None:
    """Write ``place`` (9,), see ``Chain.at``."""
    vectors = place.reshape((3, 3))
    for i in range(HAND_SIZE):
        place[i] = hand[i // 3, i % 3]
    for j in range(len(angles) - 1, -1, -1):
        axis = axes[j]
        angle = angles[j]
        turn(vectors[0], axis, anchors[j], angle)  # the place turns about the joint
        turn(vectors[1], axis, ORIGIN, angle)  # directions turn by themselves
        turn(vectors[2], axis, ORIGIN, angle)


@inner
def turn(
    vector: Any,
    axis: Any,
    anchor: Any,
    angle: float,
) -> None:
    """Turn a vector (3,) about an axis a through an anchor o: o + c v + s a × v + (1 - c)(a · v) a, v from o."""
    sine = np.sin(angle)
    cosine = np.cos(angle)
    x = vector[0] - anchor[0]
    y = vector[1] - anchor[1]
    z = vector[2] - anchor[2]
    offset = (x, y, z)
    along = 0.0
    for i in range(3):
        along += axis[i] * offset[i]
    along *= 1.0 - cosine
    for i in range(3):
        j = (i + 1) % 3
        k = (i + 2) % 3
        crossed = axis[j] * offset[k] - axis[k] * offset[j]
        turned = cosine * offset[i] + sine * crossed
        vector[i] = anchor[i] + turned + along * axis[i]
