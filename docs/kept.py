"""The output of a check, rounded so that it can be kept, and compared within a tolerance on another machine."""

from __future__ import annotations

import math
import re

TOLERANCE = 0.05
"""Relative; one unit of a number's last digit is allowed beside it."""
DIGITS = 3
"""Significant ones that are kept."""
_NUMBER = re.compile(r"(?<![\w.])[-+]?\d+(?:\.\d+)?(?![\w.]*\d)")


def rounded(text: str) -> str:
    """``text`` with every number rounded, without rules, frames and spaces that only make it even."""
    lines = (" ".join(word for word in line.split() if re.search(r"\w", word)) for line in text.splitlines())
    return "\n".join(_NUMBER.sub(lambda m: _rounded(m[0]), line) for line in lines if line)


def _rounded(number: str) -> str:
    value, decimals = float(number), len(number.partition(".")[2])
    if not value:
        return number
    places = min(decimals, DIGITS - 1 - math.floor(math.log10(abs(value))))
    return f"{round(value, places):.{max(places, 0)}f}" if decimals or places < 0 else number


def different(was: str, now: str, tolerance: float = TOLERANCE) -> list[str]:
    """Pairs of lines, ``- was`` and ``+ now``, that differ by more than the tolerance; empty where all is as it was."""
    before, after = rounded(was).splitlines(), rounded(now).splitlines()
    found = []
    for i in range(max(len(before), len(after))):
        old, new = (lines[i] if i < len(lines) else "" for lines in (before, after))
        if not _agree(old, new, tolerance):
            found += [f"- {old}", f"+ {new}"]
    return found


def _agree(old: str, new: str, tolerance: float) -> bool:
    if _NUMBER.sub("0", old) != _NUMBER.sub("0", new):
        return False
    pairs = zip(_NUMBER.findall(old), _NUMBER.findall(new), strict=True)
    return all(
        abs(float(a) - float(b)) <= max(min(_unit(a), _unit(b)), tolerance * _larger(a, b)) * (1 + 1e-9)
        for a, b in pairs
    )


def _unit(number: str) -> float:
    return float(10 ** -len(number.partition(".")[2]))


def _larger(a: str, b: str) -> float:
    return max(abs(float(a)), abs(float(b)))
