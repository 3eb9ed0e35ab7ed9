"""State that a memory carries from row to row.

Association compares each row with that of l rows before, so that l rows and those before them are kept; the temporal
network takes up every l-th row. l is 1 at a control rate (``scaling``).
"""

from __future__ import annotations

from typing import NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

Rows = NDArray[np.float64]

UNSURE = np.float32(0.1)  # weight of an error while only one earlier row is known, and with it no speed


class RowHistory(NamedTuple):
    """The rows that the next ones are compared with, one entry a stream; never changed in place."""

    before: Rows  # (B, l, D) the rows seen last, the oldest first
    earlier: Rows  # (B, l, D) those before
    steps: NDArray[np.int64]  # (B,) rows seen so far

    @classmethod
    def empty(cls, batch: int, lag: int, size: int) -> Self:
        """Return the history before the first row of ``size`` numbers."""
        rows = np.zeros((batch, lag, size))
        return cls(rows, rows, np.zeros(batch, np.int64))

    @property
    def lag(self) -> int:
        """l."""
        return self.before.shape[1]

    def past(self, rows: Rows) -> tuple[Rows, Rows]:
        """Return the rows l before ``rows`` (B, D), and as long before those; at first nothing moves."""
        before, earlier = self.before[:, 0], self.earlier[:, 0]
        if self.steps.min() < 2 * self.lag:
            before = np.where(self.steps[:, None] >= self.lag, before, rows)
            earlier = np.where(self.steps[:, None] >= 2 * self.lag, earlier, before)
        return before, earlier

    def followed_by(self, rows: Rows) -> RowHistory:
        """Return the history after the next rows (B, D)."""
        kept = (self.before, rows), (self.earlier, self.past(rows)[0])
        before, earlier = (np.concatenate([old[:, 1:], new[:, None]], axis=1) for old, new in kept)
        return RowHistory(before, earlier, self.steps + 1)


class MemoryState(NamedTuple):
    """State of the memory, one entry a stream; never changed in place."""

    traces: NDArray[np.float32]  # (B, I) c, of what was sensed and done; or the state z that settled on it
    expected: NDArray[np.float32]  # (B, H) f(μ), of the state that was expected then
    history: RowHistory
    skill: NDArray[np.float32]  # (B, K) L, evidence for each skill; K is 0 where none has a name
