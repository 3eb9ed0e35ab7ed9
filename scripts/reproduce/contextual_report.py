"""What contextual inference came to: tables, and a figure of letters, states and certainty over time."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from asm_gym.evaluation.figures import figure, look
from asm_gym.evaluation.tables import Table
from asm_gym.scripts.reproduce import kit
from asm_gym.scripts.reproduce.curves import curve
from asm_gym.scripts.reproduce.expression import Rows
from asm_gym.scripts.reproduce.kit import Record, over_seeds

SPLICE = 30
"""Step at which another letter is gone on with."""

TIMES = (5, 10, 20, 30, 40, 59)
MIDDLE = (5, 10, 15, 20, 25, 30, 35, 40)
"""Steps at which letters with one middle are told apart; they differ up to about 15 and from about 38 on."""

SOURCES = {"state": "state of the memory", "row": "present row alone", "past": "whole past, told the demonstrations"}


class Example(NamedTuple):
    """What the first repetition saw, for the figure."""

    paths: Rows  # (B, T, 2) written letters
    plane: NDArray[np.float64]  # (B, T, 2) their states, in their first two principal components
    skill: NDArray[np.intp]  # (B,)
    certain: NDArray[np.float64]  # (T, 2) mean certainty of the first letter and of its twin, while it is written
    switch: NDArray[np.float64]  # (T, 2) the same for the first letter and another one, where one goes on as the other


def tables(records: Sequence[Record], skills: int) -> list[Table]:
    """Over time, cues begun late, switches."""

    named: dict[str, Record] = {label: {"how": "named", "source": s} for s, label in SOURCES.items()}
    for source, label in (("state", "clusters of states, no label"), ("row", "clusters of rows, no label")):
        named[label] = {"how": "clustered", "source": source}
    middle = {SOURCES[s]: {"how": "one middle", "source": s} for s in ("state", "row")}
    caption = f"Right skill [share] of {skills}, after so many steps; mean ± SD over seeds"
    begun, switched = ({"state": {"how": how, "source": "state"}} for how in ("begun late", "switched"))
    late, since = kit.by("step", (1, 2, 5, 10, 20)), kit.by("step", (0, 1, 2, 5, 10, 20))
    parted = "Letters with one middle told apart [share], by step"
    return [
        kit.grid(caption, records, "right", named, kit.by("step", TIMES)),
        kit.grid(parted, records, "right", middle, kit.by("step", MIDDLE)),
        kit.grid("Cue begun in mid-letter, by its length", records, "right", begun, late),
        kit.grid("The new skill named, so many steps after a switch", records, "right", switched, since),
    ]


def drawn(records: Sequence[Record], example: Example) -> Figure:
    """Letters, states, certainty over time, a pair that parts, a switch."""
    with figure(height=6.2, width=9.5) as fig:
        axes = fig.subplots(2, 3)
        for path, plane, k in zip(example.paths, example.plane, example.skill, strict=True):
            for ax, line in ((axes[0, 0], path), (axes[0, 1], plane)):
                ax.plot(*line.T, color=look(int(k))[0], linewidth=1.2)
                ax.plot(*line[:1].T, "o", color="#444444", markersize=3)
        axes[0, 0].set(title="letters; two and two begin alike", xlabel="[cm]", ylabel="[cm]", aspect="equal")
        axes[0, 1].set(title="their states, two principal components", xticks=[], yticks=[])
        for i, (source, label) in enumerate(SOURCES.items()):
            _curve(axes[0, 2], records, i, label, how="named", source=source)
        axes[0, 2].set(title="which skill?", xlabel="steps read", ylabel="right [share]", ylim=(0, 1.02))
        axes[0, 2].legend(fontsize=7, loc="lower right")
        _pair(axes[1, 0], example.certain, ("the letter written", "its twin"), "a pair that parts", None)
        _pair(axes[1, 1], example.switch, ("the letter begun", "the one gone on with"), "a switch", SPLICE)
        for i, (source, label) in enumerate((("state", "state"), ("row", "row alone"))):
            _curve(axes[1, 2], records, i, label, how="one middle", source=source)
        axes[1, 2].set(title="one middle", xlabel="step", ylabel="right [share]", ylim=(0, 1.02))
        axes[1, 2].legend(fontsize=8)
    return fig


def _curve(ax: Any, records: Sequence[Record], i: int, label: str, **where: Any) -> None:
    steps = sorted({r["step"] for r in records if all(r.get(k) == v for k, v in where.items())})
    if not steps:
        return
    curve(ax, steps, [over_seeds(records, "right", step=t, **where) for t in steps], i, label, markers=False)


def _pair(ax: Any, certain: NDArray[np.float64], labels: tuple[str, str], title: str, mark: int | None) -> None:
    for i in range(2):
        ax.plot(certain[:, i], color=look(i)[0], linestyle=look(i)[1], label=labels[i])
    if mark is not None:
        ax.axvline(mark, color="#888888", linewidth=1)
    ax.set(title=title, xlabel="step", ylabel="certainty", ylim=(0, 1.02))
    ax.legend(fontsize=8)
