"""Level shifts that a person has acknowledged: subtracted from the rows of a robot before they are judged.

They end with the run, unless they are saved with the memory.
"""

from __future__ import annotations

import copy
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from asm_gym.detection.alarm_rule import rows_of_a_minute
from asm_gym.guard.robot_table import Floats32
from asm_gym.monitors.expectation import (
    Expectation,
    LevelShift,
    shift_of_columns,
    shifts_kept_in,
    with_shifts,
)
from asm_gym.spec import StreamSpec

NEVER = -1


class Acknowledgements:
    """Keep the level shifts of n robots, and which channel the newest alarm of each points to.

    Args:
        monitor: whose memory may keep level shifts already.
        spec: the stream.
        count: n.
    """

    def __init__(self, monitor: Any, spec: StreamSpec, count: int) -> None:
        self._monitor = monitor
        self._spec = spec
        self._expectation: Expectation | None = None  # made when it is needed first
        kept = shifts_kept_in(getattr(monitor, "about", {}))
        self.shifts: list[list[LevelShift]] = [list(kept) for _ in range(count)]
        self._offset = np.tile(shift_of_columns(spec, kept), (count, 1))  # (n, D)
        self._is_shifted = bool(self._offset.any())
        self._row = 0
        self._alarm_row = np.full(count, NEVER)  # of the newest alarm
        self._column = np.full(count, NEVER)  # that it points to

    def recentre(self, rows: Floats32) -> None:
        """Subtract the level shifts from rows (n, D), in place."""
        self._row += 1
        if self._is_shifted:
            rows -= self._offset.astype(np.float32)

    def recentred(self, robot: int, row: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return a row (D,) of a robot without its level shifts."""
        return row - self._offset[robot]

    def note_alarms(self, over: NDArray[np.bool_], attribution: NDArray[np.float64]) -> None:
        """Note which robots (n,) are in alarm, and the shares (n, D) of their channels."""
        self._alarm_row[over] = self._row
        self._column[over] = attribution[over].argmax(axis=1)

    def begin(self, which: NDArray[np.bool_]) -> None:
        """Begin new episodes of the robots of ``which`` (n,): no incident is open, and level shifts stay."""
        self._alarm_row[which] = NEVER

    def acknowledge(self, robot: int, rows: Floats32, column: int | None = None) -> LevelShift:
        """Learn the level shift of a channel.

        Args:
            robot: its number.
            rows: (T, D) its last rows.
            column: of the channel; by default that of the open incident.

        Raises:
            ValueError: no incident is open, or the channel is not steady at another level.
        """
        if column is None:
            column = self._column_in_alarm(robot)
        if self._expectation is None:
            self._expectation = Expectation(self._monitor)
        date = datetime.now(UTC).isoformat(timespec="seconds")
        shift = self._expectation.level_shift(rows, column, date)
        self.shifts[robot].append(shift)
        self._offset[robot, column] += shift.shift
        self._is_shifted = True
        self._alarm_row[robot] = NEVER
        return shift

    def save(self, path: str | Path, robot: int) -> None:
        """Write the memory with the level shifts of a robot in a note."""
        kept = copy.copy(self._monitor)
        kept.about = with_shifts(self._monitor.about, self.shifts[robot])
        kept.save(path)

    def _column_in_alarm(self, robot: int) -> int:
        """Return the column of the open incident of a robot. Raises ValueError where there is none."""
        since = self._row - self._alarm_row[robot]
        if self._alarm_row[robot] == NEVER or since > rows_of_a_minute(self._spec.dt):
            raise ValueError("no incident is open: there is nothing to acknowledge")
        return int(self._column[robot])
