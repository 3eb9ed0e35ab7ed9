"""Figures of detection and of scored episodes, as matplotlib Figures that :func:`save` writes.

Nothing touches pyplot's state. Colours are distinct with any colour vision; line styles and markers differ too.
"""

from __future__ import annotations

import math
import warnings
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
from matplotlib.ticker import FuncFormatter, LogLocator, MultipleLocator, NullFormatter
from numpy.typing import NDArray

from asm_gym.data.clock import date_of
from asm_gym.data.column_behaviour import is_constant
from asm_gym.data.inspection import Inspection
from asm_gym.data.log_column import LogColumn
from asm_gym.data.table_layout import is_numeric
from asm_gym.evaluation.incident_window import AlarmMoment
from asm_gym.evaluation.scored_episode import ScoredEpisode
from asm_gym.evaluation.statistics import Floats
from asm_gym.files import written_whole
from asm_gym.readings import spans

# Okabe and Ito 2008
BLUE = "#0072B2"
VERMILLION = "#D55E00"
GREEN = "#009E73"
PURPLE = "#CC79A7"
ORANGE = "#E69F00"
SKY = "#56B4E9"
BLACK = "#000000"
GREY = "#888888"
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
MOST_POINTS = 4000  # of a curve
MOST_SPANS = 1000  # of time that are told apart
MOST_TIMES = 6  # of day under an axis
ROUND_STEPS_S = (1, 2, 5, 10, 30, 60, 120, 300, 600, 1800, 3600, 7200, 14_400, 21_600, 43_200)
DAY_S = 86_400
_MARKERS = ("o", "s", "^", "D", "v", "P")
_ALARM_BAR: dict[str, Any] = {
    "color": VERMILLION,
    "linewidth": 4,
    "solid_capstyle": "butt",
}
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
    rounds = i // n
    style = (i + rounds) % n  # after each round of colours, other combinations
    return _COLOURS[i % n], _LINES[style], _MARKERS[style]


def surprise_figure(traces: Sequence[ScoredEpisode]) -> Figure:
    """Draw surprise over time, one panel per episode: the threshold, the fault's span, the alarms."""
    if not traces:
        raise ValueError("there are no traces to draw")
    floor, ceiling = _limits(traces)
    with figure(height=0.9 + 1.35 * len(traces)) as fig:
        # Logs of several days have no axis in common.
        origins = {trace.origin for trace in traces}
        panels = fig.subplots(len(traces), 1, sharex=len(origins) == 1, sharey=True, squeeze=False)[
            :, 0
        ]
        for ax, trace in zip(panels, traces, strict=True):
            _surprise_panel(ax, trace)
        longest = 1.01 * max(len(trace) * trace.dt for trace in traces)
        for ax, trace in zip(panels, traces, strict=True):
            ax.set_xlim(_start(trace), _start(trace) + longest)
        panels[0].set(yscale="log", ylim=(floor / 1.5, ceiling * 5))
        panels[0].yaxis.set_major_locator(LogLocator(numticks=5))
        panels[0].yaxis.set_minor_formatter(NullFormatter())
        _label_times([*panels], traces)
        fig.supylabel("surprise", fontsize=10)
        handles = _surprise_legend(traces)
        fig.legend(handles=handles, loc="outside upper center", ncols=len(handles))
    return fig


def guarded_figure(trace: ScoredEpisode) -> Figure:
    """Draw the surprise of one episode, its fault and alarms, and when the guard acted in the policy's place."""
    with figure(height=2.6) as fig:
        ax = fig.subplots()
        floor, ceiling = _limits([trace])
        _surprise_panel(ax, trace)
        handles = _surprise_legend([trace])
        if trace.overridden is not None:
            times = trace.dt * np.array(spans(trace.overridden))
            _shade(ax, times, BLUE, alpha=0.2)
            handles.append(Patch(color=BLUE, alpha=0.2, label="the guard acts"))
        ax.set(yscale="log", ylim=(floor / 1.5, ceiling * 5), xlabel="time [s]", ylabel="surprise")
        fig.legend(handles=handles, loc="outside upper center", ncols=len(handles))
    return fig


