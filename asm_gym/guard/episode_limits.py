"""The contact limits and the speed of an episode: an arm that has pressed too hard goes on slowly for a while."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from asm_gym.detection.contact_limits import ContactLimits
from asm_gym.detection.hand_speed_map import HandSpeedMap
from asm_gym.guard.robot_facts import RobotFacts
from asm_gym.guard.robot_table import Mask
from asm_gym.monitors import Monitor

CAREFUL_SPEED = 0.25  # share of the speed limit that a hand has after it has pressed too hard
# Share of the limits on forces then; only a policy that presses anew presses as hard so soon.
CAREFUL_FORCES = 0.5
CAREFUL_S = 1.0  # for so long [s], counted while the policy acts


class EpisodeLimits:
    """The contact limits that n robots have now.

    Args:
        facts: what is known of the n robots.
        limits: of an arm that has not pressed too hard; None for none.
        acts: an arm stays once a limit was passed, and its hand is slowed down; else limits are only compared with.

    Raises:
        ValueError: limits of another arm.

    Attributes:
        now: (n,) the limits of each robot; the same objects as long as nothing has changed.
        steady: whether they stay as they are while no arm presses.
    """

    def __init__(self, facts: RobotFacts, limits: ContactLimits | None, acts: bool) -> None:
        careful = None
        if limits is not None:
            if facts.limits_contact:
                limits.limit_of_each(facts.felt_channels)  # which refuses limits of another arm
            if not acts:
                limits = replace(limits, stays=False, hand_speed=np.inf)
            careful = limits.reduced(CAREFUL_FORCES, CAREFUL_SPEED * limits.hand_speed)

        self._usual_and_careful = limits, careful
        self._careful_steps = max(1, round(CAREFUL_S / facts.dt))
        # (n,) of the policy, under the careful limits
        self._steps_left = np.zeros(facts.count, np.int64)
        self._choose()

    def begin(self, which: Mask) -> None:
        """Begin new episodes of the robots of ``which`` (n,)."""
        self._steps_left[which] = 0
        self._choose()

    def follow(self, acted: Mask, pressed: Mask) -> None:
        """Take account of a step: in robots of ``acted`` (n,) the policy acted, and of ``pressed`` (n,) too hard."""
        fewer = np.maximum(self._steps_left - 1, 0)
        steps = np.where(pressed, self._careful_steps, fewer)
        self._steps_left[acted] = steps[acted]
        self._choose()

    def _choose(self) -> None:
        is_careful = self._steps_left > 0
        self.steady = not is_careful.any()
        self.now = tuple(self._usual_and_careful[int(careful)] for careful in is_careful)


def limits_of(
    contact_limits: ContactLimits | str | None, monitor: Monitor, facts: RobotFacts
) -> ContactLimits | None:
    """Return the limits themselves, or those that the monitor's healthy range makes of the arms' usual ones."""
    if contact_limits is None or isinstance(contact_limits, ContactLimits):
        return contact_limits
    return replace(
        facts.contact_limits,
        healthy=getattr(monitor, "healthy_", ()),
        pace=HandSpeedMap.of(getattr(monitor, "pace_", {}), facts.task),
    )
