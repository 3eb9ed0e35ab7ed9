"""Promises by the hour: a threshold that healthy operation exceeds no more often than was promised.

    block        an episode; a longer one is cut into minutes, and what is left of the last is a block too
    alarm        counted once a block, however long it persists, and however often it comes back in it
    threshold    the least maximum q of n healthy blocks with   #{i: m_i > q} + 1 <= r (T_1 + … + T_n)

m_i is the largest value in block i, T_i how long it lasted [h], and r the rate [1/h]. The loss of a block,
[m_i > q] - r T_i, falls with q and is at most 1. So conformal risk control holds the mean loss of the next block to 0:
E[m > q] <= r E[T], at most r alarms for each hour that passes. Rows of a block may depend on each other in any way.
Blocks are taken to be exchangeable: an episode, or a minute of a long one, says nothing of the next.

Sources: Angelopoulos et al. 2024 (ICLR, conformal risk control), Theorem 1.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from asm_gym.detection.base import Array
from asm_gym.detection.conformal import HOUR, Promise, surely_below
from asm_gym.validation import check_number, shown

MINUTE = 60.0
"""Longest block, and how long the value must have stayed below the threshold for another alarm [s]."""

LEAST_PER_HOUR, MOST_PER_HOUR = 1e-6, 1e6
"""One in a hundred years of operation, which nobody records, and more than there are rows."""

ROUNDING = 1e-9


class Blocks(NamedTuple):
    """Healthy operation, as it is counted by the hour."""

    maxima: NDArray[np.float64]  # (n,) the largest value in each block
    hours: NDArray[np.float64]  # (n,) how long each lasted

    @classmethod
    def of(cls, values: Sequence[Array], dt: float) -> Blocks:
        """Of the values (T,) of whole episodes, a row each ``dt`` [s]."""
        rows = _rows(dt)
        cut = [value[begin : begin + rows] for value in values for begin in range(0, len(value), rows)]
        return cls(np.array([float(v.max()) for v in cut]), np.array([len(v) * dt / 3600 for v in cut]))

    @classmethod
    def restored(cls, kept: NDArray[np.float64]) -> Blocks:
        """Of a file (2, n). Raises ValueError where that is no maxima and hours."""
        if kept.ndim != 2 or len(kept) != 2 or not kept.size or not (kept[1] > 0).all():
            raise ValueError(f"blocks should be maxima and hours in the shape (2, n), found {shown(kept)}")
        return cls(*kept)

    @property
    def total(self) -> float:
        """All of them together [h]."""
        return float(self.hours.sum())


def alarms_in(value: Array, threshold: float, dt: float) -> int:
    """How many alarms an episode's values (T,) raise: one that persists, or comes back within a minute, is one.

    They begin a minute apart, so that no block of a minute holds the beginnings of two.
    """
    over = np.flatnonzero(np.asarray(value) > threshold)
    return int(1 + (np.diff(over) > _rows(dt)).sum()) if len(over) else 0


def check_per_hour(rate: float) -> float:
    """Raises ValueError or TypeError unless it is a number of alarms an hour that can be promised."""
    return check_number("false_alarms_per_hour", rate, low=LEAST_PER_HOUR, high=MOST_PER_HOUR)


def check_hours(rate: float, hours: float) -> None:
    """Raises ValueError where so many nominal hours are too few for this rate; the message says how many it takes."""
    if math.floor(rate * hours + ROUNDING) < 1:
        raise ValueError(
            f"{rate:g} false alarms an hour need at least {1.0 / rate:.4g} hours of nominal episodes, got {hours:.3g}: "
            f"record {math.ceil(100 * (1.0 / rate - hours)) / 100:.4g} hours more, or promise {_least(hours):.4g}"
        )


def hourly_threshold(blocks: Blocks, rate: float) -> float:
    """The q that healthy operation exceeds in at most ``rate`` blocks an hour, on average over calibrations.

    Raises:
        ValueError: there are too few hours for this rate; the message says how many more it takes.
    """
    check_per_hour(rate)
    check_hours(rate, blocks.total)
    allowed = math.floor(rate * blocks.total + ROUNDING) - 1  # blocks that may exceed it
    maxima = np.sort(blocks.maxima)
    return float(maxima[max(len(maxima) - 1 - allowed, 0)])


def _least(hours: float) -> float:
    """The least rate that so many hours can promise, rounded up to three digits."""
    unit = 10.0 ** (math.floor(math.log10(1.0 / hours)) - 2)
    return math.ceil(1.0 / hours / unit) * unit


def hourly_promise(blocks: Blocks, threshold: float, episodes: int) -> Promise:
    """What a threshold promises of the hours to come; ``episodes`` is how many were cut into the blocks."""
    n, hours, beyond = len(blocks.maxima), blocks.total, int((blocks.maxima > threshold).sum())
    return Promise(episodes, (beyond + 1) / hours, surely_below(beyond, n) * n / hours, HOUR, hours)


def _rows(dt: float) -> int:
    """Of a minute."""
    return max(1, round(MINUTE / dt))
