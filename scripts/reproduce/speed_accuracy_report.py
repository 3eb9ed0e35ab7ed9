"""What ``reproduce speed_accuracy`` fits, prints and draws of its measurements."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray

from asm_gym.evaluation.figures import figure, look
from asm_gym.evaluation.tables import Table
from asm_gym.scripts.reproduce.curves import points
from asm_gym.scripts.reproduce.kit import Record, over_seeds, shown
from asm_gym.scripts.reproduce.laws import LAWS, Fit, fit

MEASURES = {
    "recalled_cm": "recalled [cm]",
    "next_cm": "next row [cm]",
    "completed_cm": "unseen axis [cm]",
    "auroc": "slips told, AUROC",
}
FITTED = ("recalled_cm", "next_cm", "completed_cm")
AT_SPEED = {"end_cm": "end point, recalled [cm]", "path_cm": "path, recalled [cm]", "ahead_cm": "next row [cm]"}

Key = tuple[str, ...]
"""Dynamics, measure, budget where there is one, and law."""


def fits(records: Sequence[Record]) -> dict[Key, Fit]:
    """Each law that could be fitted to each measure, over all seeds."""
    found: dict[Key, Fit] = {}
    for name in _distinct(records, "dynamics"):
        own = [r for r in records if r["dynamics"] == name]
        timed = [{**r, "time": r["iterations"] / r["shorter"]} for r in own if "iterations" in r]
        for value in FITTED:
            for law in ("fitts", "exponential", "power"):
                if (one := fit(law, *_within_seeds(timed, "time", value))) is not None:
                    found[name, value, law] = one
        for value in AT_SPEED:
            for budget in _distinct(own, "budget"):
                moved = [r for r in own if r.get("budget") == budget]
                for law in ("linear", "log"):
                    if (one := fit(law, *_within_seeds(moved, "cm_per_s", value))) is not None:
                        found[name, value, f"{budget} a second", law] = one
        for count in _distinct(own, "long"):
            noisy = [r for r in own if r.get("long") == count]
            if (one := fit("linear", *_within_seeds(noisy, "noise", "noisy_cm"))) is not None:
                found[name, "noisy_cm", f"{count} steps", "linear"] = one
    return found


def _distinct(records: Sequence[Record], key: str) -> list[Any]:
    return list(dict.fromkeys(r[key] for r in records if key in r))


def _within_seeds(records: Sequence[Record], x: str, y: str) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Points, each seed's moved to the mean of all: how hard its letters are is no noise of the law."""
    seed, xs, ys = (np.array([r[k] for r in records], np.float64) for k in ("seed", x, y))
    for s in np.unique(seed):
        ys[seed == s] += np.mean([r[y] for r in records]) - ys[seed == s].mean()
    return xs, ys


def tables(records: Sequence[Record], asked_for: str) -> list[Table]:
    """By iterations, by speed, and the laws."""
    names, counts = _distinct(records, "dynamics"), _distinct(records, "iterations")
    shorter, speeds, budgets = (_distinct(records, key) for key in ("shorter", "speed", "budget"))
    return [
        Table(
            f"By steps of inference, {asked_for}; mean ± SD over seeds",
            ("", "", "steps", *map(str, counts)),
            [
                (
                    str(name),
                    label,
                    "long" if short == 1 else f"1/{short}",
                    *(shown(records, value, 3, dynamics=name, iterations=k, shorter=short) for k in counts),
                )
                for name in names
                for value, label in MEASURES.items()
                for short in shorter
            ]
            + [
                (
                    str(name),
                    "time a row [µs]",
                    "long",
                    *(shown(records, "us", 0, dynamics=name, iterations=k, shorter=1) for k in counts),
                )
                for name in names
            ],
        ),
        Table(
            "By speed of writing; recalled after a cue of a third",
            ("", "", "short steps a second", *(f"{s:g}×" for s in speeds)),
            [
                (
                    str(name),
                    label,
                    str(budget),
                    *(shown(records, value, 3, dynamics=name, speed=s, budget=budget) for s in speeds),
                )
                for name in names
                for value, label in AT_SPEED.items()
                for budget in budgets
            ],
        ),
        Table(
            "With noisier senses [cm of noise]",
            ("", "", "long steps a row", *map(str, _distinct(records, "noise"))),
            [
                (
                    str(name),
                    label,
                    str(count),
                    *(
                        shown(records, value, 3, dynamics=name, noise=n, long=count)
                        for n in _distinct(records, "noise")
                    ),
                )
                for name in names
                for value, label in (("noisy_cm", "next row [cm]"), ("cued_cm", "recalled [cm]"))
                for count in _distinct(records, "long")
            ],
        ),
        Table(
            "Prepared by a cue: where the pen goes in half a second [cm], by long steps on each of its rows",
            ("", "rows of the cue", *map(str, _distinct(records, "prepared"))),
            [
                (
                    str(name),
                    str(cue),
                    *(
                        shown(records, "begun_cm", 3, dynamics=name, cue=cue, prepared=count)
                        for count in _distinct(records, "prepared")
                    ),
                )
                for name in names
                for cue in _distinct(records, "cue")
            ],
        ),
        Table(
            "Laws, with 95 % intervals; time in long steps",
            ("", "of", "law", "parameters", "AIC"),
            [(name, ", ".join(of), law, one.text, f"{one.aic:.1f}") for (name, *of, law), one in fits(records).items()],
        ),
    ]


