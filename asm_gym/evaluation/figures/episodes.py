"""Figures of watched episodes: surprise over time, where it came from, and what was sensed."""

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
from asm_gym.evaluation.figures.style import BLACK, BLUE, ORANGE, VERMILLION, figure, require_some, says
from asm_gym.evaluation.scored_episode import ScoredEpisode, TraceDetail


def surprise_figure(traces: Sequence[ScoredEpisode]) -> Figure:
    """Surprise over time, a panel a trace on common axes: the threshold, the fault's span and onset, the alarms."""
    require_some(traces)
    with figure(height=0.9 + 1.35 * len(traces)) as fig:
        panels = fig.subplots(len(traces), 1, sharex=True, sharey=True, squeeze=False)[:, 0]
        for ax, trace in zip(panels, traces, strict=True):
            _surprise_panel(ax, trace)
        floor, ceiling = limits(traces)
        panels[0].set_yscale("log")
        panels[0].set_ylim(floor / 1.5, ceiling * 5)  # the rug of alarms stands in the room at the top
        panels[0].yaxis.set_major_locator(LogLocator(numticks=5))
        panels[0].yaxis.set_minor_formatter(NullFormatter())
        panels[0].set_xlim(0, 1.01 * max(len(t) * t.dt for t in traces))
        panels[-1].set_xlabel("time [s]")
        fig.supylabel("surprise", fontsize=10)
        known = any(t.onset is not None or (t.detail is not None and t.detail.fault.any()) for t in traces)
        fig.legend(
            handles=[
                Line2D([], [], color=BLACK, linewidth=1, linestyle=(0, (4, 2)), label="threshold"),
                *([Patch(color=ORANGE, alpha=0.3, label="fault active")] if known else []),
                Line2D([], [], color=VERMILLION, linewidth=4, solid_capstyle="butt", label="in alarm"),
                Line2D([], [], color=VERMILLION, marker="v", linestyle="", label="alarm raised"),
            ],
            loc="outside upper center",
            ncols=4,
        )
    return fig


def _surprise_panel(ax: Axes, trace: ScoredEpisode) -> None:
    floor, ceiling = limits([trace])
    time = (np.arange(len(trace)) + 1) * trace.dt  # (T,) a row is known at the end of its step
    ax.plot(time, np.clip(trace.surprise, floor, ceiling), color=BLUE, linewidth=1.5)
    ax.axhline(trace.threshold, color=BLACK, linewidth=1, linestyle=(0, (4, 2)))
    for start, stop in spans(trace.detail.fault) if trace.detail else []:
        ax.axvspan(start * trace.dt, stop * trace.dt, color=ORANGE, alpha=0.3, linewidth=0)
    if trace.onset is not None:
        ax.axvline(trace.onset * trace.dt, color=ORANGE, linewidth=1.5)
    for start, stop in spans(trace.alarm):
        ends = [(start + 1) * trace.dt, min(stop + 1, len(trace)) * trace.dt]
        rug = ax.get_xaxis_transform()
        ax.plot(ends, [0.96, 0.96], color=VERMILLION, linewidth=4, solid_capstyle="butt", transform=rug)
        ax.plot(ends[0], 0.86, "v", color=VERMILLION, markersize=7, transform=rug)
    begun = np.append(0.0, time)
    says(ax, begun, [f"{t:.2f} s: surprise {s:.3g}, threshold {trace.threshold:.3g}" + ", in alarm" * bool(a)
                     for t, s, a in zip(time, trace.surprise, trace.alarm, strict=True)])  # fmt: skip
    late = "" if trace.delay is None else f": alarm {1e3 * trace.delay:.0f} ms after the onset"
    missed = ": missed" if trace.onset is not None and trace.delay is None else ""
    ax.set_title(f"{trace.title}{late}{missed}")
    ax.grid(axis="y", color="#dddddd", linewidth=0.6)