def _surprise_legend(traces: Sequence[ScoredEpisode]) -> list[Line2D | Patch]:
    handles: list[Line2D | Patch] = [
        Line2D([], [], color=BLACK, linewidth=1, linestyle=DASHED, label="threshold")
    ]
    if any(map(_has_fault, traces)):
        handles.append(Patch(color=ORANGE, alpha=0.3, label="fault active"))
    handles.append(Line2D([], [], **_ALARM_BAR, label="in alarm"))
    if any(trace.missing.any() for trace in traces):
        handles.append(Patch(color=GREY, alpha=0.5, label="missing data"))
    return handles


def _has_fault(trace: ScoredEpisode) -> bool:
    if trace.onset is not None:
        return True
    return trace.fault is not None and bool(trace.fault.any())


def _surprise_panel(ax: Axes, trace: ScoredEpisode) -> None:
    missing = _begin_and_end(trace, spans(trace.missing))
    _shade(ax, missing, GREY, alpha=0.5)
    floor, ceiling = _limits([trace])
    surprise = np.clip(trace.surprise, floor, ceiling)
    ax.plot(*_thinned(_times(trace), surprise), color=BLUE, linewidth=1.5)
    ax.axhline(trace.threshold, color=BLACK, linewidth=1, linestyle=DASHED)
    _shade_fault(ax, trace)
    title = trace.condition
    if trace.task:
        title += f" in {trace.task}"
    if trace.onset is not None:
        ax.axvline(_start(trace) + trace.onset * trace.dt, color=ORANGE, linewidth=1.5)
        if trace.delay is None:
            title += ": missed"
        else:
            title += f": alarm {1e3 * trace.delay:.0f} ms after the onset"
    for begin_and_end in _alarm_times(trace):
        ax.plot(begin_and_end, [0.96, 0.96], **_ALARM_BAR, transform=ax.get_xaxis_transform())
    ax.set_title(title)
    ax.grid(axis="y")


def stream_figure(trace: ScoredEpisode, top: int = 4) -> Figure:
    """Draw the ``top`` channels that surprised most, faults and alarms shaded; raise ValueError without a stream."""
    if trace.stream is None or trace.attribution is None:
        raise ValueError("this trace was kept without its stream")
    since_onset = trace.attribution[trace.onset or 0 :]
    largest = np.nan_to_num(since_onset, posinf=1e30).max(axis=0)  # (D,)
    channels = np.argsort(-largest, kind="stable")[:top]
    with figure(height=1.0 + 1.15 * len(channels)) as fig:
        axes = fig.subplots(len(channels), sharex=True, squeeze=False)[:, 0]
        for ax, channel in zip(axes, channels, strict=True):
            _shade_fault(ax, trace)
            _shade(ax, _alarm_times(trace), VERMILLION, alpha=0.2)
            sensed = trace.stream[:, channel]
            finite = np.where(np.isfinite(sensed), sensed, np.nan)
            ax.plot(*_thinned(_times(trace), finite), color=BLUE)
            ax.set_title(trace.channels[channel])
        _label_times([*axes], [trace] * len(axes))
        handles = [
            Line2D([], [], color=BLUE, label="sensed"),
            Patch(color=VERMILLION, alpha=0.2, label="alarm"),
        ]
        fig.legend(handles=handles, loc="outside right upper", ncols=2)
    return fig


