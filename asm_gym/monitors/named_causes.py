"""Causes in words: what a person knows of an alarm, and what to do about it.

frozen        a channel repeats its reading for longer than any learned
wrapped       one position is wrong by whole turns
offset        one channel alone is wrong, by the same amount all the time
another home  several positions are wrong, at places where no healthy episode was
standstill    nothing moves for longer than in any healthy episode
pace          the path is known, and passed faster or slower
payload       several torques are wrong, and keep it up; nothing else is
unexplained   none of these
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from asm_gym.data.column_names import TURN
from asm_gym.monitors.blame import Blame
from asm_gym.monitors.pace_memory import PaceMemory
from asm_gym.monitors.torque.arm_features import position_columns, torque_columns

Rows = NDArray[np.floating[Any]]  # (T, D)

FROZEN = "frozen"
WRAPPED = "wrapped"
OFFSET = "offset"
HOME = "another home"
PAYLOAD = "payload"
STANDSTILL = "standstill"
PACE = "pace"
UNEXPLAINED = "unexplained"

REMEDIES = {
    FROZEN: "check the sensor's cable and driver",
    WRAPPED: "count turns in the driver, or set `wrap` in the schema: asm-gym inspect --schema",
    OFFSET: "set the sensor's zero again, or acknowledge the new level",
    HOME: "home the arm again, or refit with episodes from this home: asm-gym fit",
    PAYLOAD: "tell the controller the payload, or refit with it: asm-gym fit",
    STANDSTILL: "see why the program waits, or refit with pauses: asm-gym fit",
    PACE: "set the speed override back, or refit with mixed speeds: asm-gym fit",
    UNEXPLAINED: "look at the channel, and at the rows around the alarm",
}
"""What to do about each cause."""

WORDS = {
    FROZEN: "{channel} is frozen",
    WRAPPED: "{channel} is wrapped by {size}",
    OFFSET: "{channel} is offset by {size}",
    HOME: "the arm has another home",
    PAYLOAD: "the hand carries another payload",
    STANDSTILL: "the arm stands still",
    PACE: "the pace is {size} of what was learned",
    UNEXPLAINED: "unexplained, in {channel}",
}
"""Each cause in a sentence."""

BEFORE_S = 1.0  # rows before an alarm that its cause is named by [s]
AFTER_S = 5.0  # rows from its first row on [s]
SHORTEST_S = 0.5  # least time after which any cause is named [s]
PACE_S = 3.0  # least time after which a pace is named [s]
SAMPLED = 40  # of these rows
CLEAR = 3.0  # least deviation, in standard deviations before the alarm
LOAD_CLEAR = 2.0  # of several torques, likewise
STEADY = 0.5  # most scatter of a steady deviation, in the deviation
WHOLE = 0.1  # most distance from a whole turn, in turns
FEWEST_TORQUES = 2  # that a payload changes
PACES = (0.85, 1.12)  # slowest and fastest healthy pace
MAD = 1.4826  # standard deviations in a median absolute deviation


class NamedCause(NamedTuple):
    """A cause in words."""

    name: str  # one of ``REMEDIES``
    column: int | None  # that it is of; None where it is of the whole robot
    size: float = np.nan  # of an offset [unit of the column], or the pace

    @property
    def remedy(self) -> str:
        """What to do about it."""
        return REMEDIES[self.name]

    def in_words(self, names: Sequence[str], units: Sequence[str] = ()) -> str:
        """Return the cause with its size, for columns with such names and units."""
        if self.column is None:
            return WORDS[self.name].format(channel="the whole robot", size=f"{self.size:.2f}")
        unit = ""
        if len(units) and units[self.column] != "1":
            unit = f" {units[self.column]}"
        size = f"{self.size:+.3g}{unit}"
        return WORDS[self.name].format(channel=names[self.column], size=size)


class CauseNamer:
    """Names the causes of alarms.

    Args:
        blame: of the memory that raised them.
        pace: how fast healthy motion is; None without positions, or in a file of an earlier release.
    """

    def __init__(self, blame: Blame, pace: PaceMemory | None) -> None:
        self._blame = blame
        self._pace = pace
        self._spec = blame.completion.spec
        self._positions = set(position_columns(self._spec).tolist())
        self._torques = torque_columns(self._spec).tolist()

    def __call__(self, rows: Rows, first: int, blamed: Sequence[int]) -> NamedCause:
        """Return the cause of an alarm.

        Args:
            rows: (T, D) from ``BEFORE_S`` before the alarm up to at most ``AFTER_S`` later, in order.
            first: index of the first row in alarm.
            blamed: columns that ``Blame`` returned for that row.
        """
        column = None
        if blamed:
            column = blamed[0]
        unexplained = NamedCause(UNEXPLAINED, column)
        since = rows[first:]
        if column is None or not np.isfinite(rows).all():
            return unexplained
        frozen = [c for c in self._blame.repeating(since) if c in blamed]
        if frozen:
            return NamedCause(FROZEN, frozen[0])
        if len(since) * self._spec.dt < SHORTEST_S:
            return unexplained
        return (
            self._of_one_channel(rows, first, blamed)
            or self._of_place(since)
            or self._of_pace(since)
            or self._of_load(rows, first, blamed)
            or unexplained
        )

    def _of_one_channel(self, rows: Rows, first: int, blamed: Sequence[int]) -> NamedCause | None:
        """Return a wrap or an offset of the one channel that explains the first row; None of several."""
        column = blamed[0]
        if len(blamed) > 1:
            return None
        size, scatter, before = self._level(rows, first, [column])
        clear = CLEAR * before[0]
        if abs(size[0]) < clear or scatter[0] > max(STEADY * abs(size[0]), 2 * before[0]):
            return None
        turn = TURN.get(self._spec.units[column], np.inf)
        turns = size[0] / turn
        if column in self._positions and round(turns) and abs(turns - round(turns)) < WHOLE:
            return NamedCause(WRAPPED, column, float(size[0]))
        return NamedCause(OFFSET, column, float(size[0]))

    def _of_place(self, since: Rows) -> NamedCause | None:
        """Return another home, where the rows are at places that are new; else None."""
        if self._pace is None or not self._pace.is_elsewhere(since):
            return None
        return NamedCause(HOME, None)

    def _of_load(self, rows: Rows, first: int, blamed: Sequence[int]) -> NamedCause | None:
        """Return a payload, where several torques are wrong for as long as the rows last; else None."""
        if not set(self._torques).intersection(blamed) or len(self._torques) < FEWEST_TORQUES:
            return None
        size, _, before = self._level(rows, first, self._torques)
        wrong = np.abs(size) > LOAD_CLEAR * before
        if wrong.sum() < FEWEST_TORQUES:
            return None
        return NamedCause(PAYLOAD, None)

    def _of_pace(self, since: Rows) -> NamedCause | None:
        """Return a standstill or another pace; None where neither is clear."""
        if self._pace is None:
            return None
        if self._pace.stands_still(since):
            return NamedCause(STANDSTILL, None)
        if len(since) * self._spec.dt < PACE_S:
            return None
        pace = self._pace.pace(since)
        if not PACES[0] <= pace <= PACES[1] and pace > 0.0:
            return NamedCause(PACE, None, pace)
        return None

    def _level(
        self, rows: Rows, first: int, columns: Sequence[int]
    ) -> tuple[NDArray[np.float64], ...]:
        """Return by how much columns (n,) are wrong since an alarm, the scatter of that, and the scatter before."""
        since = self._blame.deviations(rows[max(first - 1, 0) :], columns, SAMPLED)
        size = np.median(since, axis=0)
        scatter = MAD * np.median(np.abs(since - size), axis=0)
        if first < 2:
            return size, scatter, np.zeros(len(columns))
        earlier = self._blame.deviations(rows[:first], columns, SAMPLED)
        level = np.median(earlier, axis=0)
        before = MAD * np.median(np.abs(earlier - level), axis=0)
        return size - level, scatter, before
