"""Figures of detection and of scored episodes, as matplotlib Figures that :func:`save` writes.

Nothing touches pyplot's state. Colours are those of Okabe & Ito, distinct with any colour vision; line styles and
markers differ too.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from matplotlib.ticker import LogLocator, NullFormatter
from numpy.typing import NDArray

from asm_gym.data.column_behaviour import is_constant
from asm_gym.data.episode import spans
from asm_gym.data.inspection import Inspection
from asm_gym.data.log_column import LogColumn
from asm_gym.data.tables import is_numeric
from asm_gym.evaluation.scored_episode import ScoredEpisode
from asm_gym.files import written_whole

BLUE, VERMILLION, GREEN, PURPLE = "#0072B2", "#D55E00", "#009E73", "#CC79A7"
ORANGE, SKY, BLACK, GREY = "#E69F00", "#56B4E9", "#000000", "#888888"
DASHED = (0, (4, 2))
_COLOURS = (BLUE, VERMILLION, GREEN, PURPLE, BLACK, SKY)
_LINES: tuple[Any, ...] = (
    "-",
    (0, (6, 2)),
    (0, (2, 1.5)),
    (0, (6, 2, 1, 2)),
    (0, (1, 1)),
    (0, (8, 2, 2, 2, 2, 2)),
)
_MARKERS = ("o", "s", "^", "D", "v", "P")
_STYLE: dict[Any, Any] = {
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.edgecolor": "#555555",
    "axes.titlesize": 10,
    "axes.titlelocation": "left",
    "grid.color": "#dddddd",
    "grid.linewidth": 0.6,
    "legend.frameon": False,
}


@contextmanager
def figure(height: float, width: float = 8.0) -> Iterator[Figure]:
    """Make a figure in the style above, whatever the user's matplotlibrc says; sizes in [in]."""
    with mpl.rc_context():
        mpl.rcdefaults()
        mpl.rcParams.update(_STYLE)
        yield Figure(figsize=(width, height), layout="constrained")


def save(fig: Figure, path: str | Path) -> Path:
    """Write a PNG at 150 dpi; the same figure gives the same bytes."""
    path = Path(path)
    with written_whole(path) as file:
        fig.savefig(file, format="png", dpi=150, metadata={"Software": None})
    return path