def drawn(records: Sequence[Record]) -> Figure:
    """Each measure by time of inference with its laws, and the next row by speed and by noise."""
    laws = fits(records)
    names = _distinct(records, "dynamics")
    with figure(height=2.5 * len(names), width=11) as fig:
        rows = fig.subplots(len(names), 4, squeeze=False)
        for axes, name in zip(rows, names, strict=True):
            for ax, value in zip(axes, ("recalled_cm", "next_cm"), strict=False):
                _over_time(ax, [r for r in records if r["dynamics"] == name], value, str(name), laws)
            for i, budget in enumerate(_distinct(records, "budget")):
                own = [r for r in records if r["dynamics"] == name and r.get("budget") == budget]
                speeds = _distinct(own, "speed")
                pace = [over_seeds(own, "cm_per_s", speed=s).mean for s in speeds]
                points(axes[2], pace, [over_seeds(own, "ahead_cm", speed=s) for s in speeds], i, f"{budget} steps/s")
                if (line := laws.get((str(name), "ahead_cm", f"{budget} a second", "linear"))) is not None:
                    ends = np.array([min(pace), max(pace)])
                    axes[2].plot(ends, LAWS["linear"][0](ends, *line.values), color=look(i)[0], linewidth=1)
            axes[2].set(xlabel="mean speed [cm/s]", ylabel="next row [cm]", ylim=0, title=str(name))
            axes[2].legend(fontsize=7)
            for i, count in enumerate(_distinct(records, "long")):
                noises = _distinct(records, "noise")
                found = [over_seeds(records, "noisy_cm", dynamics=name, noise=n, long=count) for n in noises]
                points(axes[3], noises, found, i, f"{count} long step{'s'[: count > 1]}")
            axes[3].set(xlabel="added noise [cm]", ylabel="next row [cm]", ylim=0, title=str(name))
            axes[3].legend(fontsize=7)
        rows[0][0].legend(fontsize=7)
    return fig


def _over_time(ax: Axes, records: Sequence[Record], value: str, name: str, laws: dict[Key, Fit]) -> None:
    counts, shorter = _distinct(records, "iterations"), _distinct(records, "shorter")
    for i, short in enumerate(shorter):
        found = [over_seeds(records, value, iterations=k, shorter=short) for k in counts]
        label = "long steps" if short == 1 else f"steps 1/{short} as long"
        points(ax, [k / short for k in counts], found, 3 * i, label)
    x = np.geomspace(min(counts) / max(shorter), max(counts), 200)
    for i, law in enumerate(("fitts", "exponential", "power")):
        if (one := laws.get((name, value, law))) is not None:
            ax.plot(x, LAWS[law][0](x, *one.values), color=look(i + 1)[0], linestyle=look(i + 1)[1], label=law)
    ax.set(xlabel="time of inference [long steps]", ylabel=MEASURES[value], xscale="log", ylim=0, title=name)
