"""Figures of detection: conditions of one monitor, or monitors side by side; they print in grey too."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter
from numpy.typing import NDArray

from asm_gym.evaluation.comparison import IDEAL
from asm_gym.evaluation.figures.episodes import limits
from asm_gym.evaluation.figures.style import BLACK, figure, look, require_some
from asm_gym.evaluation.metrics import DetectionMetrics, Kind, KindMetrics, delays_ms, in_words, placements
from asm_gym.evaluation.scored_episode import NOMINAL, ScoredEpisode
from asm_gym.evaluation.statistics import wilson_interval

MOST_BANDS = 4
"""Curves that may have a band of uncertainty each; of more, none could be told apart."""


def roc_figure(groups: Sequence[DetectionMetrics]) -> Figure:
    """ROC of each group over all its faults, each against nominal episodes of its task in the same steps."""
    faulty = _with_faults(groups)
    if not all(g.nominal for g in faulty):
        raise ValueError("a ROC curve needs nominal traces")
    with figure(height=4.6, width=8.4) as fig:
        ax = fig.subplots()
        ax.plot([0, 100], [0, 100], color="#999999", linewidth=1)
        for i, group in enumerate(faulty):
            u = np.sort(placements(group.faulty, group.nominal, group.window_s))
            if not u.size:
                continue
            colour, line, _ = look(i)
            x, y = np.concatenate([[0], u, [1]]), np.concatenate([[0], np.arange(u.size) + 1, [u.size]]) / u.size
            label = f"{group.name}: {1 - u.mean():.3f}"
            ax.step(
                100 * x, 100 * y, where="post", color=colour, linestyle=line, linewidth=2, label=label, clip_on=False
            )
        ax.set(xlim=(0, 100), ylim=(0, 100), box_aspect=1)
        ax.set_xlabel("nominal episodes above [%]")
        ax.set_ylabel("faulty episodes above [%]")
        ax.grid(color="#dddddd", linewidth=0.6)
        fig.legend(loc="outside right upper", handlelength=3.5, title="AUROC")
    return fig


def delay_figure(groups: Sequence[DetectionMetrics]) -> Figure:
    """The share of faults detected within so many ms of the onset; with 95 % Wilson bands, where curves are few."""
    faulty = _with_faults(groups)
    window_ms = 1e3 * max(g.window_s for g in faulty)
    with figure(height=4.4) as fig:
        ax = fig.subplots()
        for i, group in enumerate(faulty):
            delays = delays_ms(group.faulty, group.window_s)
            found = delays[np.isfinite(delays)]
            counts = np.concatenate([[0], np.arange(len(found)) + 1, [len(found)]])  # at 0, at each alarm, at the end
            x = np.concatenate([[0.0], found, [window_ms]])
            colour, line, _ = look(i)
            if len(faulty) <= MOST_BANDS:
                low, high = np.array([wilson_interval(int(k), len(delays)) for k in counts]).T
                ax.fill_between(x, 100 * low, 100 * high, step="post", color=colour, alpha=0.12, linewidth=0)
            label = f"{group.name} ({len(found)} of {len(delays)})"
            ax.step(x, 100 * counts / len(delays), where="post", color=colour, linestyle=line, linewidth=2, label=label)
        ax.set(xlim=(0, window_ms), ylim=(0, 102), xlabel="time since the onset of the fault [ms]")
        ax.set_ylabel("faults detected [%]")
        ax.grid(color="#dddddd", linewidth=0.6)
        fig.legend(loc="outside right upper", handlelength=3.5)
    return fig


def maxima_figure(groups: Sequence[DetectionMetrics]) -> Figure:
    """The greatest surprise of every episode against the threshold: within the window after a fault, or of it all."""
    shown = {g.name: g for g in groups if g.watched}
    require_some(shown)
    worst = {
        c: np.array([_peak(t, g.window_s) / t.threshold for t in g.watched]) for c, g in shown.items()
    }  # (n,) each
    floor, ceiling = min(0.5, *(w.min() for w in worst.values())), max(2.0, *(w.max() for w in worst.values()))
    with figure(height=1.1 + 0.55 * len(shown)) as fig:
        ax = fig.subplots()
        per_decade = 72 * 5.5 / np.log10(ceiling / floor)  # [pt]
        for i, (condition, ratios) in enumerate(worst.items()):
            colour, _, marker = ("#666666", "", "o") if condition == NOMINAL else look(i - (NOMINAL in shown))
            offsets = _swarm(np.log10(ratios) * per_decade, size=5.5) / 40  # a row is 40 pt high
            ax.plot(ratios, i + offsets, marker, color=colour, markersize=5, alpha=0.8, mew=0)
            above = f"{(ratios > 1).sum()} of {len(ratios)} above"
            ax.annotate(above, (1.01, i), xycoords=("axes fraction", "data"), va="center", fontsize=9)
        ax.axvline(1.0, color=BLACK, linewidth=1, linestyle=(0, (4, 2)))
        ax.annotate("threshold", (1.0, 1.0), (0, 3), xycoords=("data", "axes fraction"), textcoords="offset points",
                    ha="center", fontsize=9)  # fmt: skip
        ax.set_xscale("log")
        ax.set(xlim=(floor / 1.3, ceiling * 1.3), ylim=(len(shown) - 0.5, -0.5))
        ax.xaxis.set_major_formatter(FuncFormatter(lambda v, _: f"{v:g}"))
        ax.set_yticks(range(len(shown)), list(shown))
        ax.tick_params(axis="y", length=0)
        ax.set_xlabel("greatest surprise / threshold")
        ax.grid(axis="x", color="#dddddd", linewidth=0.6)
    return fig


def _peak(trace: ScoredEpisode, window_s: float) -> float:
    return float(np.clip(trace.surprise[trace.window(window_s)].max(initial=0.0), *limits([trace])))


def _swarm(values: NDArray[np.float64], size: float) -> NDArray[np.float64]:
    """(n,) sideways offsets that keep dots of diameter ``size`` apart: each the nearest free place to the middle."""
    places = size / 4 * np.array(sorted(range(-12, 13), key=abs))
    offsets = np.zeros(len(values))
    for done, i in enumerate(order := np.argsort(values, kind="stable")):
        near = order[:done][values[i] - values[order[:done]] < size]
        free = [p for p in places if np.all(np.hypot(values[i] - values[near], p - offsets[near]) >= size)]
        offsets[i] = free[0] if free else places[done % len(places)]
    return offsets


def heat_map(metrics: Mapping[str, Mapping[Kind, KindMetrics]], visible: Mapping[Kind, bool]) -> Figure:
    """AUROC by kind of fault and monitor; kinds that no observer could see have their name in brackets."""
    kinds, monitors = list(visible), list(metrics)
    values = np.array([[metrics[m][k].auroc if k in metrics[m] else math.nan for m in monitors] for k in kinds])
    with figure(height=1.6 + 0.21 * len(kinds), width=2.8 + 0.62 * len(monitors)) as fig:
        ax = fig.subplots()
        image = ax.imshow(values, cmap="cividis", vmin=0.5, vmax=1.0, aspect="auto", interpolation="nearest")
        for (row, column), value in np.ndenumerate(values):
            if np.isfinite(value):
                ink = "white" if value < 0.75 else "black"
                ax.text(column, row, f"{value:.2f}", ha="center", va="center", color=ink, fontsize=7)
        ax.set_yticks(range(len(kinds)), [in_words(k) if visible[k] else f"({in_words(k)})" for k in kinds])
        ax.set_xticks(range(len(monitors)), monitors, rotation=40, ha="right", rotation_mode="anchor")
        ax.tick_params(length=0, labelsize=8)
        ax.spines[:].set_visible(False)
        fig.colorbar(image, ax=ax, label="AUROC", pad=0.02)
    return fig


def severity_curves(
    metrics: Mapping[str, Mapping[Kind, KindMetrics]], severities: Sequence[str], rate: float
) -> Figure:
    """Faults detected at each severity, all kinds together; the ideal observer's is the most that can be."""
    with figure(height=4.0, width=7.6) as fig:
        ax = fig.subplots()
        for i, (monitor, own) in enumerate(metrics.items()):
            shares = []
            for severity in severities:
                found = [k.found[rate] for (_, s), k in own.items() if s == severity]
                shares.append(100 * sum(f.k for f in found) / max(1, sum(f.n for f in found)))
            colour, line, marker = ("#666666", ":", "") if monitor == IDEAL else look(i)
            ax.plot(severities, shares, color=colour, linestyle=line, marker=marker, linewidth=1.8, label=monitor)
        ax.set(ylim=(0, 102), ylabel="faults detected [%]", xlabel="severity")
        ax.grid(axis="y", color="#dddddd", linewidth=0.6)
        fig.legend(loc="outside right upper", handlelength=3.5)
    return fig


def _with_faults(groups: Sequence[DetectionMetrics]) -> list[DetectionMetrics]:
    faulty = [g for g in groups if g.faulty]
    require_some(faulty)
    return faulty
