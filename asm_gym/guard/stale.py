"""Senses that repeat their readings bit for bit though they have noise: nothing was sensed anew, and they are missing.

    p_i = δ_i / (2 √π σ_i)             chance that sense i repeats a reading at rest: noise σ, resolution δ
    stale    Σ -log p_i > IMPOSSIBLE   over the senses that repeat, where these are most of those with noise

A few senses that are stuck are found by evidence over several rows (``asm_gym.detection.repetition``).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from asm_gym.spec import StreamSpec

IMPOSSIBLE = 40.0  # once in e⁴⁰ rows
LEAST_CHANCE = 1e-6  # of a sense without resolution, whose numbers are of single precision
MOST_CHANCE = 0.5  # senses that repeat more often tell nothing
SHARE = 0.5  # of the senses with noise


class StaleSenses:
    """Finds them in the rows of n streams."""

    def __init__(self, count: int, spec: StreamSpec) -> None:
        with np.errstate(divide="ignore", invalid="ignore"):
            chance = np.clip(spec.resolution / (2 * np.sqrt(np.pi) * spec.noise), LEAST_CHANCE, 1.0)
        noisy = (spec.noise > 0) & (chance < MOST_CHANCE)
        noisy[spec.motor] = False
        self._noisy, self._unlikely = np.flatnonzero(noisy), -np.log(chance[noisy])
        self._before = np.full((count, len(self._noisy)), np.nan, np.float32)

    def begin(self, which: NDArray[np.bool_]) -> None:
        """New episodes in the streams of ``which`` (n,)."""
        self._before[which] = np.nan

    def left_out(self, rows: NDArray[np.float32]) -> NDArray[np.float32]:
        """Return the next rows (n, D), with NaN for the senses that are stale."""
        if not len(self._noisy):
            return rows
        now = rows[:, self._noisy]
        again, self._before = now == self._before, now
        if not again.any():
            return rows
        stale = (again @ self._unlikely > IMPOSSIBLE) & (again.mean(axis=1) > SHARE)
        if not stale.any():
            return rows
        rows = rows.copy()
        rows[:, self._noisy] = np.where(again & stale[:, None], np.float32(np.nan), now)
        return rows
