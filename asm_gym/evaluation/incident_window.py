"""The rows around an incident, as CSV: five seconds before its first row and five after."""

from __future__ import annotations

import csv
import io
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from asm_gym.evaluation.tables import plain_cell
from asm_gym.monitors.expectation import Expectation

Floats = NDArray[np.floating[Any]]

BEFORE_S = 5.0  # before the first row of an incident [s]
AFTER_S = 5.0  # after it [s]


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
