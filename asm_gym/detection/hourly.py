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
    group: NDArray[np.float64] = np.zeros(0)  # (n,) the number of its task, in each of which a promise holds; or none

    @classmethod
    def of(cls, values: Sequence[Array], dt: float, each: Sequence[str] = ()) -> Blocks:
        """Of the values (T,) of whole episodes, a row each ``dt`` [s]; ``each`` names the group of every episode."""
        rows, number = _rows(dt), {name: n for n, name in enumerate(dict.fromkeys(each))}
        named = zip(values, each or [""] * len(values), strict=True)
        cut = [(v[at : at + rows], number.get(name, 0)) for v, name in named for at in range(0, len(v), rows)]
        kept = [(float(v.max()), len(v) * dt / 3600, group) for v, group in cut]
        maxima, hours, group = np.array(kept, float).reshape(-1, 3).T
        return cls(maxima, hours, group) if len(number) > 1 else cls(maxima, hours)

    @classmethod
    def restored(cls, kept: NDArray[np.float64]) -> Blocks:
        """Of a file (3, n), or (2, n) where all is one group. Raises ValueError where that is no maxima and hours."""
        if kept.ndim != 2 or len(kept) not in (2, 3) or not kept.size or not (kept[1] > 0).all():
            raise ValueError(f"blocks should be maxima and hours in the shape (2, n) or (3, n), found {shown(kept)}")
        return cls(*kept)

    @property
    def array(self) -> NDArray[np.float64]:
        """For a file (3, n), or (2, n)."""
        return np.stack([part for part in self if part.size])

    @property
    def apart(self) -> list[Blocks]:
        """Those of each group."""
        if not self.group.size:
            return [self]
        return [Blocks(*(part[self.group == group] for part in self[:2])) for group in np.unique(self.group)]

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
            f"record {math.ceil(100 * (1.0 / rate - hours)) / 100:.4g} hours more, "
            f"or promise {least_per_hour(hours):.4g}"
        )


def hourly_threshold(blocks: Blocks, rate: float) -> float:
    """The q that healthy operation exceeds in at most ``rate`` blocks an hour, on average over calibrations.

    Of several groups it is the greatest that one of them needs, so that the rate holds in each.

    Raises:
        ValueError: there are too few hours for this rate; the message says how many more it takes.
    """
    check_per_hour(rate)
    if len(groups := blocks.apart) > 1:
        return max(hourly_threshold(own, rate) for own in groups)
    check_hours(rate, blocks.total)
    allowed = math.floor(rate * blocks.total + ROUNDING) - 1  # blocks that may exceed it
    maxima = np.sort(blocks.maxima)
    return float(maxima[max(len(maxima) - 1 - allowed, 0)])


def least_per_hour(hours: float) -> float:
    """The least rate that so many hours can promise, rounded up to three digits."""
    unit = 10.0 ** (math.floor(math.log10(1.0 / hours)) - 2)
    return math.ceil(1.0 / hours / unit) * unit


def hourly_promise(blocks: Blocks, threshold: float, episodes: int) -> Promise:
    """What a threshold promises of the hours to come, in the group that has most; ``episodes``: cut into the blocks."""
    if len(groups := blocks.apart) > 1:
        worst = max((hourly_promise(own, threshold, episodes) for own in groups), key=lambda each: each.rate)
        return worst._replace(hours=blocks.total)
    n, hours, beyond = len(blocks.maxima), blocks.total, int((blocks.maxima > threshold).sum())
    return Promise(episodes, (beyond + 1) / hours, surely_below(beyond, n) * n / hours, HOUR, hours)


def _rows(dt: float) -> int:
    """Of a minute."""
    return max(1, round(MINUTE / dt))
