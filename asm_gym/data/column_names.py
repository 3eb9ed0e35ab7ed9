"""Read the name of a column: its unit, its channel, and whether it is a clock, a label or a command by name."""

from __future__ import annotations

import math
import re
from functools import cache
from typing import NamedTuple

TAU = 2 * math.pi
BASE_UNITS = {
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
LONGER = (
    SECONDS
    | dict.fromkeys(("min", "minutes"), 60.0)
    | dict.fromkeys(("h", "hours"), 3600.0)
    | dict.fromkeys(("d", "days"), 86400.0)
)
"""Those that stand in brackets: an ``angle_min`` holds no minutes."""

COUNTERS = {"", "index", "idx", "num", "no", "no.", "row", "seq", "frame", "frame_index"}
COUNTERS |= {"unnamed: 0", "__index_level_0__"}  # of pandas, the latter in Parquet
"""Names of columns that count rows."""

TURN = {"deg": 360.0, "°": 360.0, "degree": 360.0, "degrees": 360.0} | dict.fromkeys(
    ("rad", "radian", "radians"), TAU
)
"""A whole turn, by the unit of an angle."""
TURNED_ELEMENTS = ("sin", "cos")  # elements of a channel that stands for an angle which turns over

_OF = (
    r"(?:elapsed|rel|relative|ros|unix|epoch|sys|system|robot|controller|host|log|utc|sample|"
    r"recording|record|recv|receive|received|publish|device|sim|wall)"
)
_WHAT = r"(?:time[ _]?stamps?|time|stamp|date[ _]?time|date|zeit(?:stempel)?|uhrzeit)"
_UNIT = "|".join(sorted(map(re.escape, SECONDS), key=len, reverse=True))
CLOCK_NAME = re.compile(
    rf"[%_#\s]*(?:(?:.*[./])?(?:header[._])?(?:{_OF}[ _]?)?{_WHAT}|t)"
    rf"(?:[ _.]*[\[(]?\s*(?P<unit>{_UNIT})\s*[\])]?)?",
    re.I,
)


def _word(words: str) -> re.Pattern[str]:
    """A name in which one of these words stands by itself."""
    return re.compile(rf"(.*[^a-z])?({words})([^a-z].*)?", re.I)


LABEL_NAME = _word(
    "labels?|anomal(y|ies|ous)|faults?|faulty|failures?|protective_?stop|"
    "grip_?lost|y_true|ground_?truth|outliers?"
)
COMMAND_NAME = _word(
    "target|desired|des|cmd|commands?|commanded|set_?points?|goal|ref|reference|actions?|"
    "control_output|"  # of UR's joints
    "(d?tau_J|tau|d{0,2}q|elbow|O_T_EE|O_dP_EE)_d"  # of Franka's libfranka
)
_SPEEDS = "vel|velocity|velocities|speeds?|qd|dq|qvel|joint_vel"
_PLACES = "pos|position|positions|angles?|q|qpos|joint_pos"
SPEED_NAME = _word(_SPEEDS)
POSITION_NAME = _word(_PLACES)

SENSE_NAME = _word(
    f"{_PLACES}|{_SPEEDS}|forces?|torques?|wrench|efforts?|currents?|tau|"
    "temperatures?|voltages?|pressures?"
)

_ELEMENT = re.compile(
    r"(?P<of>.+)\[(?P<named>[\w./ -]+)\]|(?P<stem>.*[^\W\d_])[_.]?(?P<number>\d+)"
)

_WITH_UNIT = re.compile(r"(?P<name>.*\S)\s+[\[(](?P<unit>[^\[\]()]+)[\])]")
_UNIT_AT_ONCE = re.compile(r"(?P<name>.*\S)[\[(](?P<unit>[^\[\]()]+)[\])]")  # q1(deg)
_UNIT_BEHIND = re.compile(r"(?P<name>.+)_(?P<unit>deg|rad|mm|Nm|mA|rpm)")  # q1_deg


class Element(NamedTuple):
    """One of several numbers of a channel: ``joint[0]``, ``joint_0``, ``position[elbow]``."""

    channel: str
    name: str
    named: bool  # in brackets: a number behind a name may be no element


@cache
def element_of(name: str) -> Element | None:
    """Return the channel and the element that a name says; None where it says none."""
    match = _ELEMENT.fullmatch(name)
    if match is None:
        return None
    if match["named"] is None:
        return Element(match["stem"], match["number"], named=False)
    return Element(match["of"], match["named"], named=True)


@cache
def split_unit(column: str) -> tuple[str, str]:
    """Return a column's name and unit: ``joint_0`` and ``rad`` of ``joint_0 [rad]``.

    The unit may be empty. ``q1(deg)`` and ``q1_deg`` say it too; ``yaw_deg``, which is no element
    of a channel, keeps its name.
    """
    if match := _WITH_UNIT.fullmatch(column):
        return match["name"], match["unit"]
    match = _UNIT_AT_ONCE.fullmatch(column)
    if match and (match["unit"] in BASE_UNITS or match["unit"] in SECONDS):
        return match["name"], match["unit"]
    match = _UNIT_BEHIND.fullmatch(column)
    if match is None:
        return column, ""
    if element_of(match["name"]) is None:
        return column, match["unit"]
    return match["name"], match["unit"]


def element_name(column: str, element: object) -> str:
    """Return the name of an element of a column: ``q[2] [rad]`` of ``q [rad]``."""
    name, unit = split_unit(column)
    if unit:
        unit = f" [{unit}]"
    return f"{name}[{element}]{unit}"


def ratio(unit: str, other: str) -> float | None:
    """Return how many of ``other`` are in one ``unit``; None if they measure something else."""
    if unit == other:
        return 1.0
    if unit not in BASE_UNITS or other not in BASE_UNITS:
        return None
    base, size = BASE_UNITS[unit]
    other_base, other_size = BASE_UNITS[other]
    if base != other_base:
        return None
    return size / other_size


def factor(name: str, own: str, unit: str) -> float:
    """Return how many of ``unit`` are in a column's ``own`` one; 1 if either is unknown.

    Raises:
        ValueError: they measure something else.
    """
    if not own or unit == "1":
        return 1.0
    units = ratio(own, unit)
    if units is None:
        raise ValueError(f"{name} is in {own}, and the memory reads {unit}")
    return units


def label_of(name: str) -> str:
    """Return what a stream calls the number of a column: ``joint[0]`` of ``joint_0``."""
    element = element_of(name)
    if element is None:
        return name
    return f"{element.channel}[{element.name}]"


def is_clock(name: str) -> bool:
    """Tell whether a column holds times. A bare ``T`` is a temperature."""
    name = name.strip()
    bare, unit = split_unit(name)
    if bare == "T":
        return False
    if unit in LONGER:
        name = bare
    return CLOCK_NAME.fullmatch(name) is not None


def is_label(name: str) -> bool:
    """Tell whether a column is called as one that says what is wrong."""
    return LABEL_NAME.fullmatch(name) is not None


def is_command(name: str) -> bool:
    """Tell whether a column was commanded and not sensed."""
    return COMMAND_NAME.fullmatch(name) is not None
