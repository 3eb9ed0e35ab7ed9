"""Convert between units that measure the same thing, and read the unit behind the name of a column."""

from __future__ import annotations

import math
import re

RADIAN, PER_SECOND, AMPERE, METRE = ("rad", 1.0), ("rad/s", 1.0), ("A", 1.0), ("m", 1.0)
NEWTON_METRE, CELSIUS = ("N m", 1.0), ("°C", 1.0)

UNITS: dict[str, tuple[str, float]] = {
    **dict.fromkeys(("rad", "radian", "radians"), RADIAN),
    **dict.fromkeys(("deg", "°", "degree", "degrees"), ("rad", math.pi / 180)),
    "rad/s": PER_SECOND,
    **dict.fromkeys(("deg/s", "°/s"), ("rad/s", math.pi / 180)),
    "rpm": ("rad/s", math.pi / 30),
    **dict.fromkeys(("A", "amp", "ampere", "amperes"), AMPERE),
    "mA": ("A", 1e-3),
    **dict.fromkeys(("m", "meter", "metre"), METRE),
    "mm": ("m", 1e-3),
    "m/s": ("m/s", 1.0),
    "mm/s": ("m/s", 1e-3),
    **dict.fromkeys(("Nm", "N m", "N*m", "N.m", "N·m"), NEWTON_METRE),
    "mNm": ("N m", 1e-3),
    "N": ("N", 1.0),
    "kN": ("N", 1e3),
    "V": ("V", 1.0),
    "mV": ("V", 1e-3),
    **dict.fromkeys(("C", "°C", "degC", "celsius"), CELSIUS),
}
"""The base unit of each, and how many of that it is."""

_WITH_UNIT = re.compile(r"(?P<name>.*\S)\s+[\[(](?P<unit>[^\[\]()]+)[\])]")


def ratio(unit: str, other: str) -> float | None:
    """Return how many of ``other`` are in one ``unit``; None where the two do not measure the same."""
    if unit == other:
        return 1.0
    if unit not in UNITS or other not in UNITS or UNITS[unit][0] != UNITS[other][0]:
        return None
    return UNITS[unit][1] / UNITS[other][1]


def factor(column: str, unit: str) -> float:
    """Return how many of ``unit`` are in one of the unit behind a column's name; 1 where either names none.

    Raises:
        ValueError: the two do not measure the same.
    """
    own = unit_of(column)
    found = 1.0 if not own or unit == "1" else ratio(own, unit)
    if found is None:
        raise ValueError(f"{bare_name(column)} is in {own}, and the memory reads {unit}")
    return found


def bare_name(column: str) -> str:
    """Return the name of a column without its unit: ``joint_0`` of ``joint_0 [rad]``."""
    found = _WITH_UNIT.fullmatch(column)
    return found["name"] if found else column


def unit_of(column: str) -> str:
    """Return the unit behind a name; empty where there is none."""
    found = _WITH_UNIT.fullmatch(column)
    return found["unit"] if found else ""