def attribution_figure(trace: ScoredEpisode, top: int = 12) -> Figure:
    """Where the surprise came from: the shares of the ``top`` channels over time, in units of the threshold."""
    detail = _detail(trace)
    share = detail.attribution / trace.threshold  # (T, D)
    # An infinite share takes the brightest finite colour, or it would leave all others dark.
    brightest = float(share[np.isfinite(share)].max(initial=1.0))
    share = np.nan_to_num(share, nan=0.0, posinf=brightest, neginf=0.0)
    rows = np.argsort(-share[trace.onset or 0 :].max(axis=0), kind="stable")[:top]
    high = max(float(share[:, rows].max()), 1.0)
    with figure(height=1.5 + 0.24 * len(rows)) as fig:
        ax = fig.subplots()
        ends = (0.0, len(trace) * trace.dt, len(rows) - 0.5, -0.5)
        norm = LogNorm(min(0.01, high / 100), high)
        image = ax.imshow(
            np.clip(share[:, rows].T, norm.vmin, None), norm=norm, cmap="cividis", aspect="auto", extent=ends,
            interpolation="nearest",
        )  # fmt: skip
        ax.set_yticks(range(len(rows)), [detail.channels[r] for r in rows])
        ax.set_xlabel("time [s]")
        ax.spines[:].set_visible(False)
        marks = [(trace.onset * trace.dt, "fault")] if trace.onset is not None else []
        if trace.onset is not None and trace.delay is not None:
            marks.append((trace.onset * trace.dt + trace.delay, "alarm"))
        for i, (at, text) in enumerate(marks):
            ax.axvline(at, color="white", linewidth=1.5, linestyle=("-", (0, (3, 2)))[i])
            side = "right" if i == 0 and len(marks) == 2 else "left"
            ax.annotate(text, (at, -0.5), (0, 4), textcoords="offset points", ha=side, weight="bold")
        ax.set_title(trace.title, pad=18)
        fig.colorbar(image, ax=ax, label="share of surprise / threshold", pad=0.02)
    return fig


def stream_figure(trace: ScoredEpisode, top: int = 4) -> Figure:
    """What was sensed by the ``top`` channels that surprised most since the onset, beside the healthy twin.

    Where no fault is known, as in a log, the rows in alarm are shaded.

    Raises:
        ValueError: the trace has no stream.
    """
    detail = _detail(trace)
    if detail.stream is None:
        raise ValueError("this trace was kept without its stream")
    share = np.nan_to_num(detail.attribution[trace.onset or 0 :], posinf=1e30)
    rows = np.argsort(-share.max(axis=0), kind="stable")[:top]
    time = (np.arange(len(trace)) + 1) * trace.dt
    with figure(height=1.0 + 1.15 * len(rows)) as fig:
        axes = fig.subplots(len(rows), sharex=True, squeeze=False)[:, 0]
        for i, (ax, row) in enumerate(zip(axes, rows, strict=True)):
            for start, stop in spans(detail.fault):
                label = "fault" if i == 0 else None
                ax.axvspan(start * trace.dt, stop * trace.dt, color="#f3d9a4", linewidth=0, label=label)
            for k, (start, stop) in enumerate(spans(trace.alarm) if trace.onset is None else []):
                label = "in alarm" if i == k == 0 else None
                ends = (start + 1) * trace.dt, min(stop + 1, len(trace)) * trace.dt
                ax.axvspan(*ends, color=VERMILLION, alpha=0.2, linewidth=0, label=label)
            if detail.twin is not None:
                healthy = detail.twin[: len(trace), row]
                label = "without the fault" if i == 0 else None
                ax.plot(time[: len(healthy)], healthy, color="#666666", linestyle=(0, (4, 2)), label=label)
            ax.plot(time, detail.stream[:, row], color=BLUE, label="sensed" if i == 0 else None)
            if trace.delay is not None and trace.onset is not None:
                at = trace.onset * trace.dt + trace.delay
                ax.axvline(at, color=BLACK, linewidth=1, label="alarm" if i == 0 else None)
            ax.set_title(detail.channels[row], loc="left", fontsize=10)
        axes[-1].set_xlabel("time [s]")
        fig.legend(loc="outside upper right", ncols=4, frameon=False)
    return fig


def limits(traces: Sequence[ScoredEpisode]) -> tuple[float, float]:
    """The range of surprise worth drawing: a log axis can show neither zero nor infinity."""
    if not all(t.threshold > 0 for t in traces):
        raise ValueError(f"a log axis needs thresholds > 0, got {sorted({t.threshold for t in traces})}")
    finite = np.concatenate([t.surprise[np.isfinite(t.surprise)] for t in traces])
    thresholds = [t.threshold for t in traces]
    ceiling = max(float(finite.max(initial=0.0)), *(10 * th for th in thresholds))
    return max(float(finite.min(initial=np.inf)), min(thresholds) / 1000), ceiling


def _detail(trace: ScoredEpisode) -> TraceDetail:
    if trace.detail is None:
        raise ValueError("this trace was kept without the detail that the figure needs")
    return trace.detail
