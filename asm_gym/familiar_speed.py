"""How fast a hand has healthily gone at each place: where nothing is known, it goes slowly.

A place is a cube of ``CELL`` metres. It knows the 95 % quantile of the speeds that healthy episodes had there. Asked
for a place, the greatest of those within ``NEAR`` counts, and a little more. Elsewhere a hand goes at ``UNKNOWN``, and
its first blow on a stiff table stays below 100 N.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from asm_gym.spec import StreamSpec
from asm_gym.validation import check_numbers

CELL = 0.02
"""[m]"""

NEAR = 0.04
"""[m]"""

QUANTILE = 0.95

MORE = 1.2
"""Faster by so many times than healthy episodes were is familiar still."""

UNKNOWN = 0.05
"""[m/s]"""

PLACE, VELOCITY = "hand_position", "hand_velocity"
"""Channels that tell of one hand."""


class FamiliarSpeed(NamedTuple):
    """What healthy episodes have shown.

    Attributes:
        places: (n, 3) middles of cubes [m].
        speeds: (n,) [m/s].
    """

    places: NDArray[np.float64]
    speeds: NDArray[np.float64]

    @classmethod
    def learned(cls, streams: Sequence[NDArray[np.floating[Any]]], spec: StreamSpec) -> Self | None:
        """From healthy episodes (T, D); None where their stream tells of no hand, or of two."""
        if not streams or PLACE not in spec.slices or VELOCITY not in spec.slices:
            return None
        rows = np.concatenate([np.asarray(stream, np.float64) for stream in streams])
        cells = np.floor(rows[:, spec.slices[PLACE]] / CELL).astype(np.int64)
        speeds = np.linalg.norm(rows[:, spec.slices[VELOCITY]], axis=1)
        finite = np.isfinite(speeds) & np.isfinite(rows[:, spec.slices[PLACE]]).all(axis=1)
        known, which = np.unique(cells[finite], axis=0, return_inverse=True)
        usual = [np.quantile(speeds[finite][which.ravel() == n], QUANTILE) for n in range(len(known))]
        return cls((known + 0.5) * CELL, np.array(usual))

    @classmethod
    def restored(cls, rows: ArrayLike) -> Self | None:
        """From what ``rows`` says; None of nothing. Raises ValueError where it is something else."""
        if not np.size(rows):
            return None
        saved = check_numbers("familiar speeds", rows, len(np.asarray(rows)), 4)
        return cls(saved[:, :3], saved[:, 3])

    @property
    def rows(self) -> list[list[float]]:
        """What a file keeps: place and speed, a row each."""
        found: list[list[float]] = np.column_stack([self.places, self.speeds]).round(4).tolist()
        return found

    def at(self, place: NDArray[np.floating[Any]]) -> float:
        """How fast a hand may go at ``place`` (3,) [m/s]; a place that is no number is unknown."""
        near = np.linalg.norm(self.places - place, axis=1) <= NEAR
        return max(UNKNOWN, MORE * float(self.speeds[near].max())) if near.any() else UNKNOWN
