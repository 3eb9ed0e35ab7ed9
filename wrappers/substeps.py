"""What is watched beneath a control step: the contact limits of an episode."""

from __future__ import annotations

from dataclasses import replace
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

from asm_gym.contact_limits import ContactLimits
from asm_gym.familiar_speed import PLACE
from asm_gym.monitors import Monitor
from asm_gym.protocols import LimitsContact
from asm_gym.spec import control_period
from asm_gym.wrappers.factory import familiar_to
from asm_gym.wrappers.severity import ContactForce

CAREFUL = 1.0 / 3.0
"""Share of the speed limit that a hand has after it has pressed too hard."""

GENTLE = 0.5
"""Share of the limits on forces that the arm has then; only a policy that presses anew presses as hard so soon."""

CAREFUL_S = 1.0
"""For so long [s], counted while the policy acts."""


class Beneath(NamedTuple):
    """What came of a control step beneath it.

    Attributes:
        load: the largest share of a contact limit that was felt; not a number where nobody feels within steps.
        left_s: when, after the step began, a limit was passed [s]; not a number where none was.
        force: contact force on the arm that this comes to, the mean of the step [N]; not a number where nobody feels.
    """

    load: float = np.nan
    left_s: float = np.nan
    force: float = np.nan


def limits_for(limits: ContactLimits | None, acts: bool) -> ContactLimits | None:
    """What an environment is told: where nothing ``acts``, limits are only compared with."""
    return limits if limits is None or acts else replace(limits, stays=False, hand_speed=np.inf)


class SubstepGuard:
    """What connects a guard with one environment's physics substeps.

    Limits go to the environment once an episode, and it compares them in every substep. Where it does not, nobody knows
    what presses between rows.

    Args:
        env: wrapped or not.
        limits: None for none.
        acts: the arm stays from the substep after a limit was passed, and its hand is slowed down.
        monitor: what watches.

    Raises:
        ValueError: limits of another arm.
    """

    def __init__(
        self,
        env: gym.Env[Any, Any],
        limits: ContactLimits | None,
        acts: bool,
        monitor: Monitor,
    ) -> None:
        inner = env.unwrapped
        self._limited = inner if isinstance(inner, LimitsContact) else None
        self._limits = limits_for(limits, acts)
        self._familiar = familiar_to(monitor, limits) if acts else None
        self._at = monitor.spec.slices.get(PLACE, slice(0))
        self._place: NDArray[np.floating[Any]] = np.full(3, np.nan)  # of the hand, when it was sensed last
        if limits is not None and self._limited is not None:
            limits.most(self._limited.felt_channels)
        self._felt = None if self._limited is None else ContactForce.felt_by(self._limited.felt_channels)
        self._careful_steps = max(1, round(CAREFUL_S / control_period(env)))
        self._careful = 0  # steps of the policy for which its hand is slower still

    @property
    def columns(self) -> tuple[NDArray[np.intp], ...]:
        """Of ``contact_felt``: (n, 3) forces at wrists, and (J,) external torques."""
        return (np.zeros((0, 3), np.intp), np.zeros(0, np.intp)) if self._felt is None else self._felt.columns

    @property
    def calm(self) -> bool:
        """Whether limits stay as they are while nothing happens."""
        return not self._careful and self._familiar is None

    def begin(self) -> None:
        """A new episode has begun in the environment."""
        self._careful = 0
        self._place = np.full(3, np.nan)
        self._choose_speed()

    def pressed(self) -> None:
        """The policy has pressed too hard: from now on its hand goes slower for a while."""
        self._careful = self._careful_steps
        self._choose_speed()

    def acted(self) -> None:
        """The policy has acted in a step."""
        if self._careful:
            self._careful -= 1
        self._choose_speed()

    def _choose_speed(self) -> None:
        """Tells the environment its limits, with the speed that is right now."""
        if self._limited is None:
            return
        limits = self._limits
        if limits is not None:
            forces, speed = (GENTLE, CAREFUL * limits.hand_speed) if self._careful else (1.0, limits.hand_speed)
            if self._familiar is not None:
                speed = min(speed, self._familiar.at(self._place))
            if forces != 1.0 or speed != limits.hand_speed:
                limits = limits.stricter(forces, speed)
        self._limited.contact_limits = limits

    def came(self, row: NDArray[np.floating[Any]], info: dict[str, Any]) -> Beneath:
        """What came of the step that ended with ``row`` (D,), of which the environment said ``info``."""
        self._place = np.asarray(row[self._at], np.float64)
        load, left = float(info.get("contact_load", np.nan)), float(info.get("contact_left_s", np.nan))
        force = np.nan if self._felt is None or "contact_felt" not in info else self._felt(info["contact_felt"])
        return Beneath(load, left, force)
