"""Figures of watched episodes: each function returns a matplotlib Figure, and nothing touches pyplot's state.

Colours are those of Okabe & Ito, chosen to be told apart with any colour vision; line styles and markers differ too.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter
from numpy.typing import NDArray

from asm_gym.evaluation.metrics import delays_ms, placements
from asm_gym.evaluation.statistics import wilson_interval
from asm_gym.evaluation.trace import NOMINAL, Trace, TraceDetail, spans

BLUE, VERMILLION, GREEN, PURPLE, ORANGE, SKY, BLACK = (
    "#0072B2",
    "#D55E00",
    "#009E73",
    "#CC79A7",
    "#E69F00",
    "#56B4E9",
    "#000000",
)
_COLOURS = (BLUE, VERMILLION, GREEN, PURPLE, BLACK, SKY)
_LINES: tuple[Any, ...] = ("-", (0, (6, 2)), (0, (2, 1.5)), (0, (6, 2, 1, 2)), (0, (1, 1)), (0, (8, 2, 2, 2, 2, 2)))
_MARKERS = ("o", "s", "^", "D", "v", "P")
_WIDTH = 8.0  # [in]
_STYLE: dict[Any, Any] = {
    "font.size": 10,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.edgecolor": "#555555",
    "axes.titlesize": 10,
    "axes.titlelocation": "left",
    "legend.frameon": False,
    "figure.facecolor": "white",
    "axes.facecolor": "white",
}


@contextmanager
def figure(height: float, width: float = _WIDTH) -> Iterator[Figure]:
    """A figure in the style above, whatever the user's matplotlibrc says; sizes in [in]."""
    with mpl.rc_context():
        mpl.rcdefaults()
        mpl.rcParams.update(_STYLE)
        yield Figure(figsize=(width, height), layout="constrained")


def save(fig: Figure, path: str | Path) -> Path:
    """Writes a PNG at 150 dpi; the same figure gives the same bytes."""
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    fig.savefig(path, format="png", dpi=150, metadata={"Software": None})
    return path


def surprise_figure(traces: Sequence[Trace]) -> Figure:
    """Surprise over time, a panel a trace on common axes: the threshold, the fault's span and onset, the alarms."""
    _require(traces)
    with figure(height=0.9 + 1.35 * len(traces)) as fig:
        panels = fig.subplots(len(traces), 1, sharex=True, sharey=True, squeeze=False)[:, 0]
        for ax, trace in zip(panels, traces, strict=True):
            _surprise_panel(ax, trace)
        floor, ceiling = _limits(traces)
        panels[0].set_yscale("log")
        panels[0].set_ylim(floor / 1.5, ceiling * 5)  # the rug of alarms stands in the room at the top
        panels[0].yaxis.set_major_locator(LogLocator(numticks=5))
        panels[0].yaxis.set_minor_formatter(NullFormatter())
        panels[0].set_xlim(0, 1.01 * max(len(t) * t.dt for t in traces))
        panels[-1].set_xlabel("time [s]")
        fig.supylabel("surprise", fontsize=10)
        fig.legend(
            handles=[
                Line2D([], [], color=BLACK, linewidth=1, linestyle=(0, (4, 2)), label="threshold"),
                Patch(color=ORANGE, alpha=0.3, label="fault active"),
                Line2D([], [], color=VERMILLION, linewidth=4, solid_capstyle="butt", label="in alarm"),
                Line2D([], [], color=VERMILLION, marker="v", linestyle="", label="alarm raised"),
            ],
            loc="outside upper center",
            ncols=4,
        )
    return fig


def _surprise_panel(ax: Axes, trace: Trace) -> None:
    floor, ceiling = _limits([trace])
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
    late = "" if trace.delay is None else f": alarm {1e3 * trace.delay:.0f} ms after the onset"
    missed = ": missed" if trace.onset is not None and trace.delay is None else ""
    ax.set_title(f"{trace.title}{late}{missed}")
    ax.grid(axis="y", color="#dddddd", linewidth=0.6)


