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
from asm_gym.guard.hand import NEEDS, Contradiction, HandAgainstJoints, compare, no_hand
from asm_gym.guard.repair import Repair
from asm_gym.guard.robot_facts import NOTHING, RobotFacts
from asm_gym.memory.completion import Completion
from asm_gym.monitors import Surprise
from asm_gym.spec import StreamSpec

LOG = logging.getLogger("asm_gym.safety")

IMPOSSIBLE = 40.0  # once in e⁴⁰ rows
LEAST_CHANCE = 1e-6  # of a sense without resolution, whose numbers are of single precision
MOST_CHANCE = 0.5  # senses that repeat more often tell nothing
SHARE = 0.5  # of the senses with noise

Mask = NDArray[np.bool_]


class Believed(NamedTuple):
    """The next row of each robot, as the monitor is to see it."""

    rows: NDArray[np.float32]  # (n, D)
    lost: Mapping[int, tuple[str, ...]]  # the numbers that were not finite, by robot
    contradictions: Mapping[int, Contradiction]  # of hand and joints, by robot
    failures: Mapping[int, str]  # what can no longer be relied on, by robot


class Rows:
    """Reads the rows of n robots, and keeps the last ones.

    Args:
        robots: whose.
        spec: of their streams.
        completion: of the memory that watches; None where nothing completes senses.
        kept: how many rows are kept of each.
    """

    def __init__(
        self,
        robots: RobotFacts,
        spec: StreamSpec,
        completion: Completion | None,
        kept: int,
    ) -> None:
        self._spec, self._kept = spec, kept
        self._stale = StaleSenses(robots.count, spec)
        self._completion = None if robots.observed is None else completion
        if completion is not None and robots.observed is None:
            # Completing what the monitor sees would hide a fault that the policy goes on to see.
            reason = robots.refused.get("complete", "it is not known where they stand in the observation")
            warnings.warn(
                f"a faulty sensor cannot be estimated from the others, so the robot holds: {reason}", stacklevel=5
            )
        self.read = None if self._completion is None else robots.observed
        """(D,) which columns the policy reads; None where senses cannot be completed."""
        arms = (c for c in robots.chains if all(c[0].prefix + name in spec.slices for name in NEEDS))
        self._hands = tuple(HandAgainstJoints(chains, spec) for chains in arms)
        self._first = self._hands[0].arguments if self._hands else no_hand(robots.count)
        self._history = np.zeros((robots.count, 2 * kept, spec.size), np.float32)
        self._end = 0  # the newest row is before it
        self._seen = np.zeros(robots.count, np.int64)  # rows in this episode
        self.repairs: dict[int, Repair] = {}
        """Of the robots of which something is completed, or was a moment ago."""

    def begin(self, which: Mask) -> None:
        """New episodes of the robots of ``which`` (n,)."""
        self._seen[which] = 0
        self._stale.begin(which)
        for hand in self._hands:
            hand.begin(which)
        for robot in np.flatnonzero(which):
            self.repairs.pop(int(robot), None)

    def next(self, rows: NDArray[np.float32], active: Mask) -> Believed:
        """Take in the next rows (n, D) as they were sensed, of which those of ``active`` (n,) robots count."""
        if self._end == self._history.shape[1]:
            self._history[:, : self._kept] = self._history[:, -self._kept :]
            self._end = self._kept
        rows = self._stale.left_out(rows)
        found = _take_in(rows, self._history, self._end, self._seen, *self._first)
        contradictory = [hand.contradicting(found > 1) for hand in self._hands[:1]]
        contradictory += [hand.contradicting(compare(rows, *hand.arguments)) for hand in self._hands[1:]]
        if found == 0 and not self.repairs and not any(contradictory):
            self._end += 1
            return Believed(rows, NOTHING, NOTHING, NOTHING)
        lost: dict[int, tuple[str, ...]] = {}
        if found != 2:
            for i in np.flatnonzero(~np.isfinite(rows).all(axis=1) & active).tolist():
                lost[i] = tuple(self._spec.labels[k] for k in np.flatnonzero(~np.isfinite(rows[i])))
        unusual = {i for i in (*self.repairs, *lost, *(i for found in contradictory for i in found)) if active[i]}
        believed, contradictions, failures = rows.copy(), {}, {}
        for i in sorted(unusual):
            missing, pairs = self._missing(i), zip(self._hands, contradictory, strict=True)
            named = [hand.contradiction(i, missing) for hand, robots in pairs if i in robots]
            if first := next(filter(None, named), None):
                contradictions[i] = first
            believed[i] = self._history[i, self._end] = self._repaired(i, rows[i], i in lost)
            repair = self.repairs.get(i)
            if repair is not None and not repair.trusted:
                failures[i] = f"completion: too much is missing, or for too long: {', '.join(repair.names)}"
        self._end += 1
        return Believed(believed, lost, contradictions, failures)

    def last(self, robot: int, count: int | None = None) -> NDArray[np.float32]:
        """Return (T, D) the last rows of a robot in this episode, all that are kept by default, the newest last."""
        rows = min(int(self._seen[robot]), self._kept if count is None else count, self._end)
        return self._history[robot, self._end - rows : self._end]

    def suspect(self, robot: int, columns: NDArray[np.intp]) -> bool:
        """Complete the sensors of ``columns`` from a robot's last row on; return whether that leaves any to go by."""
        if self._completion is None:
            return False
        repair = self.repairs.get(robot) or self._new_repair(robot, reading=False)
        row = repair.suspect(columns)
        if row is None:
            return False
        self.repairs[robot] = repair
        self._history[robot, self._end - 1] = row
        return True

    def known(self, robot: int) -> Mask:
        """Return (D,) what is completed, or right by the hand and its joints."""
        return np.logical_or.reduce([self._missing(robot), *(hand.vouched(robot) for hand in self._hands)])

    def counted(self, surprise: Surprise, failures: Mapping[int, str]) -> Surprise:
        """Return what counts of the surprise at the last rows: nothing is surprised by what was completed."""
        if not self.repairs:
            return surprise
        parts = [None if part is None else part.copy() for part in surprise]
        for robot, repair in self.repairs.items():
            own = surprise.of(robot).without(repair.unjudged)
            if repair.settling and robot not in failures:
                own = own.silenced(np.ones(1, bool))
            for part, value in zip(parts, own, strict=True):
                if part is not None and value is not None:
                    part[robot] = value[0]
        return Surprise(*parts)  # type: ignore[arg-type]

    def drop_repairs(self) -> None:
        """Forget the repairs that are over."""
        for robot in [robot for robot, repair in self.repairs.items() if repair.over]:
            del self.repairs[robot]

    def _missing(self, robot: int) -> Mask:
        return self.repairs[robot].missing if robot in self.repairs else np.zeros(self._spec.size, bool)

    def _repaired(self, robot: int, row: NDArray[np.float32], lost: bool) -> NDArray[np.float32]:
        if self._completion is None or not (lost or robot in self.repairs):
            return row
        repair = self.repairs.setdefault(robot, self.repairs.get(robot) or self._new_repair(robot, reading=True))
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
        return Repair(self._completion, robot, before, self.read, self._hands)


class StaleSenses:
    """Finds senses of n streams that repeat readings bit for bit though they have noise: they were not sensed anew.

        p_i = δ_i / (2 √π σ_i)             chance that sense i repeats a reading at rest: noise σ, resolution δ
        stale    Σ -log p_i > IMPOSSIBLE   over the senses that repeat, where these are most of those with noise

    A few senses that are stuck are found by evidence over several rows (``asm_gym.detection.repetition``).
    """

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


@partial(compiled, calls=("detection", "."))
def _take_in(rows: Any, history: Any, end: int, seen: Any, at: Any, *known: Any) -> int:
    """Write rows (n, D) into what is kept of each robot (n, T, D), and compare the hand of the first arm.

    Args:
        at, known: of ``compare``.

    Returns:
        1 where a number is not finite, and 2 more where ``compare`` says so.
    """
    finite = True
    for n in range(len(rows)):
        seen[n] += 1
        for i in range(rows.shape[1]):
            history[n, end, i] = rows[n, i]
            finite = finite and np.isfinite(rows[n, i])
    found = 0 if finite else 1
    if len(at) and compare(rows, at, *known):
        found += 2
    return found
