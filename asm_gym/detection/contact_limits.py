"""How hard an arm may press and how fast its hand may go before it stays, whatever the cause is taken for.

ISO/TS 15066:2016 (Annex A) lets a robot press a hand, the least tolerant part that it is likely to meet, with 140 N for
long and 280 N for a moment. Healthy motion of the tasks of this package reaches 10 to 71 N at the wrist on one axis and
8 to 34 N m in a joint; what is peculiar to a set-up is learned from its calibration episodes, and the larger of the two
counts.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from asm_gym.spec import Channel, StreamSpec
from asm_gym.validation import check_flag, check_number

FELT = "external_torque", "wrist_force"  # ends of the names of the channels that limits are about
LEFT_OUT = 0.05  # share of healthy episodes, those that pressed hardest, left out of what healthy motion needs
MOST = 2.5  # what was seen counts up to so many times the usual limits: 200 N, 100 N m


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
        for name in ("wrist_force", "external_torque", "hand_speed"):
            check_number(name, getattr(self, name), above=0, infinite=True)
        for value in self.healthy:
            check_number("healthy", value, low=0)
        check_flag("stays", self.stays)

    def most(self, felt: Sequence[Channel]) -> NDArray[np.float64]:
        """Return (N,) the limit of each number that is felt. Raises ValueError where ``healthy`` is of another arm."""
        fixed = [self.wrist_force if c.name.endswith("wrist_force") else self.external_torque for c in felt]
        most = np.repeat(fixed, [c.size for c in felt]).astype(np.float64)
        if self.healthy and len(self.healthy) != len(most):
            raise ValueError(
                f"healthy must say {len(most)} numbers, one for each that is felt, got {len(self.healthy)}"
            )
        return np.maximum(most, self.healthy) if self.healthy else most

    def stricter(self, forces: float, speed: float) -> ContactLimits:
        """Return limits with a share of those on ``forces``, and at most ``speed`` [m/s]."""
        return replace(
            self,
            wrist_force=forces * self.wrist_force,
            external_torque=forces * self.external_torque,
            hand_speed=min(speed, self.hand_speed),
            healthy=tuple(forces * value for value in self.healthy),
        )

    def and_those_of(self, other: ContactLimits, felt: Sequence[Channel]) -> ContactLimits:
        """Return limits as strict as the stricter of two; those for which an arm stays count alone, if one does."""
        if self.stays != other.stays:
            return self if self.stays else other
        return replace(
            self,
            wrist_force=min(self.wrist_force, other.wrist_force),
            external_torque=min(self.external_torque, other.external_torque),
            hand_speed=min(self.hand_speed, other.hand_speed),
            healthy=tuple(np.minimum(self.most(felt), other.most(felt)).tolist()),
        )

    @property
    def limits_speed(self) -> bool:
        """Whether there is a limit of speed."""
        return math.isfinite(self.hand_speed)


def healthy_forces(streams: Sequence[NDArray[np.floating[Any]]], spec: StreamSpec) -> tuple[float, ...]:
    """Return the most that healthy streams (T, D) reached, of each number that an arm feels [N m], [N]; () without."""
    felt = [c for c in spec.channels if c.name.endswith(FELT)]
    if not streams or not felt:
        return ()
    peaks = [spec.slices.get(f"{c.name}_peak", spec.slices[c.name]) for c in felt]
    columns = np.concatenate([np.arange(spec.size)[peak] for peak in peaks])
    reached = np.stack([np.nanmax(np.abs(stream[:, columns].astype(np.float64)), axis=0) for stream in streams])
    usual = ContactLimits().most(felt)
    shares = (reached / usual).max(axis=1)
    kept = shares <= np.quantile(shares, 1.0 - LEFT_OUT, method="higher" if len(shares) < 1.0 / LEFT_OUT else "lower")
    return tuple(np.minimum(reached[kept].max(axis=0), MOST * usual).tolist())
