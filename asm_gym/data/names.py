"""Read the name of a column: its unit, and its role as a clock, a label, a counter, a command or a sense."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from fnmatch import fnmatchcase
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

UNITS = {
    name: (base, size)
    for base, sizes in {
        "rad": {"rad|radian|radians": 1.0, "deg|°|degree|degrees": math.pi / 180},
        "rad/s": {"rad/s": 1.0, "deg/s|°/s": math.pi / 180, "rpm": math.pi / 30},
        "A": {"A|amp|ampere|amperes": 1.0, "mA": 1e-3},
        "m": {"m|meter|metre": 1.0, "mm": 1e-3},
        "m/s": {"m/s": 1.0, "mm/s": 1e-3},
        "N m": {"N m|Nm|N*m|N.m|N·m": 1.0, "mNm": 1e-3},
        "N": {"N": 1.0, "kN": 1e3},
        "V": {"V": 1.0, "mV": 1e-3},
        "°C": {"°C|C|degC|celsius": 1.0},
    }.items()
    for names, size in sizes.items()
    for name in names.split("|")
}
"""The base unit of each, and how many of that it is."""

SECONDS = {
    **dict.fromkeys(("s", "sec", "secs", "second", "seconds"), 1.0),
    **dict.fromkeys(("ms", "msec", "millis", "milliseconds"), 1e-3),
    **dict.fromkeys(("us", "µs", "usec", "micros", "microseconds"), 1e-6),
    **dict.fromkeys(("ns", "nsec", "nanos", "nanoseconds"), 1e-9),
}
"""Seconds in one, by the unit behind the name of a clock."""

# Names of columns that count rows.
COUNTERS = ("", "index", "idx", "num", "no", "no.", "row", "seq", "frame", "frame_index", "unnamed: 0")

_OF = r"(?:elapsed|rel|relative|ros|unix|epoch|sys|system|robot|controller|host|log|utc|sample|recording)"
_WHAT = r"(?:time[ _]?stamps?|time|stamp|date[ _]?time|date)"
_UNIT = "|".join(sorted(map(re.escape, SECONDS), key=len, reverse=True))
CLOCK = re.compile(
    rf"[%_#\s]*(?:(?:.*[./])?(?:header[._])?(?:{_OF}[ _]?)?{_WHAT}|t)(?:[ _.]*[\[(]?\s*(?P<unit>{_UNIT})\s*[\])]?)?",
    re.I,
)


def _word(words: str) -> re.Pattern[str]:
    """A name in which one of these words stands by itself."""
    return re.compile(rf"(.*[^a-z])?({words})([^a-z].*)?", re.I)


LABEL = _word("labels?|anomal(y|ies|ous)|faults?|faulty|failures?|protective_?stop|grip_?lost")
COMMAND = _word("target|desired|cmd|commands?|commanded|set_?points?|goal|ref|reference|action")
SPEED = _word("vel|velocity|velocities|speeds?|qd|dq|qvel|joint_vel")
POSITION = _word("pos|position|positions|angles?|q|qpos|joint_pos")

ELEMENT = re.compile(r"(?P<stem>.*[^\W\d_])(?:\[(?P<named>\w+)\]|[_.]?(?P<number>\d+))")
"""One of several numbers of a channel: ``joint[0]``, ``joint_0``, ``position[elbow]``."""

_WITH_UNIT = re.compile(r"(?P<name>.*\S)\s+[\[(](?P<unit>[^\[\]()]+)[\])]")


def split_unit(column: str) -> tuple[str, str]:
    """Return a column's name and unit: ``joint_0`` and ``rad`` of ``joint_0 [rad]``; the unit may be empty."""
    found = _WITH_UNIT.fullmatch(column)
    return (found["name"], found["unit"]) if found else (column, "")


def ratio(unit: str, other: str) -> float | None:
    """Return how many of ``other`` are in one ``unit``; None where the two do not measure the same."""
    if unit == other:
        return 1.0
    if unit not in UNITS or other not in UNITS or UNITS[unit][0] != UNITS[other][0]:
        return None
    return UNITS[unit][1] / UNITS[other][1]


def factor(name: str, own: str, unit: str) -> float:
    """Return how many of ``unit`` are in a column's ``own`` one; 1 where either is unknown, ValueError if unlike."""
    found = 1.0 if not own or unit == "1" else ratio(own, unit)
    if found is None:
        raise ValueError(f"{name} is in {own}, and the memory reads {unit}")
    return found


@cache
def label_of(name: str) -> str:
    """Return what a stream calls the number of a column: ``joint[0]`` of ``joint_0``."""
    found = ELEMENT.fullmatch(name)
    return f"{found['stem']}[{found['named'] or found['number']}]" if found else name


def is_clock(name: str) -> bool:
    """Tell whether a column holds times. A bare ``T`` is a temperature."""
    return name.strip() != "T" and CLOCK.fullmatch(name.strip()) is not None


def is_label(name: str, patterns: Sequence[str] = ()) -> bool:
    """Tell whether a column says what is wrong, and senses nothing."""
    return LABEL.fullmatch(name) is not None or any(fnmatchcase(name, pattern) for pattern in patterns)


def is_command(name: str) -> bool:
    """Tell whether a column was commanded and not sensed."""
    return COMMAND.fullmatch(name) is not None


def is_counter(name: str, values: NDArray[Any]) -> bool:
    """Tell whether a column (T,) counts rows: each is one more than the one before, but for rows that were lost."""
    if name.lower() not in COUNTERS or len(values) < 2 or values.dtype.kind not in "biuf":
        return False
    steps = np.diff(values.astype(np.float64))
    return bool((steps >= 1).all() and (steps == np.rint(steps)).all() and np.median(steps) == 1)


def role_of(column: str, values: NDArray[Any], labels: Sequence[str] = ()) -> str:
    """Return the role of a column (T,): clock, label, words, counter, command or sense; ``labels`` are patterns."""
    name, _ = split_unit(column)
    if is_clock(column):
        return "clock"
    if is_label(name, labels):
        return "label"
    if values.dtype.kind not in "biuf":
        return "words"
    if is_counter(name, values):
        return "counter"
    return "command" if is_command(name) else "sense"
