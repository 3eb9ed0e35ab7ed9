"""Which column of a log is its clock, and what that says in seconds.

    name      time, t, Timestamp (s), Time [sec], time_ms, __time, header.stamp, whatever the case
    numbers   in the unit behind the name; without one, large ones are seconds, milliseconds, micro- or nanoseconds
              since 1970, and others seconds
    text      ISO 8601, 2022-10-26T08:17:21.847Z

A clock is no sense: where there are several the first is read, and none is a channel.
"""

from __future__ import annotations

import re
from collections.abc import Iterable
from datetime import datetime
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

Column = NDArray[Any]

UNITS = {
    **dict.fromkeys(("s", "sec", "secs", "second", "seconds"), 1.0),
    **dict.fromkeys(("ms", "msec", "millis", "milliseconds"), 1e-3),
    **dict.fromkeys(("us", "µs", "usec", "micros", "microseconds"), 1e-6),
    **dict.fromkeys(("ns", "nsec", "nanos", "nanoseconds"), 1e-9),
}
"""Seconds in one."""

EPOCHS = ((1e17, 1e-9), (1e14, 1e-6), (1e11, 1e-3), (1e8, 1.0))
"""From which number on, and in which unit, a clock that says none counts from 1970: 1e8 s is March 1973."""

SLOWEST_UNTOLD = 2.0
"""A clock without a unit that goes on by so much from row to row is not believed to count seconds."""

_OF = r"(?:elapsed|rel|relative|ros|unix|epoch|sys|system|robot|controller|host|log|utc|sample|recording)"
_WHAT = r"(?:time[ _]?stamps?|time|stamp|date[ _]?time|date)"
_UNIT = "|".join(sorted(map(re.escape, UNITS), key=len, reverse=True))
_CLOCK = re.compile(
    rf"[%_#\s]*(?:(?:.*[./])?(?:header[._])?(?:{_OF}[ _]?)?{_WHAT}|t)(?:[ _.]*[\[(]?\s*(?P<unit>{_UNIT})\s*[\])]?)?",
    re.I,
)


class Clock(NamedTuple):
    """A column that says when rows were sensed.

    Attributes:
        column: what the table calls it.
        unit: seconds in one of its numbers; None where its name does not say.
    """

    column: str
    unit: float | None = None

    def seconds(self, values: Column) -> NDArray[np.float64]:
        """(T,), counted from the first row where it counts from 1970, which would cost digits.

        Raises:
            ValueError: it holds no times, or may count anything.
        """
        if values.dtype.kind == "M":
            return np.asarray((values - values[:1]) / np.timedelta64(1, "ns"), np.float64) * 1e-9
        if values.dtype.kind not in "biuf":
            return np.array([self.moment(str(cell)) for cell in values]) - self.moment(str(values[0]))
        if values.ndim != 1 or not len(values):
            raise ValueError(f"the clock {self.column!r} must hold a number a row, got the shape {values.shape}")
        known = values[np.isfinite(values)]
        unit = self.unit_of(float(known[0])) if len(known) else 1.0
        if self.unit is None and unit == 1.0 and len(known) > 2 and np.median(np.diff(known)) >= SLOWEST_UNTOLD:
            step = float(np.median(np.diff(known)))
            raise ValueError(
                f"{self.column!r} goes on by {step:g} from row to row, and says no unit: "
                f"call it '{self.column} [ms]' or '{self.column} [s]'"
            )
        if len(known) and float(known[0]) >= EPOCHS[-1][0]:
            whole = values.dtype.kind in "biu"
            return (
                np.asarray(values.astype(np.int64) - int(known[0]) if whole else values - known[0], np.float64) * unit
            )
        return values.astype(np.float64) * unit

    def unit_of(self, number: float) -> float:
        """Seconds in one of its numbers, of which this is one."""
        if self.unit is not None:
            return self.unit
        return next((unit for least, unit in EPOCHS if number >= least), 1.0)

    def moment(self, cell: str) -> float:
        """What a cell of text says [s], since 1970 or whatever it counts from. Raises ValueError where it says none."""
        try:
            number = float(cell or "nan")
        except ValueError:
            try:
                found = datetime.fromisoformat(cell.strip())
            except ValueError:
                raise ValueError(f"the clock {self.column!r} must hold a time, got {cell[:40]!r}") from None
            # Without a zone all rows are of the same one, and no hour is counted twice.
            return (found.replace(tzinfo=None) - datetime(1970, 1, 1)).total_seconds() - _offset(found)
        return number * self.unit_of(number)


def _offset(moment: datetime) -> float:
    """[s] that its zone is ahead by."""
    ahead = moment.utcoffset()
    return 0.0 if ahead is None else ahead.total_seconds()


def is_clock(name: str) -> bool:
    """Whether a column of that name says the time. A bare ``T`` is a temperature."""
    return name.strip() != "T" and _CLOCK.fullmatch(name.strip()) is not None


def clock_among(names: Iterable[str]) -> Clock | None:
    """The first of these that says the time, in the order of the table; None where none does."""
    for name in names:
        if is_clock(name):
            found = _CLOCK.fullmatch(name.strip())
            assert found is not None
            return Clock(name, UNITS[found["unit"].lower()] if found["unit"] else None)
    return None
