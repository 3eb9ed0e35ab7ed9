"""Figures of scored episodes: surprise over time, its attribution, and the sensed channels."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from matplotlib.ticker import LogLocator, NullFormatter

from asm_gym.episode import spans
from asm_gym.evaluation.figures.style import BLACK, BLUE, DASHED, GREY, ORANGE, VERMILLION, figure, require_some
from asm_gym.evaluation.scored_episode import ScoredEpisode, TraceDetail


def surprise_figure(traces: Sequence[ScoredEpisode]) -> Figure:
    """Draw surprise over time, one panel per episode: the threshold, the fault's span, the alarms."""
    require_some(traces)
    with figure(height=0.9 + 1.35 * len(traces)) as fig:
        panels = fig.subplots(len(traces), 1, sharex=True, sharey=True, squeeze=False)[:, 0]
        for ax, trace in zip(panels, traces, strict=True):
            _surprise_panel(ax, trace)
        floor, ceiling = limits(traces)
        panels[0].set(
            yscale="log", ylim=(floor / 1.5, ceiling * 5), xlim=(0, 1.01 * max(len(t) * t.dt for t in traces))
        )
        panels[0].yaxis.set_major_locator(LogLocator(numticks=5))
        panels[0].yaxis.set_minor_formatter(NullFormatter())
        panels[-1].set_xlabel("time [s]")
        fig.supylabel("surprise", fontsize=10)
        handles = [
            Line2D([], [], color=BLACK, linewidth=1, linestyle=DASHED, label="threshold"),
            Patch(color=ORANGE, alpha=0.3, label="fault active"),
            Line2D([], [], color=VERMILLION, linewidth=4, solid_capstyle="butt", label="in alarm"),
        ]
        fig.legend(handles=handles, loc="outside upper center", ncols=3)
    return fig


def _surprise_panel(ax: Axes, trace: ScoredEpisode) -> None:
    time = (np.arange(len(trace)) + 1) * trace.dt  # (T,) a row is known at the end of its step
    ax.plot(time, np.clip(trace.surprise, *limits([trace])), color=BLUE, linewidth=1.5)
    ax.axhline(trace.threshold, color=BLACK, linewidth=1, linestyle=DASHED)
    for start, stop in spans(trace.detail.fault) if trace.detail else []:
        ax.axvspan(start * trace.dt, stop * trace.dt, color=ORANGE, alpha=0.3, linewidth=0)
    if trace.onset is not None:
        ax.axvline(trace.onset * trace.dt, color=ORANGE, linewidth=1.5)
    for start, stop in spans(trace.alarm):
        ends = [(start + 1) * trace.dt, min(stop + 1, len(trace)) * trace.dt]
        top = ax.get_xaxis_transform()
        ax.plot(ends, [0.96, 0.96], color=VERMILLION, linewidth=4, solid_capstyle="butt", transform=top)
    late = "" if trace.delay is None else f": alarm {1e3 * trace.delay:.0f} ms after the onset"
    missed = ": missed" if trace.onset is not None and trace.delay is None else ""
    ax.set_title(f"{trace.title}{late}{missed}")
    ax.grid(axis="y")


