"""The rows of n robots as they are believed: compared with the hand, completed where a sense is not believed, kept."""

from __future__ import annotations

import logging
import warnings
from collections.abc import Mapping
from functools import partial
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from asm_gym.compilation import compiled
from asm_gym.guard.hand import NEEDS, Contradiction, HandAgainstJoints
from asm_gym.guard.repair import Repair
from asm_gym.guard.robots import NOTHING, Robots
from asm_gym.memory.completion import Completion
from asm_gym.monitors import Surprise
from asm_gym.spec import StreamSpec

LOG = logging.getLogger("asm_gym.safety")

Mask = NDArray[np.bool_]


class Believed(NamedTuple):
    """The next row of each robot, as the monitor is to see it.

    Attributes:
        rows: (n, D).
        lost: the numbers that were not finite, by robot.
        contradictions: of hand and joints, by robot.
        failures: what can no longer be relied on, by robot.
    """

    rows: NDArray[np.float32]
    lost: Mapping[int, tuple[str, ...]]
    contradictions: Mapping[int, Contradiction]
    failures: Mapping[int, str]


class Rows:
    """Reads the rows of n robots, and keeps the last ones.

    Args:
        robots: whose.
        spec: of their streams.
        completion: of the memory that watches; None where nothing completes senses.
        trust_s: how long a sense that no other sense tells of is completed [s].
        kept: how many rows are kept of each.
    """

    def __init__(
        self,
        robots: Robots,
        spec: StreamSpec,
        completion: Completion | None,
        trust_s: float,
        kept: int,
    ) -> None:
        self._spec, self._trust_s, self._kept = spec, trust_s, kept
        self._completion = None if robots.read is None else completion
        if completion is not None and robots.read is None:
            # Completing what the monitor sees would hide a fault that the policy goes on to see.
            reason = robots.refused.get("complete", "it is not known where they stand in the observation")
            warnings.warn(
                f"senses cannot be completed, and on a sensor at fault the robot holds: {reason}", stacklevel=5
            )
        self.read = None if self._completion is None else robots.read
        """(D,) which columns the policy reads; None where senses cannot be completed."""
        arms = (c for c in robots.chains if all(c[0].prefix + name in spec.slices for name in NEEDS))
        self._hands = tuple(HandAgainstJoints(chains, spec) for chains in arms)
        self._history = np.zeros((robots.count, 2 * kept, spec.size), np.float32)
        self._end = 0  # the newest row is before it
        self._seen = np.zeros(robots.count, np.int64)  # rows in this episode
        self._repairs: dict[int, Repair] = {}

    def begin(self, which: Mask) -> None:
        """New episodes of the robots of ``which`` (n,)."""
        self._seen[which] = 0
        for hand in self._hands:
            hand.begin(which)
        for robot in np.flatnonzero(which):
            self._repairs.pop(int(robot), None)

    def next(self, rows: NDArray[np.float32], active: Mask) -> Believed:
        """Take in the next rows (n, D) as they were sensed, of which those of ``active`` (n,) robots count."""
        if self._end == self._history.shape[1]:
            self._history[:, : self._kept] = self._history[:, -self._kept :]
            self._end = self._kept
        finite = _keep(rows, self._history, self._end, self._seen)
        contradictory = [hand.compare(rows) for hand in self._hands]
        if finite and not self._repairs and not any(contradictory):
            self._end += 1
            return Believed(rows, NOTHING, NOTHING, NOTHING)
        lost: dict[int, tuple[str, ...]] = {}
        if not finite:
            for i in np.flatnonzero(~np.isfinite(rows).all(axis=1) & active).tolist():
                lost[i] = tuple(self._spec.labels[k] for k in np.flatnonzero(~np.isfinite(rows[i])))
        unusual = {i for i in (*self._repairs, *lost, *(i for found in contradictory for i in found)) if active[i]}
        believed, contradictions, failures = rows.copy(), {}, {}
        for i in sorted(unusual):
            missing = self._missing(i)
            found = [
                hand.contradiction(i, missing)
                for hand, said in zip(self._hands, contradictory, strict=True)
                if i in said
            ]
            if first := next(filter(None, found), None):
                contradictions[i] = first
            believed[i] = self._history[i, self._end] = self._repaired(i, rows[i], i in lost)
            repair = self._repairs.get(i)
            if repair is not None and not repair.trusted:
                failures[i] = f"completion: too much is missing, or for too long: {', '.join(repair.names)}"
        self._end += 1
        return Believed(believed, lost, contradictions, failures)

    def last(self, robot: int, count: int | None = None) -> NDArray[np.float32]:
        """Return (T, D) the last rows of a robot in this episode, all that are kept by default, the newest last."""
        rows = min(int(self._seen[robot]), self._kept if count is None else count, self._end)
        return self._history[robot, self._end - rows : self._end]

    def suspect(self, robot: int, columns: NDArray[np.intp]) -> bool:
        """Believe the sensors of ``columns`` no more, from a robot's last row on; return whether that leaves anything
        to go by."""
        if self._completion is None:
            return False
        repair = self._repairs.get(robot) or self._new_repair(robot, reading=False)
        row = repair.suspect(columns)
        if row is None:
            return False
        self._repairs[robot] = repair
        self._history[robot, self._end - 1] = row
        return True

    def explained(self, robot: int) -> Mask:
        """Return (D,) what is completed, or right by the hand and its joints."""
        known: Mask = np.logical_or.reduce([self._missing(robot), *(hand.vouched(robot) for hand in self._hands)])
        return known

    def counted(self, surprise: Surprise, failures: Mapping[int, str]) -> Surprise:
        """Return what counts of the surprise at the last rows: nothing is surprised by what was completed."""
        if not self._repairs:
            return surprise
        parts = [None if part is None else part.copy() for part in surprise]
        for robot, repair in self._repairs.items():
            own = surprise.of(robot).without(repair.unjudged)
            if repair.settling and robot not in failures:
                own = own.silenced(np.ones(1, bool))
            for part, value in zip(parts, own, strict=True):
                if part is not None and value is not None:
                    part[robot] = value[0]
        return Surprise(*parts)  # type: ignore[arg-type]

    @property
    def repairs(self) -> Mapping[int, Repair]:
        """The robots of which something is completed, or was a moment ago."""
        return self._repairs

    def drop_repairs(self) -> None:
        """Forget the repairs that are over."""
        for robot in [robot for robot, repair in self._repairs.items() if repair.over]:
            del self._repairs[robot]

    def _missing(self, robot: int) -> Mask:
        return self._repairs[robot].missing if robot in self._repairs else np.zeros(self._spec.size, bool)

    def _repaired(self, robot: int, row: NDArray[np.float32], lost: bool) -> NDArray[np.float32]:
        if self._completion is None or not (lost or robot in self._repairs):
            return row
        repair = self._repairs.setdefault(robot, self._repairs.get(robot) or self._new_repair(robot, reading=True))
        known = repair.names
        try:
            row = repair.next(row)
        except Exception as error:
            # Nobody knows what the row should say: what is not finite is an alarm, and nothing explains it.
            warnings.warn(f"completion: {error!r}; the row counts as lost", stacklevel=2)
            return np.full_like(row, np.nan)
        if new := ", ".join(name for name in repair.names if name not in known):
            LOG.info("complete: %s says nothing any more", new)
        return row

    def _new_repair(self, robot: int, reading: bool) -> Repair:
        assert self._completion is not None
        assert self.read is not None
        before = self._history[robot, self._end - 1] if self._seen[robot] > reading else None
        return Repair(self._completion, robot, before, self._trust_s, self.read, self._hands)


@partial(compiled, calls=(".",))
def _keep(rows: Any, history: Any, end: int, seen: Any) -> bool:
    """Write rows (n, D) into what is kept of each robot (n, T, D); return whether every number is finite."""
    finite = True
    for n in range(len(rows)):
        seen[n] += 1
        for i in range(rows.shape[1]):
            history[n, end, i] = rows[n, i]
            finite = finite and np.isfinite(rows[n, i])
    return finite
