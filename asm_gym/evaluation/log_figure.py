"""The channels of a log over time, its gaps, and the steps of its clock."""

from __future__ import annotations

import math

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from asm_gym.data.channels import Column
from asm_gym.data.inspection import Inspection, is_constant
from asm_gym.evaluation.figures import BLUE, GREEN, GREY, ORANGE, VERMILLION, figure

ACROSS, MOST_PANELS, MOST_POINTS = 4, 60, 4000
"""Panels side by side; channels drawn; points of a curve."""

COLOURS = {"sense": BLUE, "command": GREEN, "label": VERMILLION}
"""By the role of a channel; one that never moves is grey."""


def log_figure(found: Inspection) -> Figure:
    """Draw a panel per channel, with its gaps shaded; the first one shows the steps of the clock."""
    drawn = [c for c in found.columns if c.role in COLOURS and c.values.dtype.kind in "biuf"]
    more = f"; {len(drawn) - MOST_PANELS} more channels are in the table" if len(drawn) > MOST_PANELS else ""
    drawn = drawn[:MOST_PANELS]
    down = math.ceil((len(drawn) + 1) / ACROSS)
    with figure(height=0.7 + 1.25 * down, width=11.0) as fig:
        panels = fig.subplots(down, ACROSS, squeeze=False).ravel()
        _clock_panel(panels[0], found)
        for ax, column in zip(panels[1:], drawn, strict=False):
            _column_panel(ax, found, column)
        for ax in panels:
            ax.title.set_fontsize(7)
            ax.tick_params(labelsize=6)
        for ax in panels[len(drawn) + 1 :]:
            ax.set_visible(False)
        fig.suptitle(f"{found.caption()}{more}", fontsize=10)
        fig.supxlabel("time [s]" if found.clock.rate else "row", fontsize=9)
    return fig


def _clock_panel(ax: Axes, found: Inspection) -> None:
    ax.set_title("steps of the clock [ms]")
    if len(found.clock.times) < 2 or not found.clock.rate:
        ax.text(0.5, 0.5, found.clock.trouble or "no clock", ha="center", va="center", fontsize=7, wrap=True)
        ax.set_axis_off()
        return
    usual = 1e3 / found.clock.rate
    ax.hist(np.clip(1e3 * np.diff(found.clock.times), 0, 4 * usual), bins=60, color=BLUE, log=True)
    ax.axvline(usual, color=VERMILLION, linewidth=1)
    low, high = ax.get_xlim()
    ax.set_xlim(min(low, 0.95 * usual), max(high, 1.05 * usual))  # rounding is no jitter


def _column_panel(ax: Axes, found: Inspection, column: Column) -> None:
    values, clock = column.values, found.clock
    every = max(1, len(values) // MOST_POINTS)
    times, shown = clock.times[::every], values[::every].astype(np.float64)
    after_gap = np.searchsorted(times, clock.gaps[:, 1])  # no line is drawn across a gap
    colour = GREY if is_constant(column) else COLOURS[column.role]
    ax.plot(np.insert(times, after_gap, np.nan), np.insert(shown, after_gap, np.nan), color=colour, linewidth=0.7)
    for start, stop in clock.gaps[:200]:
        ax.axvspan(start, stop, color=ORANGE, alpha=0.35, linewidth=0)
    lost = ~np.isfinite(values)
    if lost.any():
        ax.plot(clock.times[lost], np.full(lost.sum(), np.nanmin(shown, initial=0.0)), "|", color=ORANGE, markersize=4)
    name = column.name if len(column.name) < 30 else "…" + column.name[-29:]
    unit = f" [{column.unit}]" if column.unit else ""
    ax.set_title(f"{name}{unit}, {column.role}{', never moves' * is_constant(column)}")
    ax.margins(x=0)
