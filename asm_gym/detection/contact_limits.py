"""How hard an arm may press, and how fast its hand may go, before it stays, whatever the cause is taken for.

    load = max_i |f_i| / max(F_i, H_i) <= 1

f are the external torques of the joints [N m] and the force on each axis of the wrist [N], F their limits, and H the
largest values of healthy motion, at most 2.5 F. ISO/TS 15066:2016 (Annex A) lets a robot press a hand, the least
tolerant part that it is likely to meet, with 140 N for long and 280 N for a moment. Healthy motion of the tasks of this
package reaches 10 to 71 N at the wrist on one axis and 8 to 34 N m in a joint.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from asm_gym.detection.hand_speed import (
    FASTER_WHERE_FREE,
    NO_SPEED_LIMIT,
    Floats,
    SpeedLimit,
    allowed_share,
)
from asm_gym.detection.hand_speed_map import HandSpeedMap
from asm_gym.spec import Channel, StreamSpec
from asm_gym.validation import check_flag, check_number

LIMITED = ("external_torque", "wrist_force")  # ends of the names of the channels that are limited
HARDEST_EPISODES = 0.05
"""No limit makes room for this share of healthy episodes, those that pressed hardest."""
HIGHEST_HEALTHY = 2.5  # healthy values count up to so many times the usual limits: 200 N, 100 N m

FREE_FORCE = 40.0
"""Contact force that healthy motion of many tasks reaches [N]; beyond it contact counts as harm."""

LEANS_S = 0.5
"""More than ``FREE_FORCE`` for longer than this is no blow: the arm leans on something [s]. Healthy motion of six tasks
did so for 0.35 s, once 0.45; ISO/TS 15066 calls contact quasi-static from half a second on."""

STRICTEST = ("wrist_force", "external_torque", "hand_speed", "momentum")  # the smaller the stricter


@dataclass(frozen=True)
class ContactLimits:
    """Limit the contact forces of an arm and the speed of its hand.

    Args:
        wrist_force: on each axis of the wrist, including the weight of the hand [N].
        external_torque: of each joint [N m].
        hand_speed: of the hand, and of points 0.15 m from its fingers as it turns [m/s]; infinite for no limit.
            Under OSC_POSE, OSC_POSITION and JOINT_POSITION a faster command is scaled down. Under every controller a
            brake slows an arm that is still too fast.
        momentum: of each link, the impulse that stops it [N s]; that of ``pace`` counts too. Infinite for no other.
        healthy: largest values in healthy motion of this body and task, (N,) in the order of
            ``RobosuiteEnv.felt_channels``; a larger one replaces the limit. Empty if unknown.
        pace: higher speeds where healthy hands were faster, and twice ``hand_speed`` where nothing is near, as far as
            the environment knows where things are; None for neither.
        stays: hold the arm from the physics substep after a limit was passed; False only reports.

    Raises:
        ValueError: a limit is not positive.
    """

    wrist_force: float = 80.0
    external_torque: float = 40.0
    hand_speed: float = 0.15
    momentum: float = np.inf
    healthy: tuple[float, ...] = ()
    pace: HandSpeedMap | None = None
    stays: bool = True

    def __post_init__(self) -> None:
        for name in STRICTEST:
            check_number(name, getattr(self, name), above=0, infinite=True)
        for value in self.healthy:
            check_number("healthy", value, low=0)
        check_flag("stays", self.stays)

    def limit_of_each(self, felt: Sequence[Channel]) -> Floats:
        """Return (N,) the limit of each number of the channels ``felt``.

        Raises ValueError where ``healthy`` is of another arm.
        """
        limits: list[float] = []
        for channel in felt:
            limit = self.external_torque
            if channel.name.endswith("wrist_force"):
                limit = self.wrist_force
            limits += [limit] * channel.size
        if not self.healthy:
            return np.array(limits, np.float64)

        if len(self.healthy) != len(limits):
            raise ValueError(
                f"healthy must say {len(limits)} numbers, one for each that is felt, "
                f"got {len(self.healthy)}"
            )
        return np.maximum(limits, self.healthy)

    def reduced(self, force_share: float, hand_speed: float) -> ContactLimits:
        """Return limits with a share of the limits on forces, and a hand speed of at most ``hand_speed`` [m/s].

        Momentum is reduced as speed is; pace no longer counts.
        """
        slower = min(hand_speed, self.hand_speed)
        momentum = self.speed_limit().momentum
        if np.isfinite(self.hand_speed):
            momentum *= slower / self.hand_speed
        return replace(
            self,
            wrist_force=force_share * self.wrist_force,
            external_torque=force_share * self.external_torque,
            hand_speed=slower,
            momentum=momentum,
            healthy=tuple(force_share * value for value in self.healthy),
            pace=None,
        )

    def strictest_with(self, other: ContactLimits, felt: Sequence[Channel]) -> ContactLimits:
        """Return the stricter of two limits, for each number; where only one of the two has ``stays``, that one."""
        if self.stays and not other.stays:
            return self
        if other.stays and not self.stays:
            return other

        pace = self.pace
        if pace is None or other.pace is None or not np.array_equal(pace.cells, other.pace.cells):
            pace = None
        strictest = {name: min(getattr(self, name), getattr(other, name)) for name in STRICTEST}
        healthy = np.minimum(self.limit_of_each(felt), other.limit_of_each(felt))
        return replace(self, **strictest, healthy=tuple(healthy.tolist()), pace=pace)

    def speed_limit(self) -> SpeedLimit:
        """Return the limits of the hands' speed, as compiled code reads them."""
        limit = NO_SPEED_LIMIT._replace(
            hand_speed=float(self.hand_speed),
            free_speed=float(self.hand_speed),
            momentum=float(self.momentum),
        )
        if self.pace is None:
            return limit
        momentum = min(limit.momentum, float(self.pace.momentum))
        return limit._replace(
            grid=self.pace.grid,
            low=self.pace.low,
            free_speed=FASTER_WHERE_FREE * limit.hand_speed,
            momentum=momentum,
            pace_momentum=self.pace.pace_momentum,
            least_upright=self.pace.least_upright,
        )

    def share(
        self,
        arm: int,
        place: Floats,
        twist: Floats,
        speed: float,
        soon: float = 1.0,
        momentum: float = 0.0,
    ) -> float:
        """Return the share that a hand may have of a motion; see ``hand_speed.allowed_share``."""
        limit = self.speed_limit()
        return allowed_share(limit, arm, place, twist, speed=speed, soon=soon, momentum=momentum)


