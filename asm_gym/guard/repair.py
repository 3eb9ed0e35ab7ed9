"""Completes the senses of a robot that are missing or at fault, until they have been well for long enough.

A sense that is not believed has precision 0: it is completed from all others, the command and the past, and nothing is
surprised by it. One that was missing is believed again as soon as it says what is expected; one that was wrong, after a
second.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from asm_gym.detection.channel_columns import handled_columns
from asm_gym.detection.hand_speed import Floats
from asm_gym.guard.hand_check import HandCheck
from asm_gym.guard.robot_facts import NO_COLUMNS
from asm_gym.guard.robot_table import Floats32, Mask
from asm_gym.memory.completion import Completion

WELL_AFTER_S = 1.0  # a sense is well again once it has said what was expected for so long [s]
WELL_WITHIN = 4.0  # standard deviations of the completion's own error that this may be off
# No other sense tells of one whose completion leaves more than this share of its spread.
UNTOLD = 0.5
# For so long a sense that no other sense tells of is completed, by its last good value [s].
TRUST_S = 1.0
LONGEST_S = 20.0  # no sense is completed for longer than this [s]
# Where more than this share of the senses is missing, what is left tells too little of them.
MOST_MISSING = 0.5
FARTHEST = 6.0  # no completed number goes further than so many of its spreads from its mean


@dataclass
class MissingSensor:
    """A sensor that is completed."""

    silent: bool  # it says nothing: it is believed as soon as it says what is expected
    age: int = 0  # rows for which it has been missing
    well: int = 0  # rows, one after the other, in which it has said what was expected


class Repair:
    """Keeps the rows of one robot well, from the first row on in which a sense is not believed.

    Args:
        completion: completes senses from others.
        robot: its index in ``hands``.
        before: (D,) the row before, repaired; None where there is none.
        observed: (D,) which columns the policy reads, of whose completion something depends.
        hands: tell of missing angles better than the memory, and which senses not to believe again yet.

    Attributes:
        missing: (D,) which columns are completed.
        settling: rows until the monitor has seen nothing but repaired rows of a sense that was found at fault.
    """

    def __init__(
        self,
        completion: Completion,
        robot: int,
        before: Floats | None,
        observed: Mask,
        hands: Sequence[HandCheck],
    ) -> None:
        self._completion = completion
        self._robot = robot
        self._observed = observed
        self._hands = hands
        self._spec = completion.spec
        self._senses = completion.senses
        # The robot goes on without sensors that tell of no part of itself.
        handled = handled_columns(completion.spec)
        self._of_robot = np.setdiff1d(self._spec.sensory, handled)
        self._of_objects = {
            name for name, columns in completion.sensors if np.isin(columns, handled).all()
        }
        # Rows in which changes are taken from what was not yet repaired.
        self._settling_rows = 2 * completion.senses.lag + 1
        self._sensors: dict[str, MissingSensor] = {}
        self.missing = np.zeros(self._spec.size, bool)
        self.settling = 0
        # (D,) rows until its changes are those of the sense again
        self._returned = np.zeros(self._spec.size, np.int64)
        self._unchecked = 0  # rows in which something was completed that no other sense tells of
        self._before = before  # (D,) the row before, repaired
        self._raw = before if before is not None else self._senses.mean  # (D,) newest, as sensed
        self._good = self._raw  # (D,) the last row before something was missing

    @property
    def names(self) -> tuple[str, ...]:
        """The sensors that are completed."""
        return tuple(self._sensors)

    @property
    def trusted(self) -> bool:
        """False once a sense that no other tells of is missing for long, any for very long, or too many at a time."""
        if self.missing[self._of_robot].mean() > MOST_MISSING:
            return False
        ages = [s.age for name, s in self._sensors.items() if name not in self._of_objects]
        oldest = max(ages, default=0)
        return self._unchecked <= self._rows_in(TRUST_S) and oldest <= self._rows_in(LONGEST_S)

    @property
    def finished(self) -> bool:
        """Whether there is nothing left to repair."""
        busy = self._sensors or self._returned.any() or self.settling
        return self.trusted and not busy

    @property
    def unjudged(self) -> Mask:
        """(D,) the numbers that surprise nobody: they are missing, or their changes are those from completed ones."""
        return self.missing | (self._returned > 0)

    def next(self, row: Floats32) -> Floats32:
        """Return the next row (D,) as it should be."""
        raw_before = self._raw
        self._raw = row.astype(np.float64)
        self.settling = max(0, self.settling - 1)
        self._returned = np.maximum(self._returned - 1, 0)
        for sensor in self._sensors.values():
            sensor.age += 1

        silent = ~np.isfinite(self._raw) & ~self.missing
        sensed = silent[self._spec.sensory]
        if sensed.any() and not sensed.all():
            self._complete(silent, silent=True)
        repaired = self._repaired()
        if self._sensors:
            self._believe_again(repaired, raw_before)
        if not self.missing.any():
            self._good = self._raw
        self._before = repaired
        return repaired.astype(np.float32)

    def suspect(self, columns: NDArray[np.intp]) -> Floats32 | None:
        """Return the last row (D,) with the sensors of ``columns`` completed too; None where that leaves nothing."""
        wanted = self.missing.copy()
        wanted[columns] = True
        if wanted[self._spec.sensory].all() or np.array_equal(wanted, self.missing):
            return None
        self._complete(wanted, silent=False)
        self.settling = self._settling_rows
        self._before = self._repaired()
        return self._before.astype(np.float32)

    def _rows_in(self, seconds: float) -> int:
        """Return how many rows a time [s] takes."""
        return round(seconds / self._spec.dt)

    def _complete(self, columns: Mask, silent: bool) -> None:
        """Believe the sensors of ``columns`` (D,) no more."""
        # In an order that no hash decides, for reports are equal to the last bit.
        for name, own in self._completion.sensors:
            if columns[own].any():
                known = self._sensors.get(name, MissingSensor(silent))
                self._sensors[name] = MissingSensor(silent, age=known.age)
        self._choose_filling()

    def _choose_filling(self) -> None:
        """Take up which columns are missing, and how they are completed."""
        self.missing = np.zeros(self._spec.size, bool)
        for name, own in self._completion.sensors:
            self.missing[own] |= name in self._sensors
        self._filling = self._completion.filling(self.missing)
        columns = self._filling.columns  # (M,) that are missing
        self._untold = self._filling.error > UNTOLD * self._senses.spread[columns]  # (M,)
        self._guessed = self._untold & self._observed[columns]  # (M,)

    def _repaired(self) -> Floats:
        """Return the newest row (D,) with what is missing completed."""
        if not self._sensors:
            return self._raw
        before = self._before
        if before is None:
            before = self._raw
        columns = self._filling.columns
        lifted = self._completion.lift(np.stack([before, self._raw]))
        completed = self._completion.complete(self._filling, lifted)[-1]
        completed = np.where(self._guessed, self._good[columns], completed)
        mean = self._senses.mean[columns]
        farthest = FARTHEST * self._senses.spread[columns]
        repaired = self._raw.copy()
        repaired[columns] = np.clip(completed, mean - farthest, mean + farthest)
        error = self._completion.error * self._senses.spread
        for hand in self._hands:
            repaired = hand.refine(self._robot, repaired, self.missing, error)
        return repaired

    def _believe_again(self, repaired: Floats, raw_before: Floats) -> None:
        """Count for how long each missing sensor has been well, and believe those that have been for long enough.

        Args:
            repaired: (D,) the newest row; the sensors that are believed again are written to it.
            raw_before: (D,) the row before, as it was sensed.
        """
        self._unchecked += 1
        if not self._guessed.any():
            self._unchecked = 0
        fine, likely = self._as_expected(repaired, raw_before)
        well_after = max(1, self._rows_in(WELL_AFTER_S))
        well = [NO_COLUMNS]
        for name, columns in self._completion.sensors:
            if name not in self._sensors:
                continue
            sensor = self._sensors[name]
            own = np.isin(self._filling.columns, columns)
            sensor.well += 1
            if not fine[own].all():
                sensor.well = 0
            speaks_again = sensor.silent and likely[own].all()
            if sensor.well >= well_after or speaks_again:
                del self._sensors[name]
                well.append(columns)
        believed = np.concatenate(well)
        if believed.size:
            self._returned[believed] = self._settling_rows
            repaired[believed] = self._raw[believed]
            self._choose_filling()

    def _as_expected(self, repaired: Floats, raw_before: Floats) -> tuple[Mask, Mask]:
        """Return (M,) which missing numbers say what others tell of them, and which at least say something likely."""
        columns = self._filling.columns
        raw = self._raw[columns]
        # False for what is not finite
        close = np.abs(raw - repaired[columns]) <= WELL_WITHIN * self._filling.error
        for hand in self._hands:
            close &= ~hand.accused(self._robot)[columns]
        repeats = (raw == raw_before[columns]) & (self._spec.noise[columns] > 0)
        fine = close & ~repeats & ~self._untold
        likely = np.isfinite(raw) & (close | self._untold)
        return fine, likely
