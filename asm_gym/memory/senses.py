r"""What of a stream row the memory senses: every channel's value and, of the slow ones, their change as well.

A joint moves a few hundredths of its range in a step, so the best prediction of its position is the last one, plus a
little. Of such a channel the memory predicts both the value, which says where in a skill it is, and the change, which
says what is happening now (generalised coordinates of motion: Friston 2008, PLOS Comput Biol 4(11)). Surprise is
judged by the change where there is one, by the value elsewhere: one error for every channel.

    s_t = [(x_t - m) / σ,  (x_t - x_{t-1})_slow / σ_Δ]        slow:  σ_Δ < 0.3 σ
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from asm_gym.stream import StreamSpec

SLOW = 0.3
"""A channel is slow where a step's change is under this share of its spread."""

FARTHEST = 1e3
"""Where standardised numbers are cut off, so that no finite row can overflow."""


class Reading(NamedTuple):
    """Rows of B streams, as the memory reads them; S numbers are sensed, X channels judged."""

    senses: NDArray[np.float32]  # (B, S) standardised; 0 where unseen
    seen: NDArray[np.float32]  # (B, S) 1 where there was something to read, else 0
    commands: NDArray[np.float32]  # (B, A + 1) standardised, then a constant 1
    finite: NDArray[np.bool_]  # (B, D)


@dataclass(frozen=True, eq=False)
class Senses:
    """Standardises rows of a stream.

    Args:
        spec: of the stream.
        mean: (D,) of the training rows [unit of each channel].
        spread: (D,) their standard deviation.
        change: (D,) standard deviation of the step from row to row; 0 for channels that are not slow.
    """

    spec: StreamSpec
    mean: NDArray[np.float64]
    spread: NDArray[np.float64]
    change: NDArray[np.float64]

    @classmethod
    def fit(cls, spec: StreamSpec, streams: Sequence[NDArray[np.float32]]) -> Self:
        """From training episodes (T, D) each."""
        rows = np.concatenate(streams).astype(np.float64)  # (N, D)
        steps = np.concatenate([np.diff(s.astype(np.float64), axis=0) for s in streams])
        mean = rows.mean(axis=0)
        spread = _spread(rows, mean, spec.noise)
        change = steps.std(axis=0)
        slow = (change > 0) & (change < SLOW * spread)
        slow[spec.motor] = False
        return cls(spec, mean, spread, np.where(slow, change, 0.0))

    @cached_property
    def slow(self) -> NDArray[np.intp]:
        """(S - X,) columns of the stream whose change is sensed too."""
        return np.flatnonzero(self.change > 0)

    @cached_property
    def size(self) -> int:
        """S."""
        return len(self.spec.sensory) + len(self.slow)

    @cached_property
    def judged(self) -> NDArray[np.intp]:
        """(X,) which of the S numbers is judged for each sensory channel: its change, or else its value."""
        X = len(self.spec.sensory)
        place = np.arange(X)
        place[np.searchsorted(self.spec.sensory, self.slow)] = X + np.arange(len(self.slow))
        return place

    def read(self, rows: NDArray[np.floating[Any]], before: NDArray[np.floating[Any]]) -> Reading:
        """Rows (B, D) and those that came just before (B, D); what is not finite in either is unseen."""
        sensory, motor, slow = self.spec.sensory, self.spec.motor, self.slow
        rows, before = np.asarray(rows, np.float64), np.asarray(before, np.float64)
        finite = np.isfinite(rows)
        with np.errstate(over="ignore", invalid="ignore"):  # huge numbers are cut off below, inf - inf is unseen
            values = (rows[:, sensory] - self.mean[sensory]) / self.spread[sensory]
            changes = (rows[:, slow] - before[:, slow]) / self.change[slow]
        seen = np.concatenate([finite[:, sensory], finite[:, slow] & np.isfinite(before[:, slow])], axis=1)  # (B, S)
        senses = np.where(seen, np.concatenate([values, changes], axis=1), 0.0)
        commands = np.ones((len(rows), len(motor) + 1), np.float32)
        told = np.where(finite[:, motor], rows[:, motor] - self.mean[motor], 0.0)
        commands[:, :-1] = _bounded(told / self.spread[motor])
        return Reading(_bounded(senses), seen.astype(np.float32), commands, finite)


def _bounded(numbers: NDArray[np.float64]) -> NDArray[np.float32]:
    """Cut off at ``FARTHEST``; 0 where not a number."""
    inside = np.minimum(np.maximum(np.where(np.isnan(numbers), 0.0, numbers), -FARTHEST), FARTHEST)
    return np.ascontiguousarray(inside, np.float32)


def _spread(rows: NDArray[np.float64], mean: NDArray[np.float64], noise: NDArray[np.float64]) -> NDArray[np.float64]:
    """(D,) standard deviation of each column; of one that never changes its sensor noise, or 1 where that is 0."""
    spread = rows.std(axis=0)
    constant = spread <= 1e-6 * np.abs(mean)  # the rounding of float32 is not a signal
    fallback: NDArray[np.float64] = np.where(noise > 0, noise, 1.0)
    return np.where(constant, fallback, spread)
