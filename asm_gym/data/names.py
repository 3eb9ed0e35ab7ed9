"""Tell what a column is, by its name: a clock, a label, a counter, a command, a sense; a position or a speed."""

from __future__ import annotations

import re
from collections.abc import Sequence
from fnmatch import fnmatchcase
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from asm_gym.data.units import bare_name

SECONDS = {
    **dict.fromkeys(("s", "sec", "secs", "second", "seconds"), 1.0),
    **dict.fromkeys(("ms", "msec", "millis", "milliseconds"), 1e-3),
    **dict.fromkeys(("us", "µs", "usec", "micros", "microseconds"), 1e-6),
    **dict.fromkeys(("ns", "nsec", "nanos", "nanoseconds"), 1e-9),
}
"""Seconds in one, by the unit behind the name of a clock."""

COUNTERS = ("", "index", "idx", "num", "no", "no.", "row", "seq", "frame", "frame_index", "unnamed: 0")
"""Names of columns that count rows."""

_OF = r"(?:elapsed|rel|relative|ros|unix|epoch|sys|system|robot|controller|host|log|utc|sample|recording)"
_WHAT = r"(?:time[ _]?stamps?|time|stamp|date[ _]?time|date)"
_UNIT = "|".join(sorted(map(re.escape, SECONDS), key=len, reverse=True))
CLOCK = re.compile(
    rf"[%_#\s]*(?:(?:.*[./])?(?:header[._])?(?:{_OF}[ _]?)?{_WHAT}|t)(?:[ _.]*[\[(]?\s*(?P<unit>{_UNIT})\s*[\])]?)?",
    re.I,
)
LABEL = re.compile(
    r"(.*[^a-z])?(labels?|anomal(y|ies|ous)|faults?|faulty|failures?|protective_?stop|grip_?lost)([^a-z].*)?", re.I
)
COMMAND = re.compile(
    r"(.*[^a-z])?(target|desired|cmd|commands?|commanded|set_?points?|goal|ref|reference|action)([^a-z].*)?"
)
SPEED = re.compile(r"(.*[^a-z])?(vel|velocity|velocities|speeds?|qd|dq|qvel|joint_vel)([^a-z].*)?")
POSITION = re.compile(r"(.*[^a-z])?(pos|position|positions|angles?|q|qpos|joint_pos)([^a-z].*)?")

ELEMENT = re.compile(r"(?P<stem>.*[^\W\d_])(?:\[(?P<named>\w+)\]|[_.]?(?P<number>\d+))")
"""One of several numbers of a channel: ``joint[0]``, ``joint_0``, ``position[elbow]``."""


def is_clock(name: str) -> bool:
    """Tell whether a column holds times. A bare ``T`` is a temperature."""
    return name.strip() != "T" and CLOCK.fullmatch(name.strip()) is not None


def is_label(name: str, patterns: Sequence[str] = ()) -> bool:
    """Tell whether a column says what is wrong, and senses nothing."""
    return LABEL.fullmatch(name) is not None or any(fnmatchcase(name, pattern) for pattern in patterns)


def is_command(name: str) -> bool:
    """Tell whether a column was commanded and not sensed."""
    return COMMAND.fullmatch(name.lower()) is not None


def is_counter(name: str, column: NDArray[Any]) -> bool:
    """Tell whether a column counts rows: each is one more than the one before, but for rows that were lost."""
    if name.lower() not in COUNTERS or column.ndim != 1 or len(column) < 2 or column.dtype.kind not in "biuf":
        return False
    steps = np.diff(column.astype(np.float64))
    return bool((steps >= 1).all() and (steps == np.rint(steps)).all() and np.median(steps) == 1)


def role_of(column: str, values: NDArray[Any], labels: Sequence[str] = ()) -> str:
    """Return the role of a column: clock, label, words, counter, command or sense.

    Args:
        column: its name.
        values: (T,) or (T, k).
        labels: patterns of the columns that say what is wrong, beside those that are called so.
    """
    name = bare_name(column)
    roles = {
        "clock": is_clock(column),
        "label": values.ndim == 1 and is_label(name, labels),
        "words": values.dtype.kind not in "biuf",
        "counter": is_counter(name, values),
        "command": is_command(name),
    }
    return next((role for role, holds in roles.items() if holds), "sense")


@cache
def label_of(column: str) -> str:
    """Return what a stream calls the number of a column: ``joint[0]`` of ``joint_0``."""
    found = ELEMENT.fullmatch(column)
    return f"{found['stem']}[{found['named'] or found['number']}]" if found else column
