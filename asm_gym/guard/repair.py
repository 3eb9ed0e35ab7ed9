"""Completes the senses of a robot that are missing or at fault, until they have been well for long enough.

A sense that is not believed has precision 0: it is completed from all others, the command and the past, and nothing is
surprised by it. One that was missing is believed again as soon as it says what is expected; one that was wrong, after a
second.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from asm_gym.detection.hand_speed import Floats
from asm_gym.guard.hand_check import HandCheck
from asm_gym.guard.robot_table import Mask
from asm_gym.memory.completion import Completion

WELL_AFTER_S = 1.0  # a sense is well again once it has said what was expected for so long [s]
WELL_WITHIN = 4.0  # standard deviations of the completion's own error that this may be off
UNTOLD = (
    0.5  # no other sense tells of one whose completion leaves more than this share of its spread
)
TRUST_S = (
    1.0  # how long a sense that no other sense tells of is completed, by its last good value [s]
)
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


@dataclass(eq=False)
class Repair:
    """Keeps the rows of one robot well, from the first row on in which a sense is not believed."""

    completion: Completion  # completes senses from others
    robot: int  # which of those that ``hands`` know
    before: Floats | None  # (D,) the row before, repaired; None where there is none
    read: Mask  # (D,) which columns the policy reads, of whose completion something depends
    # Tell of missing angles better than the memory, and which senses not to believe again yet.
    hands: Sequence[HandCheck]
    # Rows until the monitor has seen nothing but repaired rows of a sense that was found at fault.
    settling: int = 0
    _sensors: dict[str, MissingSensor] = field(default_factory=dict)
    _unchecked: int = 0  # rows in which something was completed that no other sense tells of

    def __post_init__(self) -> None:
        spec = self.completion.spec
        self._spec = spec
        # Rows in which changes are taken from what was not yet repaired.
        self._settle = 2 * self.completion.senses.lag + 1
        self.missing = np.zeros(spec.size, bool)  # which columns are completed
        # (D,) rows until its changes are those of the sense again
        self._returned = np.zeros(spec.size, np.int64)
        # (D,) the last row before something was missing
        self._good = self.completion.senses.mean if self.before is None else self.before
        self._raw = self._good  # (D,) the newest, as it was sensed

    @property
    def names(self) -> tuple[str, ...]:
        """The sensors that are completed."""
        return tuple(self._sensors)

    @property
    def trusted(self) -> bool:
        """False once a sense that no other tells of is missing for long, any for very long, or too many at a time."""
        if self.missing[self._spec.sensory].mean() > MOST_MISSING:
            return False
        oldest = max((sensor.age for sensor in self._sensors.values()), default=0)
        dt = self._spec.dt
        return self._unchecked <= round(TRUST_S / dt) and oldest <= round(LONGEST_S / dt)

    @property
    def over(self) -> bool:
        """There is nothing left to repair."""
        busy = self._sensors or self._returned.any() or self.settling
        return self.trusted and not busy

    @property
    def unjudged(self) -> Mask:
        """(D,) the numbers that surprise nobody: they are missing, or their changes are those from completed ones."""
        return self.missing | (self._returned > 0)

    def next(self, row: NDArray[np.float32]) -> NDArray[np.float32]:
        """Return the next row (D,) as it should be."""
        self._raw_before = self._raw
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
            self._believe_again(repaired)
        if not self.missing.any():
            self._good = self._raw
        self.before = repaired
        return repaired.astype(np.float32)

    def suspect(self, columns: NDArray[np.intp]) -> NDArray[np.float32] | None:
        """Return the last row (D,) with the sensors of ``columns`` completed too; None where that leaves nothing."""
        wanted = self.missing.copy()
        wanted[columns] = True
        if wanted[self._spec.sensory].all() or np.array_equal(wanted, self.missing):
            return None
        self._complete(wanted, silent=False)
        self.settling = self._settle
        self.before = self._repaired()
        return self.before.astype(np.float32)

    def _complete(
        self,
        columns: Mask,
        silent: bool,
    ) -> None:
        """Believe the sensors of ``columns`` (D,) no more."""
        # In an order that no hash decides, for reports are equal to the last bit.
        for name, own in self.completion.sensors:
            if columns[own].any():
                known = self._sensors.get(name, MissingSensor(silent))
                self._sensors[name] = MissingSensor(silent, age=known.age)
        self._choose_filling()

    def _choose_filling(self) -> None:
        """Take up which columns are missing, and how they are completed."""
        self.missing = np.zeros(self._spec.size, bool)
        for name, own in self.completion.sensors:
            self.missing[own] |= name in self._sensors
        self._filling = self.completion.filling(self.missing)
        spread = self.completion.senses.spread[self._filling.columns]
        self._untold = self._filling.error > UNTOLD * spread  # (M,)
        self._guessed = self._untold & self.read[self._filling.columns]  # (M,)

    def _repaired(self) -> Floats:
        """Return the newest row (D,) with what is missing completed."""
        if not self._sensors:
            return self._raw
        senses = self.completion.senses
        columns = self._filling.columns
        before = self._raw if self.before is None else self.before
        lifted = self.completion.lift(np.stack([before, self._raw]))
        value = self.completion.complete(self._filling, lifted)[-1]
        value = np.where(self._guessed, self._good[columns], value)
        mean = senses.mean[columns]
        farthest = FARTHEST * senses.spread[columns]
        repaired = self._raw.copy()
        repaired[columns] = np.clip(value, mean - farthest, mean + farthest)
        error = self.completion.error * senses.spread
        for hand in self.hands:
            repaired = hand.refine(self.robot, repaired, self.missing, error)
        return repaired

    def _believe_again(self, repaired: Floats) -> None:
        """Count for how long each missing sensor has been well, and believe those that have been for long enough."""
        self._unchecked = self._unchecked + 1 if self._guessed.any() else 0
        fine, there = self._as_expected(repaired)
        well_after = max(1, round(WELL_AFTER_S / self._spec.dt))
        well = []
        for name, columns in self.completion.sensors:
            if name not in self._sensors:
                continue
            sensor = self._sensors[name]
            own = np.isin(self._filling.columns, columns)
            sensor.well = sensor.well + 1 if fine[own].all() else 0
            speaks = sensor.silent and there[own].all()
            if sensor.well >= well_after or speaks:
                del self._sensors[name]
                well.append(columns)
        if well:
            believed = np.concatenate(well)
            self._returned[believed] = self._settle
            repaired[believed] = self._raw[believed]
            self._choose_filling()

    def _as_expected(self, repaired: Floats) -> tuple[Mask, Mask]:
        """Return (M,) which missing numbers say what others tell of them, and which at least say something likely."""
        columns = self._filling.columns
        raw = self._raw[columns]
        # False for what is not finite
        close = np.abs(raw - repaired[columns]) <= WELL_WITHIN * self._filling.error
        for hand in self.hands:
            close &= ~hand.accused(self.robot)[columns]
        repeats = (raw == self._raw_before[columns]) & (self._spec.noise[columns] > 0)
        fine = close & ~repeats & ~self._untold
        there = np.isfinite(raw) & (close | self._untold)
        return fine, there
