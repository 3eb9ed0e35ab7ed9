"""Knock, stop or fault: how far what the senses themselves tell of excuses a surprise.

    knock    a wrist has felt more than 50 N on an axis within the last second; its peaks count, where they are sensed
    stop     a joint is at one of its stops, less than 0.03 rad before it or 0.1 rad past it, and was seen on its way
    s'       s / 10 where either is so, s / 3 where a finger has just slid by 1 cm/s, else s
    after    k rows after either is over  s / (10 (1 - a)^{2k}), as long as that is less than s

A hand that strikes a table surprises, and so does a joint that comes to its stop or a finger that slips: none is a
fault of the body, and most alarms of healthy robots are such. They are not forgiven: what is still over the threshold
is a fault. What is over it but for the excuse has a name of its own, and is counted. A number that is missing excuses
nothing, and neither does one that jumps to a stop or far past it, as those of swapped joints and of encoders that drop
out do: an arm is seen on its way, within 5 rad/s of the stop, in the row before it comes there.

Evidence outlives what it is of: the slowest fades by (1 - a)² with each row, a the least of the usual gains. So does
the excuse, or what is left of a knock would be a fault once its second is over, and of a stop once the joint leaves it.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from asm_gym.compilation import compiled
from asm_gym.detection.detector import GAINS
from asm_gym.spec import Channel, StreamSpec

NO_EVENT, KNOCK, STOP, FAULT = "", "knock", "stop", "fault"
EVENTS = NO_EVENT, KNOCK, STOP, FAULT
"""What a row is. The last is the worst."""

KNOCKING = 50.0
"""At the wrist, on an axis [N]."""
KNOCKED_S = 1.0
"""For how long a knock is felt in what comes after it [s]."""
NEAR_STOP, PAST_STOP = 0.03, 0.1
"""A joint is at a stop from so far before it to so far past it [rad]; healthy arms went 0.04 rad past theirs at most,
in 4,199 episodes."""
FASTEST = 5.0
"""At which joints turn [rad/s]: one that was farther from its stop in the row before is not at it now."""
EXCUSED, SLIPPED = 10.0, 3.0
"""What surprise is divided by, at a knock or a stop, and where fingers move."""
FADE = (1.0 - min(GAINS)) ** 2
FADING = math.ceil(-math.log(EXCUSED) / math.log(FADE))
"""What is left of the slowest evidence after a row; in how many it comes down to a tenth, and the excuse too."""
MOVING, MOVED_S = 0.01, 0.1
"""At which a finger moves that slides [m/s], and for how long it has just moved [s]. Those that turn never rest."""


class Excused(NamedTuple):
    """What the senses make of rows.

    Attributes:
        kind: (B,) 1 for a knock, 2 for a stop, 0 for neither: places in ``EVENTS``.
        divisor: (B,) of the surprise.
    """

    kind: NDArray[np.int8]
    divisor: NDArray[np.float64]


class Excuses:
    """What excuses surprise, by the names of the channels of a stream.

    Args:
        spec: of the stream; without forces at a wrist no knock is known, and without ``Channel.stops`` no stop.
    """

    def __init__(self, spec: StreamSpec) -> None:
        peaks = _columns(spec, lambda c: c.name.endswith("wrist_force_peak"))
        self._wrist = peaks if peaks.size else _columns(spec, lambda c: c.name.endswith("wrist_force"))
        self._joints = _columns(spec, lambda c: bool(c.stops))
        self._ends = np.array([pair for c in spec.channels for pair in c.stops], np.float64).reshape(-1, 2)
        self._fingers = _columns(spec, lambda c: c.name.endswith("gripper_velocity") and c.unit == "m/s")
        self.on_its_way = NEAR_STOP + FASTEST * spec.dt
        self._rows = np.array([*(max(1, round(seconds / spec.dt)) for seconds in (KNOCKED_S, MOVED_S)), FADING])

    @property
    def joints(self) -> int:
        """How many have stops."""
        return len(self._joints)

    @property
    def arrays(self) -> tuple[list[NDArray[Any]], NDArray[np.float64]]:
        """Columns of wrists, joints and fingers, and how many rows things last and fade; (J, 2) the stops."""
        return [self._wrist, self._joints, self._fingers, self._rows], self._ends

    def start(self, batch: int) -> NDArray[np.int64]:
        """(B, 3 + J) for how many rows a knock and a stop are still felt, and fingers have just moved: none. Then
        whether each joint with stops may come to one in the next row: all may."""
        left = np.ones((batch, 3 + self.joints), np.int64)
        left[:, :3] = 0
        return left

    def step(self, left: NDArray[np.int64], rows: NDArray[np.float64]) -> tuple[NDArray[np.int64], Excused]:
        """What the next rows (B, D) excuse, some of whose numbers may not be finite."""
        senses = self._wrist, self._joints, self._ends, self._fingers
        after, kind, divisor = _step(left, rows, *senses, self._rows, self.on_its_way)
        return after, Excused(kind, divisor)

    def divisors(self, stream: NDArray[np.floating[Any]]) -> NDArray[np.float64]:
        """(T,) what surprise is divided by in each row of a whole stream (T, D)."""
        left, found = self.start(1), np.ones(len(stream))
        for t, row in enumerate(np.asarray(stream, np.float64)):
            left, excused = self.step(left, row[None])
            found[t] = excused.divisor[0]
        return found


def event_of(value: float, raw: float, kind: int, threshold: float) -> str:
    """What a row is: its surprise as far as it is not excused, all of it, and what excuses it."""
    if not value <= threshold:
        return FAULT
    return EVENTS[kind] if raw > threshold else NO_EVENT


def _columns(spec: StreamSpec, which: Callable[[Channel], bool]) -> NDArray[np.intp]:
    """(N,) of the channels that are meant."""
    found = [np.arange(spec.size)[spec.slices[c.name]] for c in spec.channels if which(c)]
    columns: NDArray[np.intp] = np.concatenate([np.zeros(0, np.intp), *found])
    return columns


@compiled
def _step(
    left: Any, rows: Any, wrist: Any, joints: Any, ends: Any, fingers: Any, lasting: Any, on_its_way: float
) -> Any:
    B = len(rows)
    after, kind, divisor = np.maximum(left - 1, 0), np.zeros(B, np.int8), np.ones(B)
    for n in range(B):
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
            past, came = max(ends[j, 0] - q, q - ends[j, 1]), left[n, 3 + j]
            if not -on_its_way < past < PAST_STOP:
                came = 0 if np.isfinite(q) else 1  # which was not seen may have come from anywhere
            elif past <= -NEAR_STOP:
                came = 1
            elif came > 0:
                after[n, 1] = lasting[2] + 1
            after[n, 3 + j] = came
        for k in (1, 0):
            if after[n, k] > 0:
                kind[n] = k + 1
                divisor[n] = max(divisor[n], EXCUSED * FADE ** max(lasting[2] - after[n, k] + 1, 0))
    return after, kind, divisor