def alarm_figure(moment: AlarmMoment, channel: str) -> Figure:
    """Draw the channel of an alarm in the second around it, sensed beside expected; small enough for a telephone."""
    with figure(height=2.1, width=4.2) as fig:
        ax = fig.subplots()
        ax.axvline(0.0, color=VERMILLION, linewidth=1.5, label="alarm")
        finite = np.where(np.isfinite(moment.sensed), moment.sensed, np.nan)
        ax.plot(moment.times, finite, color=BLUE, label="sensed")
        if np.isfinite(moment.expected).any():
            low = moment.expected - moment.plus_minus
            high = moment.expected + moment.plus_minus
            ax.fill_between(moment.times, low, high, color=GREEN, alpha=0.25, linewidth=0)
            ax.plot(moment.times, moment.expected, color=GREEN, linestyle=DASHED, label="expected")
        ax.set(xlabel="time from the alarm [s]", ylabel=moment.unit)
        ax.set_title(channel)
        ax.grid(axis="y")
        fig.legend(loc="outside lower center", ncols=3)
    return fig


def _start(trace: ScoredEpisode) -> float:
    """Return when the episode began, by its own clock [s]; 0 without one."""
    return trace.origin or 0.0


def _times(trace: ScoredEpisode) -> Floats:
    """Return when each row was known [s]: at the end of its step."""
    return _start(trace) + (np.arange(len(trace)) + 1) * trace.dt  # (T,)


def _label_times(panels: Sequence[Axes], traces: Sequence[ScoredEpisode]) -> None:
    """Label the time axis of each panel, and name it under the last: time of day where the log has dates."""
    label = "time [s]"
    for ax, trace in zip(panels, traces, strict=True):
        if date_of(_start(trace)):
            ax.xaxis.set_major_formatter(FuncFormatter(lambda stamp, _: date_of(stamp)[11:19]))
            ax.xaxis.set_major_locator(MultipleLocator(_round_step(*ax.get_xlim())))
            label = "time of day (UTC)"
    panels[-1].set_xlabel(label)


def _round_step(first: float, last: float) -> float:
    """Return the step of at most ``MOST_TIMES`` times of day between two stamps [s]."""
    least = (last - first) / MOST_TIMES
    for step in ROUND_STEPS_S:
        if step >= least:
            return step
    return DAY_S * math.ceil(least / DAY_S)


def _thinned(times: Floats, values: Floats) -> tuple[Floats, Floats]:
    """Return times and values (T,) of a curve; of a long one, the least and the greatest of each short span."""
    span = math.ceil(2 * len(values) / MOST_POINTS)
    if span <= 2:
        return times, values
    whole = len(values) // span * span
    spans_of_values = values[:whole].reshape(-1, span)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)  # a span may lack all its numbers
        ends = [np.nanmin(spans_of_values, axis=1), np.nanmax(spans_of_values, axis=1)]
    kept = np.append(np.stack(ends, axis=1).ravel(), values[whole:])
    kept_times = np.append(np.repeat(times[:whole:span], 2), times[whole:])
    return kept_times, kept


def _begin_and_end(trace: ScoredEpisode, rows: Sequence[tuple[int, int]]) -> Floats:
    """Return when spans (n, 2) of rows began and ended [s]."""
    return _start(trace) + trace.dt * np.array(rows)


def _alarm_times(trace: ScoredEpisode) -> Floats:
    """Return when each alarm began and ended (n, 2) [s]; those that no eye tells apart are one."""
    rows = np.array(spans(trace.alarm)).reshape(-1, 2) + 1
    is_apart = rows[1:, 0] - rows[:-1, 1] > len(trace) // MOST_SPANS
    begins = np.append(rows[:1, 0], rows[1:, 0][is_apart])
    ends = np.append(rows[:-1, 1][is_apart], rows[-1:, 1])
    rows = np.stack([begins, ends], axis=1)
    return _start(trace) + np.minimum(rows, len(trace)) * trace.dt


def _shade_fault(ax: Axes, trace: ScoredEpisode) -> None:
    if trace.fault is not None:
        times = _begin_and_end(trace, spans(trace.fault))
        _shade(ax, times, ORANGE, alpha=0.3)


