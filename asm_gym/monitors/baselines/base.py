"""What baselines share: how rows are standardised and remembered."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from asm_gym.detection.base import Arrays
from asm_gym.memory.state import newest, past
from asm_gym.scaling import ScaledRows, StreamScaler
from asm_gym.spec import StreamSpec


class Standard(NamedTuple):
    """Senses in standard deviations from their mean."""

    sensory: NDArray[np.intp]  # (X,) columns
    mean: NDArray[np.float64]  # (X,)
    spread: NDArray[np.float64]  # (X,)

    @classmethod
    def fit(cls, spec: StreamSpec, streams: Sequence[NDArray[np.float32]]) -> Self:
        rows = np.concatenate(streams)[:, spec.sensory].astype(np.float64)
        return cls(spec.sensory, rows.mean(axis=0), np.maximum(rows.std(axis=0), 1e-6))

    @classmethod
    def of(cls, spec: StreamSpec, learned: Arrays) -> Self:
        """As ``arrays`` says."""
        return cls(spec.sensory, learned["mean"], learned["spread"])

    @property
    def arrays(self) -> dict[str, NDArray[Any]]:
        return {"mean": self.mean, "spread": self.spread}

    def __call__(self, rows: NDArray[np.float64]) -> NDArray[np.float64]:
        """(B, X) of rows (B, D)."""
        return (rows[:, self.sensory] - self.mean) / self.spread


class Rows(NamedTuple):
    """The rows a baseline remembers, one a stream."""

    before: NDArray[np.float64]  # (B, D) the row seen last; what was not finite in it is as it was before
    steps: NDArray[np.int64]  # (B,) how many were seen

    def then(self, rows: NDArray[np.float64]) -> Rows:
        """With the next rows (B, D)."""
        return Rows(np.where(np.isfinite(rows), rows, self.before), self.steps + 1)


def no_rows(batch: int, size: int) -> Rows:
    """Nothing seen yet."""
    return Rows(np.zeros((batch, size)), np.zeros(batch, np.int64))


def read(senses: StreamScaler, seen: Rows, rows: NDArray[np.float64]) -> ScaledRows:
    """The next rows, as the Neural ASM reads them; before the first nothing has moved."""
    before = np.where(seen.steps[:, None] > 0, seen.before, rows)
    return senses.read(rows, before, before)


class Lagged(NamedTuple):
    """The rows that the next ones are compared with, as the memory's association does; l is the scaler's lag."""

    before: NDArray[np.float64]  # (B, l, D) the rows seen last, the oldest first
    earlier: NDArray[np.float64]  # (B, l, D) those before
    steps: NDArray[np.int64]  # (B,) how many were seen


def nothing_before(batch: int, lag: int, size: int) -> Lagged:
    """Before the first row."""
    rows = np.zeros((batch, lag, size))
    return Lagged(rows, rows, np.zeros(batch, np.int64))


def associated(
    senses: StreamScaler, seen: Lagged, rows: NDArray[np.float64]
) -> tuple[Lagged, ScaledRows, NDArray[np.float32]]:
    """The next rows read, and 1 (B, 1) where all is known that a change is expected from, else 0."""
    before, earlier = past(seen, rows)
    reading = senses.read(rows, before, earlier)
    known = (reading.whole * (seen.steps >= senses.lag)[:, None]).astype(np.float32)
    now = Lagged(newest(seen.before, rows), newest(seen.earlier, before), seen.steps + 1)
    return now, reading, known


def no_context(rows: NDArray[np.float64]) -> NDArray[np.float64]:
    """(B, 0), of a model that knows none."""
    return np.zeros((len(rows), 0))
