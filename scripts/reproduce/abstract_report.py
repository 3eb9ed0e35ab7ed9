"""What ``reproduce abstract`` prints and draws of its measurements."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from asm_gym.evaluation.figures import figure, look
from asm_gym.evaluation.tables import Table
from asm_gym.scripts.reproduce import kit
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
        behind(records),
        Table("What is noticed", head[:3], told),
        Table("Share of letters that the state names rightly", head[:3], named),
    ]


def behind(records: Sequence[Record]) -> Table:
    """How much further off each dynamics is than the GRU, over the same repertoires."""

    def cell(model: str, measure: str) -> str:
        found = kit.paired(records, "cm", {"model": model}, {"model": "gru"}, measure=measure)
        verdict = "ahead" if found.high < 0 else "behind" if found.low > 0 else "within chance"
        return f"{found.value:+.2f} ({found.low:+.2f} to {found.high:+.2f}), {verdict}"

    names = [name for name in TITLES if name != "gru"]
    count = len({r["seed"] for r in records})
    lines = [(f"{m} [cm]", *(cell(name, m) for name in names)) for m in ("next row", "recalled", WAYS[0])]
    said = f"Further off than the GRU, in the same {count} repertoires; 95 % intervals of the paired difference"
    return Table(said, ("", *(TITLES[name] for name in names)), lines)


def drawn(courses: Mapping[str, Mapping[str, Course]], truth: Floats) -> Figure:
    """A letter (T, 2) by each dynamics: where the hand went, and what was felt of it."""
    n, names = 0, [name for name in courses if name != "gru"]
    looks = {way: look(i)[:2] for i, way in enumerate(WAYS)}
    with figure(height=5.6, width=11) as fig:
        rows = fig.subplots(2, 4, squeeze=False)
        for axes, name in zip(rows, names, strict=True):
            own = courses[name]
            for ax, ways in zip(axes[:2], (WAYS[:3], (WAYS[0], *WAYS[3:5])), strict=True):
                ax.plot(*truth.T, color="#cccccc", linewidth=4, label="as it was written")
                for way in ways:
                    colour, line = looks[way]
                    ax.plot(*own[way].path[CUE:, n].T, color=colour, linestyle=line, label=way)
                ax.plot(*own[WAYS[0]].path[EVENT, n], "k.", markersize=6, label="where it happens")
                ax.set(title=name, xlabel="x [cm]", ylabel="y [cm]", aspect="equal", adjustable="datalim")
            for way in (WAYS[0], WAYS[1], WAYS[3]):
                for ax, what in zip(axes[2:], ("surprise", "energy"), strict=True):
                    colour, line = looks[way]
                    ax.plot(DT * np.arange(STEPS), getattr(own[way], what)[:, n], color=colour, linestyle=line)
            axes[2].axhline(own[WAYS[0]].threshold, color="#888888", linewidth=1)
            axes[2].set(title=f"{name}; line: threshold", xlabel="time [s]", ylabel="surprise", yscale="symlog")
            axes[2].set_ylim(bottom=-0.5)
            axes[3].set(title=name, xlabel="time [s]", ylabel="F [nats]", yscale="symlog")
        labelled: dict[str, Any] = {}
        for ax in rows[0][:2]:
            labelled |= dict(zip(*reversed(ax.get_legend_handles_labels()), strict=True))
        fig.legend(list(labelled.values()), list(labelled), loc="outside lower center", ncols=7, fontsize=8)
    return fig
