"""The rows around an incident: five seconds before its first row and five after as CSV, one second for a figure."""

from __future__ import annotations

import csv
import io
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from asm_gym.evaluation.tables import plain_cell
from asm_gym.monitors.expectation import Expectation

Floats = NDArray[np.floating[Any]]

BEFORE_S = 5.0  # before the first row of an incident [s]
AFTER_S = 5.0  # after it [s]
MOMENT_S = 0.5  # before and after it, in a figure [s]
FEWEST_AROUND = 5.0  # rows before and after it, however slow they come


class AlarmMoment(NamedTuple):
    """The channel of an alarm in the second around its first row."""

    times: Floats  # (T,) from that row [s]
    sensed: Floats  # (T,) [unit]
    expected: Floats  # (T,) from the other senses; NaN where nothing tells [unit]
    plus_minus: float  # standard deviation of what is expected [unit]
    unit: str  # empty without one


@dataclass(frozen=True, eq=False)
class IncidentWindow:
    """The rows around an incident."""

    # (T,) stamps of the rows by their own clock; without one, the ends of their steps [s]
    times: Sequence[float]
    rows: Floats  # (T, D) as they were sensed
    surprise: Sequence[float]  # (T,) in thresholds
    labels: Sequence[str]  # (D,)
    column: int | None  # that the incident points to

    def to_csv(self, expectation: Expectation) -> str:
        """Return a table of a line a row; the incident's channel comes with what was expected, where that is known."""
        headings = ["time [s]", "surprise [thresholds]", *self.labels]
        table: list[list[Any]] = []
        for time, surprise, row in zip(self.times, self.surprise, self.rows, strict=True):
            cells = [f"{value:.7g}" for value in row]
            table.append([f"{time:.6f}", f"{surprise:.4g}", *cells])

        found = expectation.of_rows(self.rows, self.column)
        if found is not None and self.column is not None:
            values, error = found
            label = self.labels[self.column]
            headings += [f"expected {label}", f"± {label}"]
            for line, value in zip(table, values, strict=True):
                line += [f"{value:.7g}", f"{error:.3g}"]
        text = io.StringIO(newline="")
        csv.writer(text).writerows([map(plain_cell, headings), *table])
        return text.getvalue()

    def moment(self, start: float, expectation: Expectation) -> AlarmMoment | None:
        """Return the incident's channel around its first row, at ``start`` [s]; None where it points to none."""
        if self.column is None:
            return None
        times = np.array(self.times) - start
        period = float(np.diff(times).mean()) if len(times) > 1 else 0.0
        near = np.abs(times) <= max(MOMENT_S, FEWEST_AROUND * period)
        found = expectation.of_rows(self.rows, self.column)
        if found is None:
            found = np.full(len(times), np.nan), np.nan
        values, error = found
        return AlarmMoment(
            times=times[near],
            sensed=self.rows[near, self.column],
            expected=values[near],
            plus_minus=error,
            unit=expectation.unit(self.column),
        )
