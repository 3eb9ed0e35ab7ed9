"""Curves and points that the figures of the studies share."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes

from asm_gym.evaluation.figures import look
from asm_gym.scripts.reproduce.kit import Record, over_seeds


def curve(ax: Axes, x: Sequence[float], found: Sequence[tuple[float, float]], i: int, label: str | None) -> None:
    """Draw the i-th curve: means over seeds with a band of a standard deviation, as ``over_seeds`` gives them."""
    mean, spread = np.array(found).T
    colour, line, marker = look(i)
    ax.plot(x, mean, color=colour, linestyle=line, marker=marker, markersize=4, label=label)
    ax.fill_between(x, mean - spread, mean + spread, color=colour, alpha=0.15, linewidth=0)


def curves(
    ax: Axes,
    records: Sequence[Record],
    value: str,
    x: tuple[str, Sequence[Any]],
    lines: Mapping[str, Record],
    **where: Any,
) -> None:
    """Draw a curve for each of ``lines``, over the values of what ``x`` names."""
    name, values = x
    for i, (label, line) in enumerate(lines.items()):
        found = [over_seeds(records, value, **{**where, **line, name: v}) for v in values]
        curve(ax, values, found, i, label)


def points(ax: Axes, x: Sequence[float], found: Sequence[tuple[float, float]], i: int, label: str) -> None:
    """Draw means over seeds with their standard deviations."""
    mean, spread = np.array(found).T
    ax.errorbar(x, mean, spread, fmt=look(i)[2], color=look(i)[0], markersize=4, linewidth=1, label=label)
