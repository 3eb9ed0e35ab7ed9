"""The channels of a log over time, its gaps, and the steps of its clock."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray

from asm_gym.data.inspection import ChannelFound, Inspection, in_time
from asm_gym.evaluation.figures.style import BLUE, GREEN, GREY, ORANGE, VERMILLION, figure

ACROSS, MOST_PANELS, MOST_POINTS = 4, 60, 4000
"""Panels side by side; channels drawn; points of a curve."""

COLOURS = {"sense": BLUE, "command": GREEN, "label": VERMILLION}
"""By the role of a channel; one that never moves is grey."""


def log_figure(found: Inspection) -> Figure:
    """Draw a panel per channel, with its gaps shaded; the first one shows the steps of the clock."""
    columns = zip(found.channels, found.columns.values(), strict=False)
    drawn = [(channel, values) for channel, values in columns if channel.role in COLOURS and channel.rows]
    more = f"; {len(drawn) - MOST_PANELS} more channels are in the table" if len(drawn) > MOST_PANELS else ""
    drawn = drawn[:MOST_PANELS]
    down = math.ceil((len(drawn) + 1) / ACROSS)
    clock = found.clock
    with figure(height=0.7 + 1.25 * down, width=11.0) as fig:
        panels = fig.subplots(down, ACROSS, squeeze=False).ravel()
        _clock_panel(panels[0], found)
        for ax, (channel, values) in zip(panels[1:], drawn, strict=False):
            _channel_panel(ax, found, channel, values)
        for ax in panels:
            ax.title.set_fontsize(7)
            ax.tick_params(labelsize=6)
        for ax in panels[len(drawn) + 1 :]:
            ax.set_visible(False)
        rate = f"{clock.rate:.5g} Hz" if clock.rate else "no rate"
        about = f"{clock.rows} rows, {in_time(clock.seconds)}, {rate}, {len(clock.gaps)} gaps{more}"
        fig.suptitle(f"{found.name}: {about}", fontsize=10)
        fig.supxlabel("time [s]" if clock.rate else "row", fontsize=9)
    return fig


def _clock_panel(ax: Axes, found: Inspection) -> None:
    ax.set_title("steps of the clock [ms]")
    if not found.clock.column or not found.clock.rate:
        ax.text(0.5, 0.5, found.clock.trouble or "no clock", ha="center", va="center", fontsize=7, wrap=True)
        ax.set_axis_off()
        return
    usual = 1e3 / found.clock.rate
    ax.hist(np.clip(1e3 * np.diff(found.times), 0, 4 * usual), bins=60, color=BLUE, log=True)
    ax.axvline(usual, color=VERMILLION, linewidth=1)
    low, high = ax.get_xlim()
    ax.set_xlim(min(low, 0.95 * usual), max(high, 1.05 * usual))  # rounding is no jitter


def _channel_panel(ax: Axes, found: Inspection, channel: ChannelFound, values: NDArray[Any]) -> None:
    every = max(1, len(values) // MOST_POINTS)
    times, shown = found.times[::every].astype(np.float64), values[::every].astype(np.float64)
    after_gap = np.searchsorted(times, found.clock.gaps[:, 1])  # no line is drawn across a gap
    colour = GREY if channel.constant else COLOURS[channel.role]
    ax.plot(np.insert(times, after_gap, np.nan), np.insert(shown, after_gap, np.nan), color=colour, linewidth=0.7)
    for start, stop in found.clock.gaps[:200]:
        ax.axvspan(start, stop, color=ORANGE, alpha=0.35, linewidth=0)
    lost = ~np.isfinite(values)
    if lost.any():
        ax.plot(found.times[lost], np.full(lost.sum(), channel.low), "|", color=ORANGE, markersize=4)
    name = channel.name if len(channel.name) < 30 else "…" + channel.name[-29:]
    unit = f" [{channel.unit}]" if channel.unit else ""
    ax.set_title(f"{name}{unit}, {channel.role}{', never moves' * channel.constant}")
    ax.margins(x=0)
