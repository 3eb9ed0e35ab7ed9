"""Events: knocks, joints at their stops and sliding fingers excuse a surprise in part.

    knock    a wrist has measured more than 50 N on an axis within the last second; peaks count where they are sensed
    stop     a joint is at its stop, less than 0.03 rad before it or 0.1 rad past it, and approached it
    s'       s / 10 at a knock or a stop, s / 3 where a finger has just slid by 1 cm/s, else s
    after    k rows after a knock or a stop  s / (10 (1 - a)^{2k}), while that is less than s

What exceeds the threshold in spite of the excuse is a fault. A missing number excuses nothing, and neither does one
that jumps to a stop, as those of swapped joints do. The excuse fades as slowly as the slowest evidence, a being the
least of the usual gains.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from asm_gym.compilation import compiled
from asm_gym.detection.base import Floats
from asm_gym.detection.detector import GAINS
from asm_gym.spec import Channel, StreamSpec

NO_EVENT, KNOCK, STOP, FAULT = "", "knock", "stop", "fault"
EVENTS = NO_EVENT, KNOCK, STOP, FAULT  # kinds of rows; the last is the worst
KNOCKING, KNOCKED_S = 50.0, 1.0  # force at the wrist, on an axis [N], and duration of its excuse [s]
NEAR_STOP, PAST_STOP = 0.03, 0.1  # a joint is at its stop from so far before it to so far past it [rad]
FASTEST = 5.0  # largest joint speed [rad/s]: a joint farther from its stop in the row before is not at it now
EXCUSED, SLIPPED = 10.0, 3.0  # divisors of surprise at a knock or a stop, and where fingers slide
FADE = (1.0 - min(GAINS)) ** 2  # share of the slowest evidence left after a row
FADING = math.ceil(-math.log(EXCUSED) / math.log(FADE))  # rows in which it, and the excuse, falls to a tenth
MOVING, MOVED_S = 0.01, 0.1  # speed of a sliding finger [m/s], and duration of its excuse [s]


class Excuses:
    """Detects events by the names of a stream's channels; stops need ``Channel.stops``."""

    def __init__(self, spec: StreamSpec) -> None:
        peaks = _columns(spec, lambda c: c.name.endswith("wrist_force_peak"))
        self._wrist = peaks if peaks.size else _columns(spec, lambda c: c.name.endswith("wrist_force"))
        self._joints = _columns(spec, lambda c: bool(c.stops))
        self._ends = np.array([pair for c in spec.channels for pair in c.stops], np.float64).reshape(-1, 2)
        self._fingers = _columns(spec, lambda c: c.name.endswith("gripper_velocity") and c.unit == "m/s")
        self.on_its_way = NEAR_STOP + FASTEST * spec.dt
        self._rows = np.array([*(max(1, round(seconds / spec.dt)) for seconds in (KNOCKED_S, MOVED_S)), FADING])

    @property
    def arrays(self) -> tuple[list[NDArray[Any]], Floats]:
        """Columns of wrists, joints and fingers, rows of their excuses, and the stops (J, 2)."""
        return [self._wrist, self._joints, self._fingers, self._rows], self._ends

    def start(self, batch: int) -> NDArray[np.int64]:
        """Return the state (B, 3 + J): rows left of each excuse, and which joints may be at their stops next."""
        left = np.ones((batch, 3 + len(self._joints)), np.int64)
        left[:, :3] = 0
        return left

    def step(self, left: NDArray[np.int64], rows: Floats) -> tuple[NDArray[Any], ...]:
        """Return the new state, the place of each event of rows (B, D) in ``EVENTS``, and its divisor of surprise."""
        found = np.empty_like(left), np.empty(len(rows), np.int8), np.empty(len(rows))
        senses = self._wrist, self._joints, self._ends, self._fingers
        _step(left, rows, *senses, self._rows, self.on_its_way, *found)
        return found

    def divisors(self, stream: NDArray[np.floating[Any]]) -> Floats:
        """Return the divisor of surprise (T,) in each row of a whole stream (T, D)."""
        left, found = self.start(1), np.ones(len(stream))
        for t, row in enumerate(np.asarray(stream, np.float64)):
            left, _, (found[t],) = self.step(left, row[None])
        return found


def _columns(spec: StreamSpec, which: Callable[[Channel], bool]) -> NDArray[np.intp]:
    """Return the columns (N,) of the channels that ``which`` selects."""
    return np.flatnonzero([which(c) for c in spec.channels for _ in c.labels])


@compiled
def _step(
    left: Any,
    rows: Any,
    wrist: Any,
    joints: Any,
    ends: Any,
    fingers: Any,
    lasting: Any,
    on_its_way: float,
    after: Any,
    kind: Any,
    divisor: Any,
) -> None:
    """Write the new state (B, 3 + J), and the events (B,) and divisors (B,)."""
    for n in range(len(rows)):
        kind[n], divisor[n] = 0, 1.0
        for k in range(3):
            after[n, k] = max(left[n, k] - 1, 0)
        for i in wrist:
            if abs(rows[n, i]) > KNOCKING and np.isfinite(rows[n, i]):
                after[n, 0] = lasting[0] + lasting[2]
        for i in fingers:
            if abs(rows[n, i]) > MOVING and np.isfinite(rows[n, i]):
                after[n, 2] = lasting[1]
        if after[n, 2] > 0:
            divisor[n] = SLIPPED
        for j in range(len(joints)):
            q = rows[n, joints[j]]
            past, near = max(ends[j, 0] - q, q - ends[j, 1]), left[n, 3 + j]
            if not -on_its_way < past < PAST_STOP:
                near = 0 if np.isfinite(q) else 1  # a missing joint may be anywhere
            elif past <= -NEAR_STOP:
                near = 1
            elif near > 0:
                after[n, 1] = lasting[2] + 1
            after[n, 3 + j] = near
        for k in (1, 0):
            if after[n, k] > 0:
                kind[n] = k + 1
                divisor[n] = max(divisor[n], EXCUSED * FADE ** max(lasting[2] - after[n, k] + 1, 0))
