"""The alarm rule: which rows are alarms, by their surprise, what excuses it, and the threshold.

    alarm            not surprise <= threshold            NaN is an alarm
    benign event     surprise <= threshold < raw          an excuse alone keeps the row from being an alarm
    alarms counted   one that persists, or returns within a minute, is one

``raw`` is the surprise before a benign event excuses a part of it (``benign_events``). The functions of single numbers
serve compiled code, and NumPy arrays the functions of arrays.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from asm_gym.compilation import compiled

Values = NDArray[np.floating[Any]]
Mask = NDArray[np.bool_]

NO_EVENT = ""
KNOCK = "knock"
STOP = "stop"
FAULT = "fault"
EVENTS = (NO_EVENT, KNOCK, STOP, FAULT)
"""Kinds of rows; the last is the worst. Rows keep an index in it."""
BENIGN_EVENTS = (KNOCK, STOP)  # that keep surprise from being an alarm
KNOCK_EVENT = EVENTS.index(KNOCK)
STOP_EVENT = EVENTS.index(STOP)
FAULT_EVENT = EVENTS.index(FAULT)

MINUTE = 60.0  # time below the threshold before another alarm counts [s]

JUDGED = np.dtype(
    [
        ("surprise", np.float64),
        ("raw_surprise", np.float64),
        ("excuse", np.int8),
        ("divisor", np.float64),
    ],
    align=True,
)
"""A row as it was judged: ``raw_surprise / divisor`` is ``surprise``; ``excuse`` is an index in ``EVENTS``."""


@compiled
def over_threshold(surprise: Any, threshold: Any) -> Any:
    """Return whether a surprise is an alarm; NaN is one."""
    return not surprise <= threshold


@compiled
def benign_event(raw: Any, surprise: Any, excuse: Any, threshold: Any) -> Any:
    """Return the index in ``EVENTS`` of what alone keeps a row from being an alarm; 0 for none."""
    if raw > threshold and surprise <= threshold:
        return excuse
    return 0


def rows_over(surprise: Values | float, threshold: Any) -> Mask:
    """Return which rows (…) are alarms, see ``over_threshold``."""
    return np.asarray(np.logical_not(np.asarray(surprise) <= threshold))


def rows_excused(raw: Values, surprise: Values, threshold: Any) -> Mask:
    """Return which rows (…) are no alarms only because a benign event excuses them."""
    return (np.asarray(raw) > threshold) & (np.asarray(surprise) <= threshold)


def alarms_begin(alarm: Mask) -> Mask:
    """Return where alarms begin, of rows in alarm (…, T): (…, T - 1), from the second row on."""
    return alarm[..., 1:] & ~alarm[..., :-1]


def rows_of_a_minute(dt: float) -> int:
    """Return the rows of a minute, for a period ``dt`` [s]."""
    return max(1, round(MINUTE / dt))


def alarms_in(surprise: Values, threshold: float, dt: float) -> int:
    """Count the alarms in an episode's surprise (T,); one that persists, or returns within a minute, is one."""
    over = np.flatnonzero(rows_over(surprise, threshold))
    if not len(over):
        return 0
    return 1 + int((np.diff(over) > rows_of_a_minute(dt)).sum())
