"""Figures of monitors side by side; colours, lines and markers differ, and print in grey."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib.figure import Figure

from asm_gym.evaluation import scoring
from asm_gym.evaluation.comparison import IDEAL, Cell
from asm_gym.evaluation.plots import figure, look
from asm_gym.evaluation.scoring import Verdict


def roc_curves(verdicts: Mapping[str, Sequence[Verdict]], window_s: float) -> Figure:
    """ROC of each monitor over all faults, each against nominal episodes of its task in the same steps."""
    with figure(height=5.0, width=7.6) as fig:
        ax = fig.subplots()
        ax.plot([0, 100], [0, 100], color="#999999", linewidth=1)
        for i, (monitor, own) in enumerate(verdicts.items()):
            nominal = [v for v in own if v.kind == "nominal"]
            u = np.sort(scoring.placements([v for v in own if v.onset is not None], nominal, window_s))
            colour, line, _ = look(i)
            x, y = np.concatenate([[0], u, [1]]), np.concatenate([[0], np.arange(len(u)) + 1, [len(u)]]) / len(u)
            label = f"{monitor}: {1 - u.mean():.3f}"
            ax.step(100 * x, 100 * y, where="post", color=colour, linestyle=line, linewidth=1.8, label=label)
        ax.set(xlim=(0, 100), ylim=(0, 100), aspect="equal")
        ax.set_xlabel("nominal episodes above [%]")
        ax.set_ylabel("faulty episodes above [%]")
        ax.grid(color="#dddddd", linewidth=0.6)
        fig.legend(loc="outside right upper", handlelength=3.5, title="AUROC, all faults pooled")
    return fig


def delay_curves(verdicts: Mapping[str, Sequence[Verdict]], thresholds: Mapping[str, float], window_s: float) -> Figure:
    """The share of faults detected within so many ms of the onset."""
    with figure(height=4.4, width=8.0) as fig:
        ax = fig.subplots()
        for i, (monitor, own) in enumerate(verdicts.items()):
            faulty = [v for v in own if v.onset is not None]
            after = [v.detected_after(thresholds[monitor]) for v in faulty]
            times = np.sort([1e3 * (a + 1) * v.dt for a, v in zip(after, faulty, strict=True) if a is not None])
            times = times[times <= 1e3 * window_s]
            share = np.concatenate([[0], np.arange(len(times)) + 1, [len(times)]]) / len(faulty)
            colour, line, _ = look(i)
            x = np.concatenate([[0], times, [1e3 * window_s]])
            ax.step(x, 100 * share, where="post", color=colour, linestyle=line, linewidth=1.8, label=monitor)
        ax.set(xlim=(0, 1e3 * window_s), ylim=(0, 100), xlabel="time since the onset of the fault [ms]")
        ax.set_ylabel("faults detected [%]")
        ax.grid(color="#dddddd", linewidth=0.6)
        fig.legend(loc="outside right upper", handlelength=3.5)
    return fig


def heat_map(cells: Mapping[str, Mapping[tuple[str, str], Cell]], visible: Mapping[tuple[str, str], bool]) -> Figure:
    """AUROC by kind of fault and monitor; kinds that no observer could see have their name in brackets."""
    kinds, monitors = list(visible), list(cells)
    values = np.array([[cells[m][k].auroc if k in cells[m] else math.nan for m in monitors] for k in kinds])
    with figure(height=1.6 + 0.21 * len(kinds), width=2.8 + 0.62 * len(monitors)) as fig:
        ax = fig.subplots()
        image = ax.imshow(values, cmap="cividis", vmin=0.5, vmax=1.0, aspect="auto", interpolation="nearest")
        for (row, column), value in np.ndenumerate(values):
            if np.isfinite(value):
                ink = "white" if value < 0.75 else "black"
                ax.text(column, row, f"{value:.2f}", ha="center", va="center", color=ink, fontsize=7)
        names = [" ".join(part.replace("_", " ") for part in k if part) for k in kinds]
        ax.set_yticks(range(len(kinds)), [n if visible[k] else f"({n})" for n, k in zip(names, kinds, strict=True)])
        ax.set_xticks(range(len(monitors)), monitors, rotation=40, ha="right", rotation_mode="anchor")
        ax.tick_params(length=0, labelsize=8)
        ax.spines[:].set_visible(False)
        fig.colorbar(image, ax=ax, label="AUROC", pad=0.02)
    return fig


def severity_curves(
    cells: Mapping[str, Mapping[tuple[str, str], Cell]], severities: Sequence[str], rate: float
) -> Figure:
    """Faults detected at each severity, all kinds together; the ideal observer's is the most that can be."""
    with figure(height=4.0, width=7.6) as fig:
        ax = fig.subplots()
        for i, (monitor, own) in enumerate(cells.items()):
            shares = []
            for severity in severities:
                found = [c.found[rate] for (_, s), c in own.items() if s == severity]
                shares.append(100 * sum(f.k for f in found) / max(1, sum(f.n for f in found)))
            colour, line, marker = ("#666666", ":", "") if monitor == IDEAL else look(i)
            ax.plot(severities, shares, color=colour, linestyle=line, marker=marker, linewidth=1.8, label=monitor)
        ax.set(ylim=(0, 102), ylabel="faults detected [%]", xlabel="severity")
        ax.grid(axis="y", color="#dddddd", linewidth=0.6)
        fig.legend(loc="outside right upper", handlelength=3.5)
    return fig
