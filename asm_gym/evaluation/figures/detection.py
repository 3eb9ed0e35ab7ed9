"""Figures of detection: conditions of one monitor, or monitors side by side; they print in grey too."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib.figure import Figure

from asm_gym.evaluation.figures.style import GREY, figure, look, require_some
from asm_gym.evaluation.metrics import DetectionMetrics, Kind, KindMetrics, delays_ms, in_words, placements
from asm_gym.evaluation.statistics import wilson_interval

MOST_BANDS = 4
"""More curves than these have no bands of uncertainty: they could not be told apart."""


def roc_figure(groups: Sequence[DetectionMetrics]) -> Figure:
    """Draw the ROC of each group over all its faults, against nominal episodes of the task in the same steps."""
    faulty = [g for g in groups if g.faulty]
    require_some(faulty)
    if not all(g.nominal for g in faulty):
        raise ValueError("a ROC curve needs nominal traces")
    with figure(height=4.6, width=8.4) as fig:
        ax = fig.subplots()
        ax.plot([0, 100], [0, 100], color=GREY, linewidth=1)
        for i, group in enumerate(faulty):
            u = np.sort(placements(group.faulty, group.nominal, group.window_s))
            if not u.size:
                continue
            colour, line, _ = look(i)
            x, y = 100 * np.concatenate([[0], u, [1]]), 100 * np.concatenate([np.arange(u.size + 1), [u.size]]) / u.size
            label = f"{group.name}: {1 - u.mean():.3f}"
            ax.step(x, y, where="post", color=colour, linestyle=line, linewidth=2, label=label, clip_on=False)
        ax.set(xlim=(0, 100), ylim=(0, 100), box_aspect=1)
        ax.set(xlabel="nominal episodes above [%]", ylabel="faulty episodes above [%]")
        ax.grid()
        fig.legend(loc="outside right upper", handlelength=3.5, title="AUROC")
    return fig


def delay_figure(groups: Sequence[DetectionMetrics]) -> Figure:
    """Draw the share of faults detected within so many ms of the onset; with 95 % Wilson bands for few curves."""
    faulty = [g for g in groups if g.faulty]
    require_some(faulty)
    window_ms = 1e3 * max(g.window_s for g in faulty)
    with figure(height=4.4) as fig:
        ax = fig.subplots()
        for i, group in enumerate(faulty):
            delays = delays_ms(group.faulty, group.window_s)
            found = delays[np.isfinite(delays)]
            counts = np.append(np.arange(len(found) + 1), len(found))  # at 0, at each alarm, at the end
            x = np.concatenate([[0.0], found, [window_ms]])
            colour, line, _ = look(i)
            if len(faulty) <= MOST_BANDS:
                low, high = np.array([wilson_interval(int(k), len(delays)) for k in counts]).T
                ax.fill_between(x, 100 * low, 100 * high, step="post", color=colour, alpha=0.12, linewidth=0)
            label = f"{group.name} ({len(found)} of {len(delays)})"
            ax.step(x, 100 * counts / len(delays), where="post", color=colour, linestyle=line, linewidth=2, label=label)
        ax.set(xlim=(0, window_ms), ylim=(0, 102), xlabel="time since the onset of the fault [ms]")
        ax.set_ylabel("faults detected [%]")
        ax.grid()
        fig.legend(loc="outside right upper", handlelength=3.5)
    return fig


def heat_map(metrics: Mapping[str, Mapping[Kind, KindMetrics]], visible: Mapping[Kind, bool]) -> Figure:
    """Draw AUROC by kind of fault and monitor; kinds that no observer could detect are in brackets."""
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
