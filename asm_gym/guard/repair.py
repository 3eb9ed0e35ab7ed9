"""Completes the senses of a robot that are missing or at fault, until they have been well for long enough.

A sense that is not believed has precision 0: it is completed from all others, the command and the past, and nothing is
surprised by it. One that was missing is believed again as soon as it says what is expected; one that was wrong, after a
second.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from asm_gym.guard.hand import HandAgainstJoints
from asm_gym.memory.completion import Completion, Filling

WELL_AFTER_S = 1.0  # a sense is well again once it has said what was expected for so long [s]
WELL_WITHIN = 4.0  # standard deviations of the completion's own error that this may be off
UNTOLD = 0.5  # no other sense tells of one whose completion leaves more than this share of its spread
TRUST_S = 1.0  # how long a sense that no other sense tells of is completed, by its last good value [s]
LONGEST_S = 20.0  # no sense is completed for longer than this [s]
MOST_MISSING = 0.5  # where more than this share of the senses is missing, what is left tells too little of them
FARTHEST = 6.0  # no completed number goes further than so many of its spreads from its mean

Floats = NDArray[np.float64]
Mask = NDArray[np.bool_]


class Repair:
    """Keeps the rows of one robot well, from the first row on in which a sense is not believed.

    Args:
        robot: which of those that ``hands`` know.
        before: (D,) the row before; None where there is none.
        read: (D,) which columns the policy reads, of whose completion something depends.
        hands: tell of missing angles better than the memory, and which senses are not to be believed again yet.
    """

    def __init__(
        self,
        completion: Completion,
        robot: int,
        before: NDArray[np.floating[Any]] | None,
        read: Mask,
        hands: Sequence[HandAgainstJoints] = (),
    ) -> None:
        self._completion, self._robot, self._hands, self._read = completion, robot, hands, read
        spec = self._spec = completion.spec
        self._patience, self._longest = round(TRUST_S / spec.dt), round(LONGEST_S / spec.dt)
        self._well_after = max(1, round(WELL_AFTER_S / spec.dt))
        self._settle = 2 * completion.senses.lag + 1  # rows in which changes are taken from what was not yet repaired
        self.missing = np.zeros(spec.size, bool)  # (D,) which columns are completed
        self.settling = 0
        """Rows until the monitor has seen nothing but repaired rows of a sense that was found at fault."""
        self._returned = np.zeros(spec.size, np.int64)  # (D,) rows until its changes are those of the sense again
        self._lost: set[str] = set()  # of the missing, which said nothing, and are believed when they do
        self._age: dict[str, int] = {}  # rows for which each has been missing
        self._well: dict[str, int] = {}  # rows in which each missing sensor has said what was expected
        self._unchecked = 0  # rows in which something was completed that no other sense tells of
        self._before: Floats | None = None if before is None else np.array(before, np.float64)  # (D,) repaired
        self._good = self._before  # (D,) the last row before something was missing
        self._raw = self._earlier = np.zeros(spec.size) if self._before is None else self._before

    @property
    def names(self) -> tuple[str, ...]:
        """The sensors that are completed."""
        return tuple(self._well)

    @property
    def trusted(self) -> bool:
        """False once a sense that no other tells of is missing for long, any for very long, or too many at a time."""
        sensory = self._spec.sensory
        few = self.missing[sensory].mean() <= MOST_MISSING if len(sensory) else True
        return bool(few and self._unchecked <= self._patience and max(self._age.values(), default=0) <= self._longest)

    @property
    def over(self) -> bool:
        """There is nothing left to repair."""
        return not (self._well or self._returned.any() or self.settling) and self.trusted

    @property
    def unjudged(self) -> Mask:
        """(D,) the numbers that surprise nobody: they are missing, or their changes are those from completed ones."""
        return self.missing | (self._returned > 0)

    def next(self, row: NDArray[np.floating[Any]]) -> NDArray[np.float32]:
        """Return the next row (D,) as it should be."""
        self._earlier, self._raw = self._raw, np.array(row, np.float64)
        self.settling = max(0, self.settling - 1)
        self._returned = np.maximum(self._returned - 1, 0)
        self._age = {name: self._age.get(name, 0) + 1 for name in self._well}
        lost = ~np.isfinite(self._raw) & ~self.missing
        lost[self._spec.motor] = False
        if lost.any() and not lost[self._spec.sensory].all():
            self._lost |= self._doubt(lost)
        repaired = self._repaired()
        if self._well:
            self._judge(repaired)
        if not self.missing.any():
            self._good = self._raw
        self._before = repaired
        return repaired.astype(np.float32)

    def suspect(self, columns: NDArray[np.intp]) -> NDArray[np.float32] | None:
        """Return the last row (D,) with the sensors of ``columns`` completed too; None where that leaves nothing."""
        wanted = self.missing.copy()
        wanted[columns] = True
        if wanted[self._spec.sensory].all() or not (wanted & ~self.missing).any():
            return None
        self._lost -= self._doubt(wanted)
        self.settling = self._settle
        self._before = repaired = self._repaired()
        return repaired.astype(np.float32)

    def _doubt(self, columns: Mask) -> set[str]:
        """Believe the sensors of ``columns`` (D,) no more; return which those are."""
        names = [name for name, own in self._completion.sensors if columns[own].any()]
        self._well |= dict.fromkeys(names, 0)  # in an order that no hash decides, for reports are to the last bit
        self._choose()
        return set(names)

    def _choose(self) -> None:
        """Take up which sensors are missing."""
        self.missing = np.zeros(self._spec.size, bool)
        for name, own in self._completion.sensors:
            self.missing[own] |= name in self._well
        self._filling: Filling = self._completion.filling(self.missing)
        spread = self._completion.senses.spread[self._filling.columns]
        self._untold = self._filling.error > UNTOLD * spread  # (M,)
        self._guessed = self._untold & self._read[self._filling.columns]  # (M,)

    def _repaired(self) -> Floats:
        if not self._well:
            return self._raw
        repaired, columns = self._raw.copy(), self._filling.columns
        before = self._raw if self._before is None else self._before
        value = self._completion.complete(self._filling, self._completion.lift(np.stack([before, self._raw])))[-1]
        if self._guessed.any():
            last = self._completion.senses.mean if self._good is None else self._good
            value = np.where(self._guessed, last[columns], value)
        mean, spread = self._completion.senses.mean[columns], self._completion.senses.spread[columns]
        repaired[columns] = np.clip(value, mean - FARTHEST * spread, mean + FARTHEST * spread)
        error = self._completion.error * self._completion.senses.spread
        for hand in self._hands:
            repaired = hand.refined(self._robot, repaired, self.missing, error)
        return repaired

    def _judge(self, repaired: Floats) -> None:
        """Count for how long each missing sensor has been well, and believe those that have been for long enough."""
        columns, raw, before = self._filling.columns, self._raw[self._filling.columns], self.names
        self._unchecked = self._unchecked + 1 if self._guessed.any() else 0
        close = np.abs(raw - repaired[columns]) <= WELL_WITHIN * self._filling.error  # False for what is not finite
        for hand in self._hands:
            close &= ~hand.accused(self._robot)[columns]
        repeats = (raw == self._earlier[columns]) & (self._spec.noise[columns] > 0)
        fine, there = np.zeros((2, self._spec.size), bool)
        fine[columns] = close & ~repeats & ~self._untold
        there[columns] = np.isfinite(raw) & (close | self._untold)
        for name, own in self._completion.sensors:
            if name not in self._well:
                continue
            self._well[name] = self._well[name] + 1 if fine[own].all() else 0
            if self._well[name] >= self._well_after or (name in self._lost and there[own].all()):
                del self._well[name]
                self._age.pop(name, None)
                self._lost.discard(name)
                self._returned[own] = self._settle
                repaired[own] = self._raw[own]
        if self.names != before:
            self._choose()
