"""The contact limits and the speed of an episode: an arm that has pressed too hard goes on slowly for a while."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from asm_gym.detection.contact_limits import PLACE, ContactLimits, FamiliarSpeed
from asm_gym.guard.robots import Robots
from asm_gym.monitors import Monitor
from asm_gym.spec import StreamSpec

CAREFUL = 1.0 / 3.0
"""Share of the speed limit that a hand has after it has pressed too hard."""

GENTLE = 0.5
"""Share of the limits on forces that the arm has then; only a policy that presses anew presses as hard so soon."""

CAREFUL_S = 1.0
"""For so long [s], counted while the policy acts."""

Mask = NDArray[np.bool_]


class EpisodeLimits:
    """The contact limits that n robots have now.

    Args:
        robots: whose.
        spec: of their streams.
        limits: None for none.
        acts: an arm stays once a limit was passed, and its hand is slowed down; else limits are only compared with.
        familiar: how fast healthy hands went at each place, for ``limits`` by place.

    Raises:
        ValueError: limits of another arm.
    """

    def __init__(
        self,
        robots: Robots,
        spec: StreamSpec,
        limits: ContactLimits | None,
        acts: bool,
        familiar: FamiliarSpeed | None,
    ) -> None:
        if limits is not None and robots.limits_contact:
            limits.most(robots.felt_channels)
        self._usual = limits if limits is None or acts else replace(limits, stays=False, hand_speed=np.inf)
        self._familiar = familiar if acts and robots.limits_contact else None
        self._place = spec.slices.get(PLACE, slice(0))
        self._careful_steps = max(1, round(CAREFUL_S / robots.dt))
        self._careful = np.zeros(robots.count, np.int64)  # (n,) steps of the policy for which its hand goes slower
        self._places = np.full((robots.count, 3), np.nan)  # (n, 3) of the hands, as sensed last
        limits = self._usual
        self._gentle = None if limits is None else limits.stricter(GENTLE, CAREFUL * limits.hand_speed)
        self.now = (self._usual,) * robots.count
        """Of each robot; the same objects as long as nothing has changed."""
        self.steady = False
        """They stay as they are while no arm presses."""

    def begin(self, which: Mask) -> None:
        """New episodes of the robots of ``which`` (n,)."""
        self._careful[which] = 0
        self._places[which] = np.nan
        self._choose()

    def follow(self, rows: NDArray[np.float32], acted: Mask, pressed: Mask) -> None:
        """Take account of a control step.

        Args:
            rows: (n, D) sensed at its end.
            acted: (n,) the policy has acted.
            pressed: (n,) and has pressed too hard.
        """
        if self._usual is None:
            return
        self._careful = np.where(
            acted, np.where(pressed, self._careful_steps, np.maximum(self._careful - 1, 0)), self._careful
        )
        if self._familiar is not None:
            self._places[:] = rows[:, self._place]
        self._choose()

    def _choose(self) -> None:
        self.steady = self._usual is None or (self._familiar is None and not self._careful.any())
        now = [self._gentle if careful else self._usual for careful in self._careful]
        if self._familiar is not None:
            speeds = [self._familiar.at(place) for place in self._places]
            now = [limits and limits.stricter(1.0, speed) for limits, speed in zip(now, speeds, strict=True)]
        self.now = tuple(now)


def limits_of(contact_limits: ContactLimits | str | None, monitor: Monitor) -> ContactLimits | None:
    """Return the limits themselves, or those that the monitor's healthy range makes of the usual ones."""
    if contact_limits is None or isinstance(contact_limits, ContactLimits):
        return contact_limits
    return ContactLimits(healthy=getattr(monitor, "healthy_", ()))


def familiar_to(monitor: Monitor, limits: ContactLimits | None) -> FamiliarSpeed | None:
    """Return how fast a hand has gone at each place, where ``limits`` ask for that; None where they do not.

    Raises:
        ValueError: they do, and the monitor does not know.
    """
    if limits is None or not limits.by_place:
        return None
    known: FamiliarSpeed | None = getattr(monitor, "familiar_", None)
    if known is None:
        raise ValueError(
            "by_place needs a monitor that knows how fast the hand healthily goes where: "
            "calibrate it on episodes whose stream holds hand_position and hand_velocity"
        )
    return known
