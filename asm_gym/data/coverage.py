"""What an arm has shown of itself while somebody records it: where each joint was, how fast, and which way.

    place   a tenth of the range that the joint has shown       at ten times a second
    pace    backwards or forwards, above or below half of its greatest speed; or at rest, under a twentieth of it
    cell    place and pace;  a visit is a stay in one
    new     n_1 / n     the chance that the next visit is to a cell never seen, n_1 cells having been visited once

Enough is heard when that is under 5 % of every joint that moves, and each went both ways, slowly and fast. What a
memory has not been shown is surprising. Source: Good 1953 (Biometrika), of species not seen yet.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]

SPEED = re.compile(r"(.*[^a-z])?(vel|velocity|velocities|speeds?|qd|dq|qvel|joint_vel)([^a-z].*)?")
POSITION = re.compile(r"(.*[^a-z])?(pos|position|positions|angles?|q|qpos|joint_pos)([^a-z].*)?")
"""What speeds and positions of joints are called."""

APART = 0.1
"""Seconds between looks."""

PLACES, REST = 10, 0.05
NEW = 0.05
PACES = ("fast backwards", "slowly backwards", "at rest", "slowly forwards", "fast forwards")

MOVED = 0.01
"""A joint that moves by less, of its unit, has not been shown at all."""


class Shown(NamedTuple):
    """Of one joint.

    Attributes:
        name: which.
        low: of where it was, and ``high``.
        fastest: its greatest speed, in a second.
        new: the chance that what it does next is new.
        missing: what it has not done, in words.
    """

    name: str
    low: float
    high: float
    fastest: float
    new: float
    missing: tuple[str, ...]

    @property
    def enough(self) -> bool:
        """Whether more of it would tell little."""
        return not self.missing and self.new < NEW

    def __str__(self) -> str:
        if self.missing == ("moved",):
            return f"{self.name}: not moved yet"
        lacks = f"; not yet {', '.join(self.missing)}" if self.missing else ""
        went = f"{self.name}: {self.low:.2f} to {self.high:.2f}, up to {self.fastest:.2f} a second"
        return f"{went}; {100 * self.new:.0f} % of what comes next is new{lacks}"


class Coverage:
    """Follows the joints of a recording.

    Args:
        names: of them.
    """

    def __init__(self, names: Sequence[str]) -> None:
        self.names = list(names)
        self._times: list[float] = []
        self._places: list[Floats] = []

    def see(self, time: float, positions: Sequence[float]) -> None:
        """A row at a time [s]; those that come sooner than a tenth of a second after another are passed over."""
        if not self._times or time - self._times[-1] >= APART:
            self._times.append(time)
            self._places.append(np.asarray(positions, np.float64))

    def shown(self) -> list[Shown]:
        """What each joint has shown."""
        if len(self._times) < 3:
            return [Shown(name, np.nan, np.nan, 0.0, 1.0, ("moved",)) for name in self.names]
        q = np.array(self._places)  # (T, J)
        v = np.gradient(q, np.array(self._times), axis=0)
        return [_shown(name, q[:, j], v[:, j]) for j, name in enumerate(self.names)]

    @property
    def enough(self) -> bool:
        """Whether all joints that moved have shown enough, and one did."""
        moved = [joint for joint in self.shown() if joint.missing != ("moved",)]
        return bool(moved) and all(joint.enough for joint in moved)


def _shown(name: str, q: Floats, v: Floats) -> Shown:
    known = np.isfinite(q) & np.isfinite(v)
    q, v = q[known], v[known]
    if not len(q) or np.ptp(q) < MOVED:
        return Shown(name, float(q.min(initial=0.0)), float(q.max(initial=0.0)), 0.0, 1.0, ("moved",))
    fastest = float(np.quantile(np.abs(v), 0.99))
    place = np.minimum((PLACES * (q - q.min()) / np.ptp(q)).astype(int), PLACES - 1)
    pace = np.digitize(v / fastest, [-0.5, -REST, REST, 0.5])
    cells = place * len(PACES) + pace
    visits = cells[np.concatenate([[True], np.diff(cells) != 0])]
    counted = Counter(visits.tolist())
    missing = tuple(PACES[k] for k in range(len(PACES)) if k != 2 and not (pace == k).any())
    new = sum(n == 1 for n in counted.values()) / len(visits)
    return Shown(name, float(q.min()), float(q.max()), fastest, new, missing)
