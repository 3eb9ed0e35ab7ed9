"""What a log holds, at a glance: every channel over time, where nothing came, and the steps of its clock."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray

from asm_gym.data.inspection import ChannelFound, Inspection, in_time
from asm_gym.evaluation.figures.style import BLACK, BLUE, GREEN, ORANGE, VERMILLION, figure

ACROSS = 4
"""Panels side by side."""

MOST_PANELS = 60
"""Channels drawn; the table holds them all."""

MOST_POINTS = 4000
"""Of a curve: more cannot be seen in a panel."""

COLOURS = {"sense": BLUE, "command": GREEN, "label": VERMILLION}
"""By what a channel is; one that never moves is grey."""

GREY = "#999999"

NARROW = 0.05
"""Steps of the clock are shown so much shorter and longer than usual at least: rounding is no jitter to look at."""


def log_figure(found: Inspection) -> Figure:
    """A panel a channel, gaps shaded; the first one shows how long steps of the clock are."""
    drawn = [c for c in found.channels if c.role in COLOURS and c.rows][:MOST_PANELS]
    down = math.ceil((len(drawn) + 1) / ACROSS)
    with figure(height=0.7 + 1.25 * down, width=11.0) as fig:
        panels = fig.subplots(down, ACROSS, squeeze=False).ravel()
        for ax in panels[len(drawn) + 1 :]:
            ax.set_visible(False)
        _steps(panels[0], found)
        named = {c.name: values for c, values in zip(found.channels, found.columns.values(), strict=False)}
        topics = {c.name.partition(".")[0] for c in drawn if "." in c.name} | {"" for c in drawn if "." not in c.name}
        cut = len(topics.pop()) if len(topics) == 1 else 0  # one topic goes without saying
        for ax, channel in zip(panels[1:], drawn, strict=False):
            _panel(ax, found, channel, named[channel.name], channel.name[cut:].lstrip("."))
        left_out = len([c for c in found.channels if c.role in COLOURS]) - len(drawn)
        more = f"; {left_out} more channels are in the table" if left_out else ""
        clock = found.clock
        rate = f"{clock.rate:.5g} Hz" if clock.rate else "no rate"
        fig.suptitle(
            f"{found.name}: {clock.rows} rows, {in_time(clock.seconds)}, {rate}, {len(clock.gaps)} gaps{more}",
            fontsize=10,
        )
        fig.supxlabel("time [s]" if clock.rate else "row", fontsize=9)
    return fig


def _steps(ax: Axes, found: Inspection) -> None:
    ax.set_title("steps of the clock [ms]", fontsize=8, color=BLACK)
    ax.tick_params(labelsize=7)
    if not found.clock.column or not found.clock.rate:
        ax.text(0.5, 0.5, found.clock.trouble or "no clock", ha="center", va="center", fontsize=7, wrap=True)
        ax.set_axis_off()
        return
    steps = 1e3 * np.diff(found.times)
    ax.hist(np.clip(steps, 0, 4e3 / found.clock.rate), bins=60, color=BLUE, log=True)
    usual = 1e3 / found.clock.rate
    ax.axvline(usual, color=VERMILLION, linewidth=1)
    low, high = ax.get_xlim()
    ax.set_xlim(min(low, (1 - NARROW) * usual), max(high, (1 + NARROW) * usual))


def _panel(ax: Axes, found: Inspection, channel: ChannelFound, values: NDArray[Any], name: str) -> None:
    apart = max(1, len(values) // MOST_POINTS)
    colour = GREY if channel.constant else COLOURS[channel.role]
    times, shown = found.times[::apart].astype(np.float64), values[::apart].astype(np.float64)
    across = np.searchsorted(times, found.clock.gaps[:, 1])  # no line is drawn where nothing came
    ax.plot(np.insert(times, across, np.nan), np.insert(shown, across, np.nan), color=colour, linewidth=0.7)
    for start, stop in found.clock.gaps[:200]:
        ax.axvspan(start, stop, color=ORANGE, alpha=0.35, linewidth=0)
    lost = ~np.isfinite(values)
    if lost.any():
        ax.plot(found.times[lost], np.full(lost.sum(), channel.low), "|", color=ORANGE, markersize=4)
    what = "" if channel.role == "sense" else f" ({channel.role})"
    unit = f" [{channel.unit}]" if channel.unit else ""
    still = ", never moves" if channel.constant else ""
    name = name if len(name) < 30 else "…" + name[-29:]
    ax.set_title(f"{name}{unit}{what}{still}", fontsize=7, color=BLACK)
    ax.tick_params(labelsize=6)
    ax.margins(x=0)
