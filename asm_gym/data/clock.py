"""The clock of a log: the columns of times, and how their cells become seconds.

number        seconds = number × unit; of a pair, the sum: whole seconds and nanoseconds
date          seconds since 1970, of text or of a date type
time of day   seconds since midnight, and a day more after each midnight
"""

from __future__ import annotations

import math
from collections.abc import Container, Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from datetime import UTC, datetime
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from asm_gym.data.column_names import LONGER
from asm_gym.data.table_layout import is_numeric

Floats = NDArray[np.float64]

NUMBER = "number"
DATE = "date"
TIME_OF_DAY = "time of day"
CLOCK_KINDS = (NUMBER, DATE, TIME_OF_DAY)

SINCE_1970 = 1e8  # a number of seconds from which on it counts from 1970: March 1973
UNITS_SINCE_1970 = ((1e17, 1e-9), (1e14, 1e-6), (1e11, 1e-3), (SINCE_1970, 1.0))
"""The unit [s] of a number since 1970, by the least such number."""
LATEST_DATE = 1e11  # stamps up to the year 5138 are dates [s]
DAY_S = 86400.0

# Orders in which pandas reads a date.
ISO = {"format": "ISO8601"}
DAY_FIRST = {"format": "mixed", "dayfirst": True}
MONTH_FIRST = {"format": "mixed", "dayfirst": False}
_TIME_OF_DAY = r"\d{1,2}:\d\d:\d\d([.,]\d+)?"


class Times(NamedTuple):
    """When the rows of a log were sensed."""

    origin: float  # to be added: the first stamp of a clock that counts from 1970, else 0 [s]
    seconds: Floats  # (T,) [s]


@dataclass(frozen=True)
class LogClock:
    """The columns of a log that say when a row was sensed.

    Args:
        columns: their names; two of them, seconds and a fraction, are added.
        units: seconds in a number of each.
        kind: what their cells hold, one of ``CLOCK_KINDS``.
        reason: why these columns are the clock.
    """

    columns: tuple[str, ...]
    units: tuple[float, ...] = (1.0,)
    kind: str = NUMBER
    reason: str = field(default="", compare=False)

    @property
    def name(self) -> str:
        """What the user calls it."""
        return " + ".join(self.columns)

    @property
    def unit_names(self) -> list[str]:
        """The names of ``units``, such as ``ms``."""
        names = {seconds: name for name, seconds in reversed(LONGER.items())}
        return [names.get(unit, f"{unit:g} s") for unit in self.units]

    def is_in(self, names: Container[str]) -> bool:
        """Return whether its columns are among those of a table."""
        return all(column in names for column in self.columns)

    def times(self, table: Mapping[str, NDArray[Any]]) -> Times:
        """Return the times of the rows of a table.

        Raises:
            ValueError: a cell is no time.
        """
        first = self.columns[0]
        if self.kind == DATE:
            return _since_first(_nanoseconds(first, table[first]), 1e-9, -math.inf)
        if self.kind == TIME_OF_DAY:
            return Times(0.0, _seconds_of_day(table[first]))

        parts = []
        for column, unit in zip(self.columns, self.units, strict=True):
            numbers = numbers_of(column, table[column])
            parts.append(_since_first(numbers, unit, SINCE_1970))
        origin = sum(part.origin for part in parts)
        return Times(origin, np.sum([part.seconds for part in parts], axis=0))

    def moment(self, row: Mapping[str, Any]) -> float | None:
        """Return the time of a row of a live source [s]; None if it has none.

        Raises:
            ValueError: a cell is no time.
        """
        cells: list[Any] = [row.get(column) for column in self.columns]
        if None in cells:
            return None
        if self.kind != NUMBER:
            return self._moment_of_text(str(cells[0]).strip())
        seconds = 0.0
        for cell, unit in zip(cells, self.units, strict=True):
            if cell == "":
                cell = math.nan
            seconds += float(cell) * unit
        return seconds

    def _moment_of_text(self, cell: str) -> float:
        """Return the time of a date or of a time of day [s]."""
        with suppress(ValueError):
            date = datetime.fromisoformat(cell)
            return date.replace(tzinfo=date.tzinfo or UTC).timestamp()
        times = self.times({self.columns[0]: np.array([cell], object)})
        return times.origin + float(times.seconds[0])


def numbers_of(column: str, values: NDArray[Any]) -> NDArray[Any]:
    """Return the numbers (T,) of a clock's column, NaN where a cell is empty.

    Raises:
        ValueError: a cell holds no number, or the column is no column.
    """
    import pandas as pd

    if values.ndim != 1 or not len(values):
        shape = values.shape
        raise ValueError(f"the clock {column!r} must hold a number a row, got the shape {shape}")
    if is_numeric(values):
        return values
    text = _text(values)
    numbers = pd.to_numeric(text, errors="coerce")
    _refuse_words(column, text, numbers)
    return np.asarray(numbers.to_numpy(np.float64, na_value=np.nan))