def attribution_figure(trace: ScoredEpisode, top: int = 12) -> Figure:
    """Draw the shares of the ``top`` channels in the surprise over time, in units of the threshold."""
    detail = _detail(trace)
    share = detail.attribution / trace.threshold  # (T, D)
    # An infinite share takes the brightest finite colour, or it would leave all others dark.
    share = np.nan_to_num(share, nan=0.0, posinf=float(share[np.isfinite(share)].max(initial=1.0)), neginf=0.0)
    rows = np.argsort(-share[trace.onset or 0 :].max(axis=0), kind="stable")[:top]
    high = max(float(share[:, rows].max()), 1.0)
    with figure(height=1.5 + 0.24 * len(rows)) as fig:
        ax = fig.subplots()
        ends = (0.0, len(trace) * trace.dt, len(rows) - 0.5, -0.5)
        norm = LogNorm(min(0.01, high / 100), high)
        shown = np.clip(share[:, rows].T, norm.vmin, None)
        image = ax.imshow(shown, norm=norm, cmap="cividis", aspect="auto", extent=ends, interpolation="nearest")
        ax.set_yticks(range(len(rows)), [detail.channels[r] for r in rows])
        ax.set_xlabel("time [s]")
        ax.spines[:].set_visible(False)
        if trace.onset is not None:
            ax.axvline(trace.onset * trace.dt, color="white", linewidth=1.5)
            if trace.delay is not None:
                ax.axvline(trace.onset * trace.dt + trace.delay, color="white", linewidth=1.5, linestyle=DASHED)
        ax.set_title(f"{trace.title} (white: fault, alarm)")
        fig.colorbar(image, ax=ax, label="share of surprise / threshold", pad=0.02)
    return fig


def stream_figure(trace: ScoredEpisode, top: int = 4) -> Figure:
    """Draw the ``top`` channels that surprised most since the onset, beside the healthy twin.

    Without a known fault, as in a log, the rows in alarm are shaded.

    Raises:
        ValueError: the episode has no stream.
    """
    detail = _detail(trace)
    if detail.stream is None:
        raise ValueError("this trace was kept without its stream")
    share = np.nan_to_num(detail.attribution[trace.onset or 0 :], posinf=1e30)
    rows = np.argsort(-share.max(axis=0), kind="stable")[:top]
    time = (np.arange(len(trace)) + 1) * trace.dt
    with figure(height=1.0 + 1.15 * len(rows)) as fig:
        axes = fig.subplots(len(rows), sharex=True, squeeze=False)[:, 0]
        for ax, row in zip(axes, rows, strict=True):
            for start, stop in spans(detail.fault):
                ax.axvspan(start * trace.dt, stop * trace.dt, color=ORANGE, alpha=0.3, linewidth=0)
            for start, stop in spans(trace.alarm) if trace.onset is None else []:
                ends = (start + 1) * trace.dt, min(stop + 1, len(trace)) * trace.dt
                ax.axvspan(*ends, color=VERMILLION, alpha=0.2, linewidth=0)
            if detail.twin is not None:
                healthy = detail.twin[: len(trace), row]
                ax.plot(time[: len(healthy)], healthy, color=GREY, linestyle=DASHED)
            ax.plot(time, detail.stream[:, row], color=BLUE)
            if trace.delay is not None and trace.onset is not None:
                ax.axvline(trace.onset * trace.dt + trace.delay, color=BLACK, linewidth=1)
            ax.set_title(detail.channels[row])
        axes[-1].set_xlabel("time [s]")
        handles = [
            Line2D([], [], color=BLUE, label="sensed"),
            Line2D([], [], color=GREY, linestyle=DASHED, label="without the fault"),
            Patch(
                color=VERMILLION if trace.onset is None else ORANGE,
                alpha=0.3,
                label="alarm" if trace.onset is None else "fault",
            ),
        ]
        fig.legend(handles=handles, loc="outside upper right", ncols=3)
    return fig


def limits(traces: Sequence[ScoredEpisode]) -> tuple[float, float]:
    """Return the range of surprise worth drawing: a log axis can show neither zero nor infinity."""
    thresholds = [t.threshold for t in traces]
    if not min(thresholds) > 0:
        raise ValueError(f"a log axis needs thresholds > 0, got {sorted(thresholds)}")
    finite = np.concatenate([t.surprise[np.isfinite(t.surprise)] for t in traces])
    ceiling = max(float(finite.max(initial=0.0)), 10 * max(thresholds))
    return max(float(finite.min(initial=np.inf)), min(thresholds) / 1000), ceiling


def _detail(trace: ScoredEpisode) -> TraceDetail:
    if trace.detail is None:
        raise ValueError("this trace was kept without the detail that the figure needs")
    return trace.detail
