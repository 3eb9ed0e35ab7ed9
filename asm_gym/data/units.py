"""Units that say the same thing: degrees and radians, amperes and milliamperes."""

from __future__ import annotations

import math

BASES = {
    **dict.fromkeys(("deg", "°", "degree", "degrees"), ("rad", math.pi / 180)),
    **dict.fromkeys(("rad", "radian", "radians"), ("rad", 1.0)),
    **dict.fromkeys(("deg/s", "°/s"), ("rad/s", math.pi / 180)),
    "rad/s": ("rad/s", 1.0),
    "rpm": ("rad/s", math.pi / 30),
    **dict.fromkeys(("A", "amp", "ampere", "amperes"), ("A", 1.0)),
    "mA": ("A", 1e-3),
    **dict.fromkeys(("m", "meter", "metre"), ("m", 1.0)),
    "mm": ("m", 1e-3),
    "m/s": ("m/s", 1.0),
    "mm/s": ("m/s", 1e-3),
    **dict.fromkeys(("Nm", "N m", "N*m", "N.m", "N·m"), ("N m", 1.0)),
    "mNm": ("N m", 1e-3),
    "N": ("N", 1.0),
    "kN": ("N", 1e3),
    "V": ("V", 1.0),
    "mV": ("V", 1e-3),
    **dict.fromkeys(("C", "°C", "degC", "celsius"), ("°C", 1.0)),
}
"""By the name of a unit, what it is made of, and how many of that are in one."""


def ratio(unit: str, other: str) -> float | None:
    """How many of ``other`` are in one ``unit``; None where the two do not measure the same."""
    if unit == other:
        return 1.0
    if unit not in BASES or other not in BASES or BASES[unit][0] != BASES[other][0]:
        return None
    return BASES[unit][1] / BASES[other][1]