def kind_of(column: str, values: NDArray[Any]) -> str:
    """Return what the cells (T,) of a clock hold, one of ``CLOCK_KINDS``.

    Raises:
        ValueError: they hold no times.
    """
    import pandas as pd

    if values.dtype.kind == "M":
        return DATE
    if is_numeric(values):
        return NUMBER
    text = _text(values).dropna()
    numbers = pd.to_numeric(text, errors="coerce")
    if numbers.notna().all():
        return NUMBER
    if text.str.fullmatch(_TIME_OF_DAY).all():
        return TIME_OF_DAY
    _nanoseconds(column, values)
    return DATE


def _text(values: NDArray[Any]) -> Any:
    """Return cells as a series of text, missing where they are empty."""
    import pandas as pd

    return pd.Series(values).astype("string").str.strip().replace("", pd.NA)


def _refuse_words(column: str, text: Any, numbers: Any) -> None:
    """Raise ValueError if a cell of ``text`` became no number."""
    wrong = text[numbers.isna() & text.notna()]
    if len(wrong):
        example = str(wrong.iloc[0])[:40]
        raise ValueError(
            f"the clock {column!r} must hold a time, got {example!r}: "
            "--rate HZ reads the rows without it"
        )


def _since_first(numbers: NDArray[Any], unit: float, least: float) -> Times:
    """Return times since the first number: numbers since 1970 have more digits than a float.

    Args:
        numbers: (T,).
        unit: seconds in one.
        least: first time from which on it is the origin [s]; that of others is 0.
    """
    known = numbers[np.isfinite(numbers)]
    if not len(known):
        return Times(0.0, numbers * unit)
    first = known[0]
    origin = float(first) * unit
    if origin < least:
        return Times(0.0, numbers * unit)
    if numbers.dtype.kind in "biu":
        numbers = numbers.astype(np.int64)
    since_first = np.asarray(numbers - first, np.float64)
    return Times(origin, since_first * unit)


def _seconds_of_day(values: NDArray[Any]) -> Floats:
    """Return the seconds (T,) since the first midnight of times of day."""
    import pandas as pd

    text = _text(values).str.replace(",", ".", regex=False)
    durations = pd.to_timedelta(text)
    seconds = durations.dt.total_seconds().to_numpy(np.float64)
    steps = np.diff(seconds, prepend=seconds[:1])
    midnights = np.cumsum(steps < -DAY_S / 2)
    return np.asarray(seconds + DAY_S * midnights)


def _nanoseconds(column: str, values: NDArray[Any]) -> NDArray[Any]:
    """Return dates (T,) as nanoseconds since 1970, NaN where a cell is empty.

    11/05/2026 may begin with the day or the month: the order in which the whole takes less time is
    taken.

    Raises:
        ValueError: a cell is no date.
    """
    import pandas as pd

    if values.dtype.kind == "M":
        return values.astype("M8[ns]").astype(np.int64)
    text = _text(values)
    ends = text.dropna().iloc[[0, -1]]
    orders: list[dict[str, Any]] = [DAY_FIRST, MONTH_FIRST]
    orders.sort(key=lambda order: _span(ends, order))
    for order in (ISO, *orders):
        with suppress(ValueError, TypeError):
            dates = pd.to_datetime(text, utc=True, **order).dt.as_unit("ns")
            since = dates.astype(np.int64)
            if dates.isna().any():
                since = since.where(dates.notna())
            return np.asarray(since.to_numpy())
    _refuse_words(column, text, pd.to_numeric(text, errors="coerce"))
    raise ValueError(f"the clock {column!r} holds numbers and dates")


def _span(ends: Any, order: dict[str, Any]) -> float:
    """Return the time between two dates [s]; infinite if they are none, or in the wrong order."""
    import pandas as pd

    with suppress(ValueError, TypeError):
        first, last = pd.to_datetime(ends, utc=True, **order)
        if last >= first:
            return float((last - first).total_seconds())
    return np.inf


def unit_by_size(number: float) -> float | None:
    """Return the seconds in one number since 1970, by its size; None if it counts from elsewhere."""
    for least, unit in UNITS_SINCE_1970:
        if number >= least:
            return unit
    return None


def date_of(stamp: float) -> str:
    """Return a stamp since 1970 [s] as a date in ISO 8601; empty if it counts from elsewhere."""
    if not SINCE_1970 <= stamp < LATEST_DATE:
        return ""
    return datetime.fromtimestamp(stamp, UTC).isoformat(timespec="milliseconds")