def delay_figure(traces: Sequence[Trace], window_s: float) -> Figure:
    """The share of faults detected within so many ms of the onset, a curve a fault, with its 95 % Wilson band."""
    faults = _faults(traces)
    with figure(height=4.2) as fig:
        ax = fig.subplots()
        for i, (condition, group) in enumerate(faults.items()):
            delays = delays_ms(group, window_s)
            found = delays[np.isfinite(delays)]
            counts = np.concatenate([[0], np.arange(len(found)) + 1, [len(found)]])  # at 0, at each alarm, at the end
            x = np.concatenate([[0.0], found, [1e3 * window_s]])
            low, high = np.array([wilson_interval(int(k), len(delays)) for k in counts]).T
            colour, line, _ = look(i)
            label = f"{condition} ({len(found)} of {len(delays)})"
            ax.fill_between(x, 100 * low, 100 * high, step="post", color=colour, alpha=0.12, linewidth=0)
            ax.step(x, 100 * counts / len(delays), where="post", color=colour, linestyle=line, linewidth=2, label=label)
        ax.set(xlim=(0, 1e3 * window_s), ylim=(0, 102), xlabel="time since the onset of the fault [ms]")
        ax.set_ylabel("faults detected [%]")
        ax.grid(color="#dddddd", linewidth=0.6)
        fig.legend(loc="outside upper center", ncols=min(3, len(faults)), handlelength=3.5)
    return fig


def roc_figure(traces: Sequence[Trace], window_s: float) -> Figure:
    """ROC curves on the greatest surprise in the window, each fault against the same steps of the nominal episodes."""
    nominal = [t for t in traces if t.watched_only and t.condition == NOMINAL]
    if not nominal:
        raise ValueError("a ROC curve needs nominal traces")
    with figure(height=5.2, width=5.6) as fig:
        ax = fig.subplots()
        ax.plot([0, 100], [0, 100], color="#999999", linewidth=1)
        for i, (condition, group) in enumerate(_faults(traces).items()):
            values = np.sort(placements(group, nominal, window_s))
            if not values.size:
                continue
            colour, line, _ = look(i)
            x = np.concatenate([[0], values, [1]])
            y = np.concatenate([[0], np.arange(values.size) + 1, [values.size]]) / values.size
            label = f"{condition}: AUROC {1 - values.mean():.2f}"
            ax.step(
                100 * x, 100 * y, where="post", color=colour, linestyle=line, linewidth=2, label=label, clip_on=False
            )
        ax.set(xlim=(0, 100), ylim=(0, 100), aspect="equal")
        ax.set_xlabel(f"nominal episodes above [%], n = {len(nominal)}")
        ax.set_ylabel("faulty episodes above [%]")
        ax.grid(color="#dddddd", linewidth=0.6)
        ax.legend(loc="lower right", handlelength=3.5, frameon=True, framealpha=0.9, edgecolor="none")
    return fig


def attribution_figure(trace: Trace, top: int = 12) -> Figure:
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


