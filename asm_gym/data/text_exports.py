"""Refuse exports with decimal commas beside comma separators, as 0,02,-0,5 below t,q; name columns with units."""

from __future__ import annotations

import re
from collections.abc import Sequence

INTEGER = re.compile(r"\s*[-+]?\d+(e[-+]?\d+)?\s*", re.I)  # or half of a number cut at its comma
ROWS_CHECKED = 5  # rows that show whether decimals stand behind commas


def with_unit(name: str, unit: str) -> str:
    """Return the name of a column with its unit; ``(None)`` is no unit."""
    unit = unit.strip("()[] ")
    if not name or unit in ("", "None"):
        return name
    return f"{name} [{unit}]"


def check_export(lines: Sequence[str]) -> None:
    """Raise ValueError where the first lines of a file show that it must be exported in another way."""
    for number, line in enumerate(lines, 1):
        if _are_cut_at_decimals(line, lines[number : number + ROWS_CHECKED]):
            raise ValueError(
                "its numbers have decimal commas and are separated by commas: "
                "export it again with semicolons"
            )


def _are_cut_at_decimals(header: str, rows: Sequence[str]) -> bool:
    """Whether rows have about twice as many cells as the header, as each number is cut in two."""
    size = header.count(",") + 1
    if size == 1 or not rows:
        return False
    for row in rows:
        integers = list(filter(INTEGER.fullmatch, row.split(",")))
        if not 1.5 * size < len(integers) <= 2 * size:
            return False
    return True
