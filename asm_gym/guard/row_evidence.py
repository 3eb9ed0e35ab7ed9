"""What is known of a row of one robot about which there is something to decide."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from asm_gym.guard.contact_state import FASTEST_HEALTHY
from asm_gym.guard.hand_check import Contradiction


@dataclass(frozen=True, kw_only=True, slots=True)
class RowEvidence:
    """Evidence for diagnosis and arbitration.

    Args:
        index: of the robot.
        robot: its record in the table, see ``robot_table.ROBOT``.
        rows: (T, D) its last rows, the newest last.
        attribution: (D,) where the surprise is.
        accounted_for: (D,) what is completed, or right by the hand and its joints: it explains no surprise.
        terms: names of the alarm terms that hold, the first gives the reason; empty for no alarm.
        contradiction: of hand and joints; None without one.
        completed: the sensors that are completed; None where senses cannot be completed.
        may_go_on: the policy has not gone on in alarm for too long yet.
    """

    index: int
    robot: Any
    rows: NDArray[np.float32]
    attribution: NDArray[np.float64]
    accounted_for: NDArray[np.bool_]
    terms: tuple[str, ...]
    contradiction: Contradiction | None
    completed: tuple[str, ...] | None
    may_go_on: bool

    @property
    def alarm(self) -> bool:
        """Whether the row is an alarm, for whatever reason."""
        return bool(self.terms)

    @property
    def feels(self) -> bool:
        """Whether something would say if the arm pressed."""
        return bool(np.isfinite(self.robot.load) or np.isfinite(self.robot.contact_force))

    @property
    def fast(self) -> bool:
        """Whether the hand is faster than any healthy one."""
        return bool(self.robot.hand_speed > FASTEST_HEALTHY)

    @property
    def certain(self) -> bool:
        """Whether the row is an alarm whatever its surprise."""
        return bool(self.contradiction is not None or self.robot.failed or self.robot.presses)

    @property
    def only_lost(self) -> bool:
        """Whether nothing is wrong but missing numbers."""
        surprised = self.robot.over or self.robot.knocked
        return bool(self.robot.lost) and not (self.certain or surprised or self.fast)
