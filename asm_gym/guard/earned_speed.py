"""Earned speed: where a hand has passed freely at its limit, it may go faster the next time.

Of each place and direction the speeds of the two fastest episodes are kept,

    e = min(second fastest of max_t v_t, fastest of the memory's healthy hands along that axis)

over rows without a contact. A hand may go 1.25 e there, as healthy hands may (``detection.hand_speed``), so that what
it earns grows by a quarter from episode to episode while it goes as fast as it may. An alarm, a reflex or a contact
takes everything back that was earned at the places of the second before it, and the episode earns nothing.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from asm_gym.detection.contact_limits import FREE_FORCE, ContactLimits
from asm_gym.detection.hand_speed import AXES
from asm_gym.detection.hand_speed_map import (
    ARM_AND_PLACE,
    FASTEST_COLUMNS,
    AnyFloats,
    HandSpeedMap,
)
from asm_gym.guard.fitted_monitor import LOG
from asm_gym.guard.robot_facts import RobotFacts
from asm_gym.guard.robot_table import Floats32, Mask
from asm_gym.monitors import Monitor
from asm_gym.spec import StreamSpec

TAKEN_BACK_S = 1.0  # before a contact or an alarm, whose places lose what they have earned [s]
SPEEDS = 2  # fastest episodes that are kept of each place and direction
LONGEST_S = 60.0  # after which a part of an episode counts for itself [s]

Place = tuple[int, ...]  # arm, and cell along x, y and z


class EarnedSpeed:
    """What the hands of n robots in one task have earned.

    Args:
        spec: of the rows.
        count: n.
        healthy: how fast healthy hands went in the tasks that the memory knows.
        cells: (N, 16) earned before; None for nothing.

    Attributes:
        speed_map: how fast hands may go from their next episodes on; another object where that has changed.
    """

    def __init__(
        self,
        spec: StreamSpec,
        count: int,
        healthy: HandSpeedMap,
        cells: AnyFloats | None = None,
    ) -> None:
        self._spec = spec
        self._healthy = healthy
        self._most = healthy.cells[:, FASTEST_COLUMNS].max(axis=0)
        self._speeds: dict[Place, NDArray[np.float32]] = {}  # (SPEEDS, 12), the fastest first
        if cells is not None:
            for cell in cells:
                speed = np.minimum(cell[FASTEST_COLUMNS], self._most)
                self._speeds[place_of(cell)] = np.tile(speed, (SPEEDS, 1))
        self.speed_map = healthy.with_earned(self.cells)
        self._longest = max(1, round(LONGEST_S / spec.dt))  # rows
        self._rows: list[list[Floats32]] = [[] for _ in range(count)]
        # numbers of the rows with a contact or an alarm
        self._troubles: list[list[int]] = [[] for _ in range(count)]

    @property
    def cells(self) -> NDArray[np.float32]:
        """(N, 16) what has been earned by place; see ``HandSpeedMap``."""
        rows = [
            np.hstack((place, speeds[-1]))
            for place, speeds in self._speeds.items()
            if speeds[-1].any()
        ]
        return np.reshape(np.array(rows, np.float32), (-1, FASTEST_COLUMNS.stop))

    def follow(self, rows: Floats32, robots: NDArray[Any]) -> None:
        """Take up the rows (n, D) of robots, by their records (n,)."""
        trouble = robots["alarm"] | robots["overridden"] | ~(robots["contact_force"] < FREE_FORCE)
        for robot in np.flatnonzero(robots["active"]).tolist():
            if trouble[robot]:
                self._troubles[robot].append(len(self._rows[robot]))
            self._rows[robot].append(rows[robot])
            if len(self._rows[robot]) == self._longest:
                self._learn(robot)

    def end_episodes(self, which: Mask) -> None:
        """Learn from the episodes of the robots of ``which`` (n,)."""
        for robot in np.flatnonzero(which).tolist():
            self._learn(robot)

    def _learn(self, robot: int) -> None:
        """Learn from the rows of a robot, and forget them."""
        rows = self._rows[robot]
        troubles = self._troubles[robot]
        self._rows[robot] = []
        self._troubles[robot] = []
        changed = False
        if troubles:
            changed = self._take_back(rows, troubles)
        elif rows:
            changed = self._earn(np.array(rows))
        if changed:
            self.speed_map = self._healthy.with_earned(self.cells)

    def _earn(self, rows: Floats32) -> bool:
        """Keep how fast the hand went in the rows (T, D) of an episode."""
        changed = False
        for cell in self._cells_of(rows):
            place = place_of(cell)
            speed = np.minimum(cell[FASTEST_COLUMNS], self._most)
            before = self._speeds.get(place, np.zeros((SPEEDS, 2 * AXES), np.float32))
            after = np.sort(np.vstack((before, speed)), axis=0)[: -SPEEDS - 1 : -1]
            self._speeds[place] = after
            changed |= bool((after[-1] > before[-1]).any())
        return changed

    def _take_back(self, rows: list[Floats32], troubles: Iterable[int]) -> bool:
        """Forget what was earned in the second before each of some rows."""
        before = round(TAKEN_BACK_S / self._spec.dt)
        taken = np.zeros(len(rows), bool)
        for trouble in troubles:
            taken[max(0, trouble - before) : trouble + 1] = True
        changed = False
        for cell in self._cells_of(np.array(rows)[taken]):
            changed |= self._speeds.pop(place_of(cell), None) is not None
        return changed

    def _cells_of(self, rows: Floats32) -> AnyFloats:
        """Return the cells (N, 16) that the hands pass in rows (T, D), with their greatest speeds."""
        cells = HandSpeedMap.learned([rows], self._spec)
        if cells is None:
            return np.zeros((0, FASTEST_COLUMNS.stop))
        return cells


def place_of(cell: AnyFloats) -> Place:
    """Return the arm and place of a cell (16,)."""
    return tuple(cell[ARM_AND_PLACE].astype(int).tolist())


def earned_speed_of(
    monitor: Monitor, facts: RobotFacts, limits: ContactLimits
) -> EarnedSpeed | None:
    """Return what hands earn; None where the task has a pace of its own, or where no hand is slowed down."""
    slows = facts.limits_contact and np.isfinite(limits.hand_speed)
    pace = limits.pace
    if not slows or pace is None or facts.task in getattr(monitor, "pace_", {}):
        return None
    kept: dict[str, NDArray[np.float32]] = getattr(monitor, "earned_", {})
    if kept and facts.task not in kept:
        LOG.info("the speeds that hands have earned in %s do not count in %s", [*kept], facts.task)
    return EarnedSpeed(monitor.spec, facts.count, pace, kept.get(facts.task))
