"""What ``reproduce abstract`` prints and draws of its measurements."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from asm_gym.evaluation.figures import figure, look
from asm_gym.evaluation.tables import Table
from asm_gym.scripts.reproduce.closed_loop import CUE, EVENT, WAYS, Course
from asm_gym.scripts.reproduce.handwriting import STEPS
from asm_gym.scripts.reproduce.kit import Record, shown
from asm_gym.scripts.reproduce.two_links import DT, Floats

TITLES = {"traces": "traces", "settling": "settling", "gru": "GRU, BPTT"}


def tables(records: Sequence[Record], skills: int) -> list[Table]:
    """What was expected and written, what was noticed, what was named."""

    def cells(value: str, digits: int = 2, **where: Any) -> list[str]:
        return [shown(records, value, digits, model=m, **where) for m in TITLES]

    head = ("", *TITLES.values())
    lines = [(f"{m} [cm]", *cells("cm", measure=m)) for m in ("next row", "next row, hurried", "recalled")]
    lines += [(f"written, {way} [cm]", *cells("cm", measure=way)) for way in WAYS]
    lines += [(f"written, {way}: share of right letters", *cells("right", measure=way)) for way in WAYS]
    lines += [(f"{way}, half a second after the event on [cm]", *cells("late_cm", measure=way)) for way in WAYS[:5]]
    keys = [f"{e}, {w}" for e in ("pushed", "stuck") for w in ("surprise", "energy", "found")] + ["blamed", "alarms"]
    said = {
        "blamed": "stuck: the encoders have the largest share",
        "alarms": "left alone: letters with an alarm",
        "surprise": "AUROC of surprise",
        "energy": "AUROC of F",
        "found": "found in a second",
    }
    told = [(", ".join(said.get(p, p) for p in k.split(", ")), *cells(k, measure="surprise")[:2]) for k in keys]
    named = [(f"after {r + 1} rows", *cells("right", measure="named", row=r)[:2]) for r in (CUE, EVENT, STEPS - 1)]
    asked_for = f"{skills} letters, cue of {CUE} rows; mean ± SD over seeds"
    return [
        Table(f"Expected, and written in closed loop: {asked_for}", head, lines),
        Table("What is noticed", head[:3], told),
        Table("Share of letters that the state names rightly", head[:3], named),
    ]


def drawn(courses: Mapping[str, Mapping[str, Course]], truth: Floats) -> Figure:
    """A letter (T, 2) by each dynamics: where the hand went, and what was felt of it."""
    n, names = 0, [name for name in courses if name != "gru"]
    with figure(height=5.0, width=11) as fig:
        rows = fig.subplots(2, 4)
        for axes, name in zip(rows, names, strict=True):
            own = courses[name]
            for ax, ways in zip(axes[:2], (WAYS[:3], (WAYS[0], *WAYS[3:5])), strict=True):
                ax.plot(*truth.T, color="#bbbbbb", linewidth=4, label="as it was written")
                for i, way in enumerate(ways):
                    colour, line, _ = look(i)
                    ax.plot(*own[way].path[CUE:, n].T, color=colour, linestyle=line, label=way)
                ax.plot(*own[WAYS[0]].path[EVENT, n], "k.", markersize=5)
                ax.set(title=name, xlabel="x [cm]", ylabel="y [cm]", aspect="equal")
            for i, way in enumerate((WAYS[0], WAYS[1], WAYS[3])):
                for ax, what in zip(axes[2:], ("surprise", "energy"), strict=True):
                    ax.plot(DT * np.arange(STEPS), getattr(own[way], what)[:, n], color=look(i)[0], label=way)
            axes[2].set(title=name, xlabel="time [s]", ylabel="surprise", yscale="symlog")
            axes[3].set(title=name, xlabel="time [s]", ylabel="F [nats]")
        for ax in rows[0][:3]:
            ax.legend(fontsize=6)
    return fig
