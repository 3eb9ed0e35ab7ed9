"""How hard an arm may press and how fast its hand may go before it stays, whatever the cause is taken for.

ISO/TS 15066:2016 (Annex A) lets a robot press a hand, the least tolerant part that it is likely to meet, with 140 N for
long and 280 N for a moment. Healthy motion of the tasks of this package reaches 10 to 71 N at the wrist on one axis and
8 to 34 N m in a joint; what is peculiar to a set-up is learned from its calibration episodes, and the larger of the two
counts.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from asm_gym.spec import Channel
from asm_gym.validation import check_flag, check_number


@dataclass(frozen=True)
class ContactLimits:
    """What an arm may feel and how fast it may go.

    Args:
        wrist_force: on each axis of the wrist, the hand's own weight included [N].
        external_torque: of each joint [N m].
        hand_speed: a command that would move the hand faster is scaled down to it [m/s]; infinite for none. Of
            OSC_POSE and JOINT_POSITION, whose actions are changes of where the arm is; others are not scaled.
        healthy: the most that healthy motion of this body and task was seen to reach, (N,) in the order of
            ``RobosuiteEnv.felt_channels``; where that is more, it counts. Empty where nobody knows.
        stays: the arm stays from the physics substep on after a limit was passed; else it is only said.

    Raises:
        ValueError: a limit that is none.
    """

    wrist_force: float = 80.0
    external_torque: float = 40.0
    hand_speed: float = 0.15
    healthy: tuple[float, ...] = ()
    stays: bool = True

    def __post_init__(self) -> None:
        check_number("wrist_force", self.wrist_force, above=0)
        check_number("external_torque", self.external_torque, above=0)
        check_number("hand_speed", self.hand_speed, above=0, infinite=True)
        for value in self.healthy:
            check_number("healthy", value, low=0)
        check_flag("stays", self.stays)

    def most(self, felt: Sequence[Channel]) -> NDArray[np.float64]:
        """(N,) the limit of each number of what is felt.

        Raises:
            ValueError: ``healthy`` is of another arm.
        """
        fixed = [self.wrist_force if c.name.endswith("wrist_force") else self.external_torque for c in felt]
        most = np.repeat(fixed, [c.size for c in felt]).astype(np.float64)
        if self.healthy and len(self.healthy) != len(most):
            raise ValueError(
                f"healthy must say {len(most)} numbers, one for each that is felt, got {len(self.healthy)}"
            )
        return np.maximum(most, self.healthy) if self.healthy else most

    @property
    def limits_speed(self) -> bool:
        """Whether there is a limit of speed."""
        return math.isfinite(self.hand_speed)