def _shade(ax: Axes, times: Floats, color: str, alpha: float) -> None:
    """Shade some times (n, 2) [s]."""
    for start, end in times:
        ax.axvspan(start, end, color=color, alpha=alpha, linewidth=0)


def _limits(traces: Sequence[ScoredEpisode]) -> tuple[float, float]:
    """Return the range of surprise worth drawing: a log axis can show neither zero nor infinity."""
    thresholds = [trace.threshold for trace in traces]
    if not min(thresholds) > 0:
        raise ValueError(f"a log axis needs thresholds > 0, got {sorted(thresholds)}")
    finite = np.concatenate([t.surprise[np.isfinite(t.surprise)] for t in traces])
    ceiling = max(float(finite.max(initial=0.0)), 10 * max(thresholds))
    floor = max(float(finite.min(initial=np.inf)), min(thresholds) / 1000)
    return min(floor, ceiling / 10), ceiling


ACROSS = 4  # panels side by side
MOST_PANELS = 60  # channels drawn
MOST_GAPS = 200  # shaded in a panel
LONGEST_NAME = 30  # characters of a channel's name

LOG_COLOURS = {"sense": BLUE, "command": GREEN, "label": VERMILLION}
"""By the role of a channel; one that never moves is grey."""


def log_figure(inspection: Inspection) -> Figure:
    """Draw a panel per channel, with its gaps shaded."""
    columns = []
    for header, column in inspection.columns.items():
        if column.role in LOG_COLOURS and is_numeric(inspection.table[header]):
            columns.append((column, inspection.table[header]))
    title = inspection.caption()
    if len(columns) > MOST_PANELS:
        title += f"; {len(columns) - MOST_PANELS} more channels are in the table"
        del columns[MOST_PANELS:]

    rows = math.ceil(max(len(columns), 1) / ACROSS)
    with figure(height=0.7 + 1.25 * rows, width=11.0) as fig:
        panels = fig.subplots(rows, ACROSS, squeeze=False).ravel()
        for ax, (column, values) in zip(panels, columns, strict=False):
            _column_panel(ax, inspection, column, values)
        for ax in panels:
            ax.title.set_fontsize(7)
            ax.tick_params(labelsize=6)
        for ax in panels[len(columns) :]:
            ax.set_visible(False)
        fig.suptitle(title, fontsize=10)
        label = "row"
        if inspection.rate:
            label = "time [s]"
        fig.supxlabel(label, fontsize=9)
    return fig


def _column_panel(
    ax: Axes, inspection: Inspection, column: LogColumn, values: NDArray[Any]
) -> None:
    """Draw the values (T,) of a column over time."""
    every = max(1, len(values) // MOST_POINTS)
    times = inspection.times[::every]
    drawn = values[::every].astype(np.float64)
    # A NaN after each gap breaks the line.
    after_gap = np.searchsorted(times, inspection.gaps[:, 1])
    times_with_breaks = np.insert(times, after_gap, np.nan)
    values_with_breaks = np.insert(drawn, after_gap, np.nan)
    name = column.name
    if len(name) >= LONGEST_NAME:
        name = "…" + name[1 - LONGEST_NAME :]
    if column.unit:
        name += f" [{column.unit}]"
    title = f"{name}, {column.role}"
    colour = LOG_COLOURS[column.role]
    if is_constant(values):
        title += ", never moves"
        colour = GREY

    ax.plot(times_with_breaks, values_with_breaks, color=colour, linewidth=0.7)
    _shade(ax, inspection.gaps[:MOST_GAPS], ORANGE, alpha=0.35)
    is_lost = ~np.isfinite(values)
    if is_lost.any():
        bottom = np.full(is_lost.sum(), np.nanmin(drawn, initial=0.0))
        ax.plot(inspection.times[is_lost], bottom, "|", color=ORANGE, markersize=4)
    ax.set_title(title)
    ax.margins(x=0)