def healthy_forces(
    streams: Sequence[NDArray[np.floating[Any]]], spec: StreamSpec
) -> tuple[float, ...]:
    """Return the largest value that healthy streams reached of each number that is limited.

    Args:
        streams: (T, D) of healthy episodes. The hardest ``HARDEST_EPISODES`` are left out.
        spec: of the streams.

    Returns:
        (N,) [N m], [N], at most ``HIGHEST_HEALTHY`` times the usual limits; empty where nothing is felt.
    """
    felt = [channel for channel in spec.channels if channel.name.endswith(LIMITED)]
    if not streams or not felt:
        return ()
    all_columns = np.arange(spec.size)
    columns: list[int] = []
    for channel in felt:
        # the peaks within a row, where the stream has them
        part = spec.slices.get(f"{channel.name}_peak", spec.slices[channel.name])
        columns += all_columns[part].tolist()
    largest = [np.nanmax(np.abs(stream[:, columns]), axis=0) for stream in streams]
    reached = np.array(largest, np.float64)  # (episodes, N)

    usual = ContactLimits().limit_of_each(felt)
    loads = (reached / usual).max(axis=1)  # (episodes,)
    highest_load = loads.max()
    if len(loads) >= 1.0 / HARDEST_EPISODES:
        highest_load = np.quantile(loads, 1.0 - HARDEST_EPISODES, method="lower")
    highest = reached[loads <= highest_load].max(axis=0)
    return tuple(np.minimum(highest, HIGHEST_HEALTHY * usual).tolist())