def look(i: int) -> tuple[str, Any, str]:
    """Return colour, line style and marker of the i-th curve."""
    n = len(_COLOURS)
    return _COLOURS[i % n], _LINES[(i + i // n) % n], _MARKERS[(i + i // n) % n]


def surprise_figure(traces: Sequence[ScoredEpisode]) -> Figure:
    """Draw surprise over time, one panel per episode: the threshold, the fault's span, the alarms."""
    if not traces:
        raise ValueError("there are no traces to draw")
    floor, ceiling = _limits(traces)
    with figure(height=0.9 + 1.35 * len(traces)) as fig:
        panels = fig.subplots(len(traces), 1, sharex=True, sharey=True, squeeze=False)[:, 0]
        for ax, trace in zip(panels, traces, strict=True):
            _surprise_panel(ax, trace)
        longest = 1.01 * max(len(t) * t.dt for t in traces)
        panels[0].set(yscale="log", ylim=(floor / 1.5, ceiling * 5), xlim=(0, longest))
        panels[0].yaxis.set_major_locator(LogLocator(numticks=5))
        panels[0].yaxis.set_minor_formatter(NullFormatter())
        panels[-1].set_xlabel("time [s]")
        fig.supylabel("surprise", fontsize=10)
        handles: list[Any] = [
            Line2D([], [], color=BLACK, linewidth=1, linestyle=DASHED, label="threshold"),
            Line2D([], [], color=VERMILLION, linewidth=4, solid_capstyle="butt", label="in alarm"),
        ]
        if any(t.onset is not None or (t.fault is not None and t.fault.any()) for t in traces):
            handles.insert(1, Patch(color=ORANGE, alpha=0.3, label="fault active"))
        if any(trace.missing.any() for trace in traces):
            handles.append(Patch(color=GREY, alpha=0.5, label="missing data"))
        fig.legend(handles=handles, loc="outside upper center", ncols=len(handles))
    return fig


def _surprise_panel(ax: Axes, trace: ScoredEpisode) -> None:
    for start, stop in spans(trace.missing):
        ax.axvspan(start * trace.dt, stop * trace.dt, color=GREY, alpha=0.5, linewidth=0)
    ax.plot(_times(trace), np.clip(trace.surprise, *_limits([trace])), color=BLUE, linewidth=1.5)
    ax.axhline(trace.threshold, color=BLACK, linewidth=1, linestyle=DASHED)
    _shade_fault(ax, trace)
    if trace.onset is not None:
        ax.axvline(trace.onset * trace.dt, color=ORANGE, linewidth=1.5)
    for ends in _alarm_times(trace):
        top = ax.get_xaxis_transform()
        ax.plot(
            ends, [0.96, 0.96], color=VERMILLION, linewidth=4, solid_capstyle="butt", transform=top
        )
    late = "" if trace.delay is None else f": alarm {1e3 * trace.delay:.0f} ms after the onset"
    missed = ": missed" if trace.onset is not None and trace.delay is None else ""
    place = f" in {trace.task}" if trace.task else ""
    ax.set_title(f"{trace.condition}{place}{late}{missed}")
    ax.grid(axis="y")


def stream_figure(trace: ScoredEpisode, top: int = 4) -> Figure:
    """Draw the ``top`` channels that surprised most, faults and alarms shaded; raise ValueError without a stream."""
    if trace.stream is None or trace.attribution is None:
        raise ValueError("this trace was kept without its stream")
    share = np.nan_to_num(trace.attribution[trace.onset or 0 :], posinf=1e30)
    rows = np.argsort(-share.max(axis=0), kind="stable")[:top]
    with figure(height=1.0 + 1.15 * len(rows)) as fig:
        axes = fig.subplots(len(rows), sharex=True, squeeze=False)[:, 0]
        for ax, row in zip(axes, rows, strict=True):
            _shade_fault(ax, trace)
            for ends in _alarm_times(trace):
                ax.axvspan(*ends, color=VERMILLION, alpha=0.2, linewidth=0)
            sensed = trace.stream[:, row]
            ax.plot(_times(trace), np.where(np.isfinite(sensed), sensed, np.nan), color=BLUE)
            ax.set_title(trace.channels[row])
        axes[-1].set_xlabel("time [s]")
        handles = [
            Line2D([], [], color=BLUE, label="sensed"),
            Patch(color=VERMILLION, alpha=0.2, label="alarm"),
        ]
        fig.legend(handles=handles, loc="outside right upper", ncols=2)
    return fig


def _times(trace: ScoredEpisode) -> Any:
    """Return when each row was known [s]: at the end of its step."""
    return (np.arange(len(trace)) + 1) * trace.dt  # (T,)


def _alarm_times(trace: ScoredEpisode) -> list[tuple[float, float]]:
    return [
        ((start + 1) * trace.dt, min(stop + 1, len(trace)) * trace.dt)
        for start, stop in spans(trace.alarm)
    ]


def _shade_fault(ax: Axes, trace: ScoredEpisode) -> None:
    for start, stop in () if trace.fault is None else spans(trace.fault):
        ax.axvspan(start * trace.dt, stop * trace.dt, color=ORANGE, alpha=0.3, linewidth=0)


def _limits(traces: Sequence[ScoredEpisode]) -> tuple[float, float]:
    """Return the range of surprise worth drawing: a log axis can show neither zero nor infinity."""
    thresholds = [t.threshold for t in traces]
    if not min(thresholds) > 0:
        raise ValueError(f"a log axis needs thresholds > 0, got {sorted(thresholds)}")
    finite = np.concatenate([t.surprise[np.isfinite(t.surprise)] for t in traces])
    ceiling = max(float(finite.max(initial=0.0)), 10 * max(thresholds))
    return min(
        max(float(finite.min(initial=np.inf)), min(thresholds) / 1000), ceiling / 10
    ), ceiling


# panels side by side; channels drawn; points of a curve
ACROSS, MOST_PANELS, MOST_POINTS = (
    4,
    60,
    4000,
)

LOG_COLOURS = {"sense": BLUE, "command": GREEN, "label": VERMILLION}
"""By the role of a channel; one that never moves is grey."""


def log_figure(found: Inspection) -> Figure:
    """Draw a panel per channel, with its gaps shaded."""
    drawn = [
        (column, found.table[header])
        for header, column in found.columns.items()
        if column.role in LOG_COLOURS and is_numeric(found.table[header])
    ]
    more = (
        f"; {len(drawn) - MOST_PANELS} more channels are in the table"
        if len(drawn) > MOST_PANELS
        else ""
    )
    drawn = drawn[:MOST_PANELS]
    down = math.ceil(max(len(drawn), 1) / ACROSS)
    with figure(height=0.7 + 1.25 * down, width=11.0) as fig:
        panels = fig.subplots(down, ACROSS, squeeze=False).ravel()
        for ax, (column, values) in zip(panels, drawn, strict=False):
            _column_panel(ax, found, column, values)
        for ax in panels:
            ax.title.set_fontsize(7)
            ax.tick_params(labelsize=6)
        for ax in panels[len(drawn) :]:
            ax.set_visible(False)
        fig.suptitle(f"{found.caption()}{more}", fontsize=10)
        fig.supxlabel("time [s]" if found.rate else "row", fontsize=9)
    return fig


def _column_panel(ax: Axes, found: Inspection, column: LogColumn, values: NDArray[Any]) -> None:
    """Draw the values (T,) of a column over time."""
    every = max(1, len(values) // MOST_POINTS)
    times, shown = found.times[::every], values[::every].astype(np.float64)
    after_gap = np.searchsorted(times, found.gaps[:, 1])  # no line is drawn across a gap
    still = is_constant(values)
    colour = GREY if still else LOG_COLOURS[column.role]
    ax.plot(
        np.insert(times, after_gap, np.nan),
        np.insert(shown, after_gap, np.nan),
        color=colour,
        linewidth=0.7,
    )
    for start, stop in found.gaps[:200]:
        ax.axvspan(start, stop, color=ORANGE, alpha=0.35, linewidth=0)
    lost = ~np.isfinite(values)
    if lost.any():
        ax.plot(
            found.times[lost],
            np.full(lost.sum(), np.nanmin(shown, initial=0.0)),
            "|",
            color=ORANGE,
            markersize=4,
        )
    name = column.name if len(column.name) < 30 else "…" + column.name[-29:]
    unit = f" [{column.unit}]" if column.unit else ""
    ax.set_title(f"{name}{unit}, {column.role}{', never moves' * still}")
    ax.margins(x=0)
