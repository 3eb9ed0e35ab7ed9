"""Wear of n robots, from block to block of their operation: an episode is one, a longer one is cut into minutes.

A block with an alarm or an override, or with too few rows, says nothing about wear. Wear is told, and never acted on.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from asm_gym.detection.alarm_rule import rows_of_a_minute
from asm_gym.detection.drift import SHORTEST, Wear
from asm_gym.guard.robot_table import Floats32, Mask
from asm_gym.monitors import Monitor, NeuralASM

NO_WEAR: Mapping[int, Wear] = {}


class WearWatch:
    """Collects the rows of blocks, and keeps what wears.

    Args:
        monitor: whose ``wear_counter`` adds up drift; others tell of none.
        count: n.

    Attributes:
        worn: what wears most, by robot.
    """

    def __init__(self, monitor: Monitor, count: int) -> None:
        counters = []
        if isinstance(monitor, NeuralASM) and monitor.wear_ is not None:
            counters = [monitor.wear_counter() for _ in range(count)]
        self._counters = [counter for counter in counters if counter is not None]
        self._dt = monitor.spec.dt
        self._most = rows_of_a_minute(self._dt)
        self._rows: list[list[Floats32]] = [[] for _ in self._counters]
        self._spoilt = np.zeros(len(self._counters), bool)
        self.worn = NO_WEAR

    def begin(self, which: Mask) -> None:
        """End the blocks of the robots of ``which`` (n,)."""
        for robot in range(len(self._counters)):
            if which[robot]:
                self._end_block(robot)

    def acknowledge(self) -> None:
        """Forget all wear: the next blocks say what is healthy."""
        for robot, counter in enumerate(self._counters):
            counter.acknowledge()
            self._rows[robot] = []
        self.worn = NO_WEAR

    def follow(self, rows: Floats32, robots: NDArray[Any]) -> None:
        """Take up judged rows (n, D), never written to again, and the records (n,) of their robots."""
        for robot, own_rows in enumerate(self._rows):
            record = robots[robot]
            if not record["active"]:
                continue
            if record["over"] or record["alarm"] or record["overridden"] or record["lost"]:
                self._spoilt[robot] = True
            own_rows.append(rows[robot])
            if len(own_rows) >= self._most:
                self._end_block(robot)

    def _end_block(self, robot: int) -> None:
        """Take up a robot's block, where it says anything."""
        rows = self._rows[robot]
        counts = len(rows) >= SHORTEST and not self._spoilt[robot]
        self._rows[robot] = []
        self._spoilt[robot] = False
        if not counts:
            return
        worn = self._counters[robot].follow(np.array(rows), self._dt)
        if worn:
            self.worn = {**self.worn, robot: worn[0]}
        elif robot in self.worn:
            self.worn = {name: wear for name, wear in self.worn.items() if name != robot}


def wear_info(wear: Wear | None) -> dict[str, Any]:
    """Return ``info["asm"]["wear"]``; empty where nothing wears."""
    if wear is None:
        wear = Wear(channel="", kind="", since_s=0.0)
    return wear._asdict()
