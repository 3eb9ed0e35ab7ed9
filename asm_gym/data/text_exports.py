"""Recognize exports of other tools whose text is no plain table.

TwinCAT Scope       rows of key and value for each channel; below, a time and a value for each channel: read
DIAdem              the text header of a binary log, which holds no rows: refused
decimal commas      beside comma separators, as 0,02,-0,5 below t,q: refused
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

SCOPE_KEYS = {"Name", "SampleTime[ms]", "Unit"}  # in the head of a TwinCAT Scope export
SCOPE_CLOCK = "time [ms]"
DIADEM = "DIAEXTENDED"  # begins the header of a binary log
DATA_FILE = "211,"  # begins the line of such a header that names the log
INTEGER = re.compile(r"\s*[-+]?\d+(e[-+]?\d+)?\s*", re.I)  # or half of a number cut at its comma
ROWS_CHECKED = 5  # rows that show whether decimals stand behind commas


def with_unit(name: str, unit: str) -> str:
    """Return the name of a column with its unit; ``(None)`` is no unit."""
    unit = unit.strip("()[] ")
    if not name or unit in ("", "None"):
        return name
    return f"{name} [{unit}]"


def scope_head(lines: Sequence[str]) -> tuple[int, list[str]]:
    """Return how many lines the head of a TwinCAT Scope export has, and the names of the columns below it.

    Args:
        lines: first lines of a file.

    Returns:
        A clock and a channel in turn, ``time [ms]`` and ``q1``; no names where it is another file.
    """
    fields: dict[str, list[str]] = {}
    for size, line in enumerate(lines):
        separator = max("\t;,", key=line.count)
        key, *values = line.split(separator)
        if not INTEGER.match(key):
            fields[key] = values[::2]
        elif fields.keys() >= SCOPE_KEYS:
            names = []
            for channel in map(with_unit, fields["Name"], fields["Unit"]):
                names.append(SCOPE_CLOCK)
                names.append(channel)
            return size, names
    return 0, []


def on_first_clock(columns: Sequence[NDArray[Any]]) -> list[NDArray[Any]]:
    """Return the newest values (T,) of each channel at the times of the first channel.

    Args:
        columns: times and values of each channel in turn; those of a slower channel end in NaN.

    Returns:
        The times of the first channel and the values of each channel, in turn.
    """
    clock = columns[0]
    clock = clock[np.isfinite(clock)]
    aligned = []
    for times, values in zip(columns[::2], columns[1::2], strict=True):
        newest = np.searchsorted(times, clock, side="right") - 1
        aligned.append(clock)
        aligned.append(np.where(newest < 0, np.nan, values[newest]))
    return aligned


def check_export(lines: Sequence[str]) -> None:
    """Raise ValueError where the first lines of a file show that it must be exported in another way."""
    files = {line.strip()[len(DATA_FILE) :] for line in lines if line.startswith(DATA_FILE)}
    for number, line in enumerate(lines, 1):
        if line.startswith(DIADEM):
            raise ValueError(
                "it is the text header of a binary log and holds no rows: "
                f"export the log, {' and '.join(files) or 'a file beside it'}, as CSV"
            )
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
