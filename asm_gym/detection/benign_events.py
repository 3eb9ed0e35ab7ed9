"""Benign events: knocks, joints at their stops and sliding fingers excuse a surprise in part.

    knock     a wrist has measured more than 50 N on an axis within the last second; peaks count where they are sensed
    stop      a joint is at its stop, less than 0.03 rad before it or 0.1 rad past it, and approached it
    slide     a finger has just slid by 1 cm/s
    divisor   10 at a knock or a stop, 3 at a slide, else 1; the largest holds
    after     k rows after a knock or a stop: 10 (1 - a)^{2k}, while that is more than 1

Surprise is divided by the divisor. What exceeds the threshold in spite of that is a fault. A missing number excuses
nothing, and neither does one that jumps to a stop, as those of swapped joints do. The divisor fades as slowly as the
slowest evidence, a being the least of the usual gains.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from asm_gym.compilation import compiled, inner
from asm_gym.detection.alarm_rule import JUDGED, KNOCK_EVENT, STOP_EVENT
from asm_gym.detection.base import Floats
from asm_gym.detection.channel_columns import columns_where
from asm_gym.detection.detector import GAINS
from asm_gym.spec import Channel, StreamSpec

KNOCKING = 50.0  # force at the wrist, on an axis [N]
KNOCKED_S = 1.0  # duration of its excuse [s]
NEAR_STOP = 0.03  # a joint is at its stop from so far before it [rad]
PAST_STOP = 0.1  # to so far past it [rad]
# Largest joint speed [rad/s]: a joint farther from its stop in the row before is not at it now.
FASTEST_JOINT = 5.0
MOVING = 0.01  # speed of a sliding finger [m/s]
MOVED_S = 0.1  # duration of its excuse [s]
EXCUSED = 10.0  # divisor of surprise at a knock or a stop
SLIPPED = 3.0  # divisor where fingers slide
FADE = (1.0 - min(GAINS)) ** 2  # share of the slowest evidence left after a row
FADING = math.ceil(-math.log(EXCUSED) / math.log(FADE))
"""Rows in which it, and the divisor, falls to a tenth."""
KNOCKED = 0  # columns of ``EventState.left``
AT_STOP = 1
SLIDING = 2


class EventState(NamedTuple):
    """State of B streams; never changed in place."""

    # (B, 3) rows that a knock, a joint at its stop and a sliding finger go on to excuse
    left: NDArray[np.int64]
    approached: NDArray[np.bool_]  # (B, J) which joints may be at their stops in the next row

    @classmethod
    def start(
        cls,
        batch: int,
        joints: int,
    ) -> EventState:
        """Return the state before the first row."""
        return cls(
            left=np.zeros((batch, 3), np.int64),
            approached=np.ones((batch, joints), np.bool_),
        )


class EventSenses(NamedTuple):
    """Columns of a stream that tell of events, and durations."""

    wrist: NDArray[np.intp]  # (W,) forces [N]
    fingers: NDArray[np.intp]  # (F,) speeds [m/s]
    joints: NDArray[np.intp]  # (J,) angles [rad]
    stops: Floats  # (J, 2) their least and largest angles [rad]
    closing: float  # farthest that a joint may be from its stop in the row before it is there [rad]
    knock_rows: int  # that a knock excuses
    slide_rows: int  # that a sliding finger excuses


NO_SENSES = EventSenses(
    wrist=np.zeros(0, np.intp),
    fingers=np.zeros(0, np.intp),
    joints=np.zeros(0, np.intp),
    stops=np.zeros((0, 2)),
    closing=0.0,
    knock_rows=0,
    slide_rows=0,
)
"""Senses that no event is seen by."""


class BenignEvents:
    """Detects benign events by the names of a stream's channels; stops need ``Channel.stops``.

    Attributes:
        senses: the columns that tell of events.
    """

    def __init__(self, spec: StreamSpec) -> None:
        wrist = columns_where(spec, lambda channel: channel.name.endswith("wrist_force_peak"))
        if not wrist.size:
            wrist = columns_where(spec, lambda channel: channel.name.endswith("wrist_force"))
        stops = [stop for channel in spec.channels for stop in channel.stops]
        self.senses = EventSenses(
            wrist=wrist,
            fingers=columns_where(spec, _is_finger_speed),
            joints=columns_where(spec, lambda channel: bool(channel.stops)),
            stops=np.array(stops, np.float64).reshape(-1, 2),
            closing=NEAR_STOP + FASTEST_JOINT * spec.dt,
            knock_rows=max(1, round(KNOCKED_S / spec.dt)) + FADING,
            slide_rows=max(1, round(MOVED_S / spec.dt)),
        )

    def start(self, batch: int) -> EventState:
        """Return the state before the first row of ``batch`` streams."""
        return EventState.start(batch, len(self.senses.joints))

    def step(
        self,
        state: EventState,
        rows: Floats,
    ) -> tuple[EventState, NDArray[Any]]:
        """Return the new state, and ``excuse`` and ``divisor`` of rows (B, D) in an array (B,) of ``JUDGED``."""
        after = self.start(len(rows))
        judged = np.zeros(len(rows), JUDGED)
        find_events(self.senses, state, after, rows, judged)
        return after, judged

    def divisors(self, stream: NDArray[np.floating[Any]]) -> Floats:
        """Return the divisor of surprise (T,) in each row of a whole stream (T, D)."""
        state = self.start(1)
        divisors = []
        for row in np.asarray(stream, np.float64):
            state, judged = self.step(state, row[None])
            divisors.append(judged["divisor"][0])
        return np.array(divisors)


def _is_finger_speed(channel: Channel) -> bool:
    return channel.name.endswith("gripper_velocity") and channel.unit == "m/s"


@compiled
def find_events(
    senses: EventSenses, before: EventState, after: EventState, rows: Any, judged: Any
) -> None:
    """Write the new state, and ``excuse`` and ``divisor`` of rows (B, D) to ``judged`` (B,)."""
    for n in range(len(rows)):
        left = after.left[n]
        for cause in range(len(left)):
            left[cause] = max(before.left[n, cause] - 1, 0)
        if exceeds(rows[n], senses.wrist, KNOCKING):
            left[KNOCKED] = senses.knock_rows
        if reaches_stop(senses, before.approached[n], after.approached[n], rows[n]):
            left[AT_STOP] = FADING + 1
        if exceeds(rows[n], senses.fingers, MOVING):
            left[SLIDING] = senses.slide_rows
        excuse_row(left, judged[n])


@inner
def excuse_row(left: Any, judged: Any) -> None:
    """Write ``excuse`` and ``divisor`` of a row by the rows (3,) that each cause excuses."""
    longest = max(left[KNOCKED], left[AT_STOP])
    faded = max(FADING - longest + 1, 0)
    judged.excuse = 0
    judged.divisor = 1.0
    if longest > 0:
        judged.excuse = STOP_EVENT
        judged.divisor = max(EXCUSED * FADE**faded, 1.0)
    if left[KNOCKED] > 0:
        judged.excuse = KNOCK_EVENT
    if left[SLIDING] > 0:
        judged.divisor = max(judged.divisor, SLIPPED)


@inner
def exceeds(
    row: Any,
    columns: Any,
    limit: float,
) -> bool:
    """Return whether a number is beyond a limit, |x_i| > limit; one that is missing or infinite is not."""
    exceeding = False
    for i in columns:
        exceeding = exceeding or (abs(row[i]) > limit and np.isfinite(row[i]))
    return exceeding


@inner
def reaches_stop(
    senses: EventSenses,
    before: Any,
    after: Any,
    row: Any,
) -> bool:
    """Write which joints (J,) may be at their stops next; return whether one that might be is at its stop.

    p = max(low - q, q - high) is how far a joint is past its stop: it is there from -0.03 to 0.1 rad.
    """
    reaches = False
    for j in range(len(senses.joints)):
        angle = row[senses.joints[j]]
        past = max(senses.stops[j, 0] - angle, angle - senses.stops[j, 1])
        if not -senses.closing < past < PAST_STOP:
            after[j] = not np.isfinite(angle)  # a missing joint may be anywhere
        elif past <= -NEAR_STOP:
            after[j] = True
        else:
            after[j] = before[j]
            reaches = reaches or before[j]
    return reaches
