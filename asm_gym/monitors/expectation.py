"""What a channel should have read: its completion from all other senses, and level shifts that a person acknowledges.

    d_t = sensed_t - expected_t     shift = median d_t     steady: |shift| > 3 e, and the spread of d_t is < |shift|/2

e is the error of the completion in nominal rows. A level shift is subtracted from the rows that follow.
"""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from asm_gym.memory.completion import Completion, Filling
from asm_gym.spec import StreamSpec
from asm_gym.validation import short_repr

Numbers = NDArray[np.floating[Any]]
Floats = NDArray[np.float64]

LEVEL_SHIFTS = "level_shifts"  # key in ``about`` of a memory
LEAST_ERRORS = 3.0  # a shift is larger than so many errors of the completion
MOST_SPREAD = 0.5  # largest spread of a steady shift, as a share of it
FEWEST_ROWS = 3  # in which a shift must be seen


class Expected(NamedTuple):
    """A channel beside what the others say."""

    sensed: float  # [unit]
    expected: float  # [unit]
    plus_minus: float  # standard deviation of the expected value in nominal rows [unit]
    unit: str

    @property
    def sign(self) -> str:
        """Where the channel is: ``+`` above what is expected, ``-`` below; empty if unknown."""
        difference = self.sensed - self.expected
        if not math.isfinite(difference):
            return ""
        return "+" if difference > 0 else "-"

    def __str__(self) -> str:
        """Return it for a table."""
        expected = f"{self.expected:.4g} ± {self.plus_minus:.2g}"
        return f"{self.sensed:.4g}, expected {expected} {self.unit}".rstrip()

    def sentence(self, channel: str) -> str:
        """Return what the channel read and what was expected, as a sentence without a full stop."""
        read = f"{channel} read {self.sensed:.4g} {self.unit}".rstrip()
        expected = f"{self.expected:.4g} ± {self.plus_minus:.2g} {self.unit}".rstrip()
        return f"{read}; from the other senses {expected} was expected"


@dataclass(frozen=True)
class LevelShift:
    """A channel that was acknowledged to have another level."""

    channel: str
    shift: float  # what is subtracted [unit]
    unit: str
    date: str  # when it was acknowledged, ISO 8601; empty if unknown

    def __str__(self) -> str:
        return f"{self.channel} {self.shift:+.4g} {self.unit}".rstrip()


class Expectation:
    """Expect a channel from all others, by a monitor's completion.

    Args:
        monitor: one that completes senses; any other expects nothing.
    """

    def __init__(self, monitor: Any) -> None:
        self._spec: StreamSpec = monitor.spec
        diagnosis = getattr(monitor, "diagnosis_", None)
        self._completion: Completion | None = None
        if diagnosis is not None:
            self._completion = diagnosis.completion
        self._fillings: dict[int, Filling] = {}

    def of_rows(self, rows: Numbers, column: int | None) -> tuple[Floats, float] | None:
        """Return what a column should have read in rows (T, D), (T,), and its error; None where nothing tells."""
        completion = self._completion
        if completion is None or column is None or column in self._spec.motor or not len(rows):
            return None
        filling = self._filling(completion, column)
        place = int(np.flatnonzero(filling.columns == column)[0])
        values = completion.complete(filling, completion.lift(rows))
        return values[:, place], float(filling.error[place])

    def at_end(self, rows: Numbers, column: int | None) -> Expected | None:
        """Return a column of the last of rows (T, D) beside what is expected; None where nothing tells."""
        found = self.of_rows(rows[-2:], column)
        if found is None or column is None:
            return None
        values, error = found
        return Expected(
            sensed=float(rows[-1, column]),
            expected=float(values[-1]),
            plus_minus=error,
            unit=self.unit(column),
        )

    def unit(self, column: int) -> str:
        """Return the unit of a column; empty without one."""
        unit = self._spec.units[column]
        if unit == "1":
            return ""
        return unit

    def level_shift(self, rows: Numbers, column: int | None, date: str = "") -> LevelShift:
        """Return the level shift of a column in the last rows (T, D).

        Raises:
            ValueError: nothing tells what the column should read, or it is not steady.
        """
        if column is None:
            raise ValueError("a whole row is missing: there is no level to learn")
        label = self._spec.labels[column]
        found = self.of_rows(rows, column)
        if found is None:
            raise ValueError(f"no other sense tells what {label} should read")
        values, error = found
        deviation = np.asarray(rows[:, column], np.float64) - values
        deviation = deviation[np.isfinite(deviation)]
        if len(deviation) < FEWEST_ROWS:
            raise ValueError(f"{label} has too few rows to learn a level from: {len(deviation)}")
        shift = float(np.median(deviation))
        low, high = np.quantile(deviation, [0.1, 0.9])
        unit = self._spec.units[column]
        if abs(shift) <= LEAST_ERRORS * error or high - low > MOST_SPREAD * abs(shift):
            raise ValueError(
                f"{label} is not steady at another level: it is {shift:+.3g} {unit} from what is "
                f"expected, between {low:+.3g} and {high:+.3g}, with an error of {error:.2g}"
            )
        return LevelShift(channel=label, shift=shift, unit=unit, date=date)

    def _filling(self, completion: Completion, column: int) -> Filling:
        """Return how the sensor of a column is completed."""
        if column not in self._fillings:
            missing = np.zeros(self._spec.size, bool)
            for _, columns in completion.sensors:
                if column in columns:
                    missing[columns] = True
            self._fillings[column] = completion.filling(missing)
        return self._fillings[column]


def shifts_kept_in(about: dict[str, Any]) -> list[LevelShift]:
    """Return the level shifts that a memory keeps.

    Raises:
        ValueError: what it keeps are none.
    """
    kept = about.get(LEVEL_SHIFTS, [])
    try:
        shifts = [LevelShift(**each) for each in kept]
        finite = all(math.isfinite(shift.shift) for shift in shifts)
    except TypeError:
        finite = False
    if not finite:
        raise ValueError(f"level shifts of a memory are unreadable: {short_repr(kept)}")
    return shifts


def with_shifts(about: dict[str, Any], shifts: list[LevelShift]) -> dict[str, Any]:
    """Return what a memory keeps about itself, with these level shifts."""
    return {**about, LEVEL_SHIFTS: [asdict(shift) for shift in shifts]}


def shift_of_columns(spec: StreamSpec, shifts: list[LevelShift]) -> Floats:
    """Return what is subtracted from rows (D,).

    Raises:
        ValueError: a shift is of a channel that the stream does not have.
    """
    total = np.zeros(spec.size)
    for shift in shifts:
        if shift.channel not in spec.labels:
            raise ValueError(f"a level shift is of {shift.channel!r}, which the stream has not")
        total[spec.labels.index(shift.channel)] += shift.shift
    return total
