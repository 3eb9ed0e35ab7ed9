"""Where a hand is by the angles of its arm's joints: a product of exponentials.

    x(q) = e^(S₁ q₁) … e^(S_J q_J) x(0)      S_j: a turn about joint j as it stands where all angles are 0

x is the hand's place, and the first two columns of its rotation: what ``hand_position`` and ``hand_orientation`` say.

Source: Murray, Li and Sastry 1994, A Mathematical Introduction to Robotic Manipulation, chapter 3.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from asm_gym.compilation import compiled

HAND = 9  # how many numbers say where a hand is


class Chain(NamedTuple):
    """One arm, from its base to its hand."""

    prefix: str  # of its channels, where there are several arms
    axes: NDArray[np.float64]  # (J, 3) of its joints where all angles are 0, in the world
    anchors: NDArray[np.float64]  # (J, 3) points on them [m]
    hand: NDArray[np.float64]  # (3, 3) the hand's place there [m], and the first two columns of its rotation
    late_s: float = 0.0  # the angles are sensed by so much later than the hand [s]
    noise: float = 1.0  # how many times the noise that its channels say a reading has

    def at(self, angles: NDArray[np.floating[Any]]) -> NDArray[np.float64]:
        """(9,) the hand by the angles (J,) [rad]."""
        place = np.empty(HAND)
        hand_at(np.asarray(angles, np.float64), self.axes, self.anchors, self.hand, place)
        return place


@compiled
def hand_at(angles: Any, axes: Any, anchors: Any, hand: Any, place: Any) -> None:
    """Write ``place`` (9,), see ``Chain.at``."""
    x = place.reshape((3, 3))
    for k in range(3):
        for i in range(3):
            x[k, i] = hand[k, i]
    for j in range(len(angles) - 1, -1, -1):
        s, c = np.sin(angles[j]), np.cos(angles[j])
        a0, a1, a2 = axes[j, 0], axes[j, 1], axes[j, 2]
        for k in range(3):
            # The place turns about the joint, directions by themselves.
            o0, o1, o2 = (anchors[j, 0], anchors[j, 1], anchors[j, 2]) if k == 0 else (0.0, 0.0, 0.0)
            v0, v1, v2 = x[k, 0] - o0, x[k, 1] - o1, x[k, 2] - o2
            along = (1.0 - c) * (a0 * v0 + a1 * v1 + a2 * v2)
            x[k, 0] = o0 + c * v0 + s * (a1 * v2 - a2 * v1) + along * a0
            x[k, 1] = o1 + c * v1 + s * (a2 * v0 - a0 * v2) + along * a1
            x[k, 2] = o2 + c * v2 + s * (a0 * v1 - a1 * v0) + along * a2
