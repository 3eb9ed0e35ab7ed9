"""Where robots stay whose actions are not rest where they are zero: each where it was when its override began."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from asm_gym.data.action_meaning import ActionMeaning

Floats32 = NDArray[np.float32]


class Places:
    """The actions (n, A) for which n robots stay.

    Args:
        meaning: of their actions; None where ``rest`` is known to make them stay.
        rest: (A,) what is left to do where nothing else is known.
    """

    def __init__(self, count: int, meaning: ActionMeaning | None, rest: Floats32) -> None:
        self._meaning, self._rest = meaning, rest
        self._executed = np.tile(rest, (count, 1))  # (n, A) last
        self._actions = np.full((count, rest.size), np.nan, np.float32)
        self._rows: NDArray[np.float32] = np.zeros((count, 0), np.float32)  # (n, D) newest that were finite

    def begin(self, which: NDArray[np.bool_]) -> None:
        """New episodes of the robots of ``which`` (n,)."""
        self._executed[which], self._actions[which], self._rows[which] = self._rest, np.nan, np.nan

    def sense(self, rows: Floats32) -> None:
        """Take in the newest rows (n, D)."""
        if self._meaning is not None:
            self._rows = np.where(np.isfinite(rows), rows, self._rows if self._rows.size else np.float32(np.nan))

    def start(self, robot: int, executed: Floats32) -> None:
        """An override begins, after the robot has ``executed`` (A,)."""
        self._executed[robot], self._actions[robot] = executed, np.nan

    def stay(self, robot: int) -> Floats32:
        """Return the action (A,) for which a robot stays; a number that is not known yet is that of ``rest``."""
        if self._meaning is None:
            return self._rest.copy()
        action = self._actions[robot]
        if not np.isfinite(action).all() and self._rows.size:
            found = self._meaning.staying(self._rows[robot], self._executed[robot])
            action[:] = np.where(np.isfinite(action), action, found)
        stay: Floats32 = np.where(np.isfinite(action), action, self._rest)
        return stay