def stream_figure(trace: Trace, top: int = 4) -> Figure:
    """What was sensed by the ``top`` channels that surprised most since the onset, beside the healthy twin.

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


def maxima_figure(traces: Sequence[Trace], window_s: float) -> Figure:
    """The greatest surprise of every episode against the threshold: within the window after a fault, or of it all."""
    watched = [t for t in traces if t.watched_only]
    _require(watched)
    groups = {NOMINAL: [t for t in watched if t.condition == NOMINAL], **_faults(watched)}
    groups = {c: g for c, g in groups.items() if g}
    worst = {c: np.array([_peak(t, window_s) / t.threshold for t in g]) for c, g in groups.items()}  # (n,) each
    floor, ceiling = min(0.5, *(w.min() for w in worst.values())), max(2.0, *(w.max() for w in worst.values()))
    with figure(height=1.1 + 0.55 * len(groups)) as fig:
        ax = fig.subplots()
        per_decade = 72 * 5.5 / np.log10(ceiling / floor)  # [pt]
        for i, (condition, ratios) in enumerate(worst.items()):
            colour, _, marker = ("#666666", "", "o") if condition == NOMINAL else look(i - (NOMINAL in groups))
            offsets = _swarm(np.log10(ratios) * per_decade, size=5.5) / 40  # a row is 40 pt high
            ax.plot(ratios, i + offsets, marker, color=colour, markersize=5, alpha=0.8, mew=0)
            above = f"{(ratios > 1).sum()} of {len(ratios)} above"
            ax.annotate(above, (1.01, i), xycoords=("axes fraction", "data"), va="center", fontsize=9)
        ax.axvline(1.0, color=BLACK, linewidth=1, linestyle=(0, (4, 2)))
        ax.annotate("threshold", (1.0, 1.0), (0, 3), xycoords=("data", "axes fraction"), textcoords="offset points",
                    ha="center", fontsize=9)  # fmt: skip
        ax.set_xscale("log")
        ax.set(xlim=(floor / 1.3, ceiling * 1.3), ylim=(len(groups) - 0.5, -0.5))
        ax.xaxis.set_major_formatter(FuncFormatter(lambda v, _: f"{v:g}"))
        ax.set_yticks(range(len(groups)), list(groups))
        ax.tick_params(axis="y", length=0)
        ax.set_xlabel("greatest surprise / threshold")
        ax.grid(axis="x", color="#dddddd", linewidth=0.6)
    return fig


def _peak(trace: Trace, window_s: float) -> float:
    return float(np.clip(trace.surprise[trace.window(window_s)].max(), *_limits([trace])))


def _swarm(values: NDArray[np.float64], size: float) -> NDArray[np.float64]:
    """(n,) sideways offsets that keep dots of diameter ``size`` apart: each the nearest free place to the middle."""
    places = size / 4 * np.array(sorted(range(-12, 13), key=abs))
    offsets = np.zeros(len(values))
    for done, i in enumerate(order := np.argsort(values, kind="stable")):
        near = order[:done][values[i] - values[order[:done]] < size]
        free = [p for p in places if np.all(np.hypot(values[i] - values[near], p - offsets[near]) >= size)]
        offsets[i] = free[0] if free else places[done % len(places)]
    return offsets


def _limits(traces: Sequence[Trace]) -> tuple[float, float]:
    """The range of surprise worth drawing: a log axis can show neither zero nor infinity."""
    if not all(t.threshold > 0 for t in traces):
        raise ValueError(f"a log axis needs thresholds > 0, got {sorted({t.threshold for t in traces})}")
    finite = np.concatenate([t.surprise[np.isfinite(t.surprise)] for t in traces])
    thresholds = [t.threshold for t in traces]
    ceiling = max(float(finite.max(initial=0.0)), *(10 * th for th in thresholds))
    return max(float(finite.min(initial=np.inf)), min(thresholds) / 1000), ceiling


def _faults(traces: Sequence[Trace]) -> dict[str, list[Trace]]:
    """The watched traces with a fault, by condition in order of appearance."""
    _require(traces)
    faulty = [t for t in traces if t.watched_only and t.onset is not None]
    return {c: [t for t in faulty if t.condition == c] for c in dict.fromkeys(t.condition for t in faulty)}


def look(i: int) -> tuple[str, Any, str]:
    """Colour, line style and marker of the i-th curve."""
    n = len(_COLOURS)
    return _COLOURS[i % n], _LINES[(i + i // n) % n], _MARKERS[(i + i // n) % n]


def _detail(trace: Trace) -> TraceDetail:
    if trace.detail is None:
        raise ValueError("this trace was kept without the detail that the figure needs")
    return trace.detail


def _require(traces: Sequence[Trace]) -> None:
    if not traces:
        raise ValueError("there are no traces to draw")
