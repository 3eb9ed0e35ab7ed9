"""What ``reproduce tracking`` prints and draws of its measurements."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from asm_gym.evaluation.figures import figure, look
from asm_gym.evaluation.tables import Table
from asm_gym.scripts.reproduce.kit import Record, over_seeds, shown

SHOWN = slice(560, 600)
"""Steps that Fig 3C of the paper shows."""

BEYOND = "Mean squared error of the state beyond the Kalman filter's"

BEGUN = {"theirs": "authors' steps, from the last state", "ours": "this package's, from the expected one"}

ERRORS = {
    "kalman": "Kalman filter",
    "observation": "each observation by itself",
    "kalman_fresh": "Kalman filter, short recordings, the second half",
    "learned": "learned by local rules",
    "last_fresh": "the last observation",
}


def tables(records: Sequence[Record], iterations: Sequence[int], lengths: Sequence[float]) -> list[Table]:
    """By length and number of steps; by number of this package's own; what was learned."""
    counts = list(dict.fromkeys(r["iterations"] for r in records if r.get("by") == "own"))
    return [
        Table(
            f"{BEYOND}, by steps of inference and their length; mean ± SD over seeds",
            ("", "steps", *(f"{x:g}" for x in lengths)),
            [
                (name, str(k), *(shown(records, "more", by=by, iterations=k, length=x) for x in lengths))
                for by, name in BEGUN.items()
                for k in iterations
            ],
        ),
        Table(
            f"{BEYOND}, by steps of this package's own length (1.5 over the curvature)",
            ("steps", "beyond Kalman", "from the closed form, mean squared"),
            [
                *(
                    (
                        str(k) if k in iterations else "until still",
                        shown(records, "more", 3, by="own", iterations=k),
                        f"{over_seeds(records, 'from_settled', by='own', iterations=k).mean:.1e}",
                    )
                    for k in counts
                ),
                ("closed form", shown(records, "more", 3, by="settled"), ""),
                ("closed form, Π_z as sure as the filter ends up", shown(records, "more", 3, by="aware"), ""),
            ],
        ),
        Table(
            "Mean squared error",
            ("", "of the state", "of the next observation"),
            [
                (name, shown(records, "mse", 3, by=by), shown(records, "observed", 3, by=by))
                for by, name in ERRORS.items()
            ],
        ),
    ]


def drawn(
    records: Sequence[Record],
    iterations: Sequence[int],
    lengths: Sequence[float],
    example: Mapping[str, NDArray[np.float64]],
) -> Figure:
    """Fig 3C and 3D."""
    with figure(height=3.0, width=8) as fig:
        left, right = fig.subplots(1, 2)
        for i, (name, estimate) in enumerate(example.items()):
            color, style, *_ = look(i)
            left.plot(np.arange(SHOWN.start, SHOWN.stop), estimate[SHOWN], color=color, linestyle=style, label=name)
        left.set(xlabel="step", ylabel="acceleration")
        for i, count in enumerate(iterations):
            color, style, *_ = look(i)
            means = [over_seeds(records, "more", by="ours", iterations=count, length=x).mean for x in lengths]
            right.plot(lengths, means, color=color, linestyle=style, label=str(count))
        right.axhline(over_seeds(records, "more", by="settled").mean, color="grey", linewidth=0.8, label="settled")
        right.set(xlabel="length of a step of inference", ylabel="MSE beyond the Kalman filter's", yscale="log")
        left.legend(fontsize=7)
        right.legend(fontsize=7, ncols=2, title="steps")
    return fig
