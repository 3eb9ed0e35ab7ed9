"""The last rows of n robots, as they are believed; and senses that are stale, which are left out of a row.

    p_i = δ_i / (2 √π σ_i)             chance that sense i repeats a reading at rest: noise σ, resolution δ
    stale    Σ -log p_i > IMPOSSIBLE   over the senses that repeat, where these are most of those with noise

Senses that repeat readings bit for bit though they have noise were not sensed anew. A few senses that are stuck are
found by evidence over several rows (``asm_gym.detection.repetition``).
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from asm_gym.compilation import inner
from asm_gym.guard.robot_table import Floats32, Mask
from asm_gym.spec import StreamSpec

IMPOSSIBLE = 40.0  # once in e⁴⁰ rows
LEAST_CHANCE = 1e-6  # of a sense without resolution, whose numbers are of single precision
MOST_CHANCE = 0.5  # senses that repeat more often tell nothing
MOST_REPEAT = 0.5  # share of the senses with noise


class RowArrays(NamedTuple):
    """What compiled code keeps of rows."""

    rows: Floats32  # (n, 2 K, D)
    end: NDArray[np.int64]  # (1,) the newest row is before it
    noisy: NDArray[np.intp]  # (N,) columns of the senses with noise
    unlikely: NDArray[np.float64]  # (N,) -log p
    readings: Floats32  # (n, N) their last readings; NaN before the first


class RecentRows:
    """Keeps the last rows of n robots.

    Args:
        count: n.
        spec: of their streams.
        kept: K, how many rows are kept of each at least.
    """

    def __init__(self, count: int, spec: StreamSpec, kept: int) -> None:
        with np.errstate(divide="ignore", invalid="ignore"):
            chance = spec.resolution / (2 * np.sqrt(np.pi) * spec.noise)
        chance = np.clip(chance, LEAST_CHANCE, 1.0)
        noisy = (spec.noise > 0) & (chance < MOST_CHANCE)
        noisy[spec.motor] = False
        self._kept = kept
        self.arrays = RowArrays(
            rows=np.zeros((count, 2 * kept, spec.size), np.float32),
            end=np.zeros(1, np.int64),
            noisy=np.flatnonzero(noisy),
            unlikely=-np.log(chance[noisy]),
            readings=np.full((count, int(noisy.sum())), np.nan, np.float32),
        )

    def begin(self, which: Mask) -> None:
        """Begin new episodes in the streams of ``which`` (n,)."""
        self.arrays.readings[which] = np.nan

    def last(self, robot: int, count: int) -> Floats32:
        """Return (T, D) the last rows of a robot, ``count`` of them or as many as are kept, the newest last."""
        end = int(self.arrays.end[0])
        length = min(count, self._kept, end)
        return self.arrays.rows[robot, end - length : end]

    def replace_last(self, robot: int, row: Floats32) -> None:
        """Keep another row (D,) of a robot in the place of its newest."""
        self.arrays.rows[robot, self.arrays.end[0] - 1] = row


@inner
def make_room(recent: Any) -> int:
    """Return where the next rows are kept; the newest half moves to the beginning where there is no room left."""
    rows = recent.rows
    robots, size, columns = rows.shape
    kept = size // 2
    place = recent.end[0]
    if place == size:
        for n in range(robots):
            for k in range(kept):
                for i in range(columns):
                    rows[n, k, i] = rows[n, kept + k, i]
        place = kept
    recent.end[0] = place + 1
    return place


@inner
def leave_out_stale(row: Any, recent: Any, robot: int) -> None:
    """Write NaN into a row (D,) in the place of the senses that are stale."""
    noisy = recent.noisy
    last = recent.readings[robot]
    repeated = 0
    unlikely = 0.0
    for k in range(len(noisy)):
        if row[noisy[k]] == last[k]:
            repeated += 1
            unlikely += recent.unlikely[k]
    most_repeat = repeated > MOST_REPEAT * len(noisy)
    is_stale = most_repeat and unlikely > IMPOSSIBLE
    for k in range(len(noisy)):
        column = noisy[k]
        reading = row[column]
        if is_stale and reading == last[k]:
            row[column] = np.nan
        last[k] = reading
