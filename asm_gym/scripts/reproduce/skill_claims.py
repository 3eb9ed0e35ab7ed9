"""The claims of the study of six skills, with the numbers that refute them, its tables and its figure."""

from __future__ import annotations

from collections.abc import Callable
from itertools import product
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from scipy.stats import t as student

from asm_gym.evaluation.figures import figure, look
from asm_gym.evaluation.tables import Table
from asm_gym.scripts.reproduce import kit
from asm_gym.scripts.reproduce.workspace import FAULTS, SECOND, SKILLS, SPEC, Floats

RECURRENT = "recurrent"
SETTLING = "settling"
NETWORKS = (RECURRENT, SETTLING)  # that learn by local rules; each is judged by every claim
CELLS = ("GRU", "LSTM")
ACTS = "association"
FOREST = "random forest"
STUCK = "encoders stuck"
PUSHED = "pushed"
ALARMS = "share over a ceiling"
SEEN = "AUROC of faults that an ideal observer sees"
# steps of inference a row, of which speed and accuracy are compared
FEW = 1
MANY = 20
ROWS = (2, 5, 10, 20, 40)  # after which names are judged
SHORT = ("Lift", "Stack", "Can", "Milk", "Door", "Nut")  # names of ``SKILLS`` in the figure

Measures = Callable[..., Any]
"""Returns the mean of a measure of a model in each seed."""


def better(of: Measures, measure: str, choose: Callable[..., Any]) -> Any:
    """Return a measure of the better of GRU and LSTM in each seed."""
    gru, lstm = (of(measure, cell) for cell in CELLS)
    return choose(gru, lstm)


class Claim(NamedTuple):
    """A claim, and the number that refutes it, which stood before the seeds were run.

    ``values`` returns what is measured of a network in each seed.
    """

    claim: str
    measured: str
    values: Callable[[Measures, str], Any]
    bound: float
    refuted_above: bool = False  # whether the bound or more refutes it, or the bound or less


CLAIMS = (
    Claim(
        "one network learns a repertoire by local rules",
        "error of the next row, in the last's",
        lambda of, network: of("next row", f"{network}, {MANY}"),
        bound=1.0,
        refuted_above=True,
    ),
    Claim(
        "it expresses skills as well as BPTT does",
        "share solved, less the better rival's",
        lambda of, network: of("solved", network) - better(of, "solved", np.maximum),
        bound=-0.1,
    ),
    Claim(
        "no skill is selected",
        "right names after a second",
        lambda of, network: of("named", network, at=str(SECOND)),
        bound=0.8,
    ),
    Claim(
        "",
        "the same, less a random forest's",
        lambda of, network: (
            of("named", network, at=str(SECOND)) - of("named", FOREST, at=str(SECOND))
        ),
        bound=-0.1,
    ),
    Claim(
        "predictive surprise across the repertoire",
        "AUROC of its own energy, where an ideal observer sees the fault",
        lambda of, network: of(SEEN, network, at=FAULTS),
        bound=0.8,
    ),
    Claim(
        "speed against accuracy",
        "error of missing senses with 1 step of inference, less with 20",
        lambda of, network: (
            of("missing senses", f"{network}, {FEW}") - of("missing senses", f"{network}, {MANY}")
        ),
        bound=0.0,
    ),
    Claim(
        "one energy for detection, reaction and expression",
        "share solved with stuck encoders: reacting, less not",
        lambda of, network: (
            of("solved", f"{network}, {STUCK}, reacts") - of("solved", f"{network}, {STUCK}")
        ),
        bound=0.0,
    ),
    Claim(
        "comparable to recurrent networks",
        "off from memory, in the better rival's",
        lambda of, network: of("from memory", network) / better(of, "from memory", np.minimum),
        bound=1.25,
        refuted_above=True,
    ),
)


def judged(claim: Claim, of: Measures, network: str) -> dict[str, str]:
    """Return the row of a claim: mean ± half of its 95 % interval, and whether it holds."""
    values = claim.values(of, network)
    mean = values.mean()
    half = np.inf
    if len(values) > 1:
        half = student.ppf(0.975, len(values) - 1) * values.sem()
    side = "less"
    refuted = mean <= claim.bound
    if claim.refuted_above:
        side = "more"
        refuted = mean >= claim.bound
    return {
        "claim": claim.claim,
        "measured": claim.measured,
        "found": f"{mean:.2f} ± {half:.2f}",
        "refuted if": f"{claim.bound:g} or {side}",
        "": "refuted" if refuted else "holds",
    }


def claims(records: pd.DataFrame) -> list[Table]:
    """Return what was measured of each claim and network, and the number that refutes it."""

    def of(measure: str, model: str, **at: object) -> Any:
        return kit.by_seed(records, "value", measure=measure, model=model, **at)

    seeds = records.seed.nunique()
    found = []
    for network in NETWORKS:
        caption = (
            f"The claims on the Panda, {network}: mean of {seeds} seeds ± half of its 95 % interval"
        )
        found.append(kit.table_of(caption, [judged(claim, of, network) for claim in CLAIMS]))
    return found


def tables(records: pd.DataFrame) -> list[Table]:
    """Return a table of each measure by model and condition; mean ± SD over seeds."""
    return [
        kit.grid(measure, own, "value", "model", "at")
        for measure, own in records.groupby("measure", sort=False)
    ]


# ------------------------------------------------------------------ figure


def drawn(records: pd.DataFrame, energies: dict[str, Floats]) -> Figure:
    """Draw who solves what, how soon names are right, and the energy over time."""
    with figure(height=3.5, width=11) as fig:
        first, second, third = fig.subplots(1, 3)
        draw_solved(first, records)
        draw_names(second, records)
        draw_energies(third, energies)
        for ax in (first, second, third):
            ax.legend(fontsize=6, loc="lower left", bbox_to_anchor=(0.0, 1.0), ncols=2)
    return fig


def draw_solved(ax: Axes, records: pd.DataFrame) -> None:
    """Draw the share solved of each skill, a bar for each model."""
    solved = records[records.measure == "solved"].pivot_table("value", "at", "model")
    places = np.arange(len(SKILLS))
    for n, model in enumerate((*NETWORKS, *CELLS, ACTS)):
        colour, _, _ = look(n)
        heights = solved[model][list(SKILLS)]
        ax.bar(places + 0.16 * n - 0.32, heights, 0.16, color=colour, label=model)
    ax.set_xticks(places, SHORT, fontsize=7)
    ax.set(ylabel="share solved", ylim=(0, 1.02))


def draw_names(ax: Axes, records: pd.DataFrame) -> None:
    """Draw the share of right names over time, with objects and without."""
    right = records.pivot_table("value", "at", ["model", "measure"])
    times = SPEC.dt * np.array(ROWS)
    for n, (model, measure) in enumerate(product((RECURRENT, FOREST), ("named", "named blind"))):
        colour, style, _ = look(n)
        shares = right[model, measure][list(map(str, ROWS))]
        label = f"{model}{measure.removeprefix('named').replace(' ', ', ')}"
        ax.plot(times, shares, color=colour, linestyle=style, label=label)
    ax.set(xlabel="time [s]", ylabel="share of right names", ylim=(0, 1.02))


def draw_energies(ax: Axes, energies: dict[str, Floats]) -> None:
    """Draw the largest energy of a group over time."""
    for n, name in enumerate((RECURRENT, f"{RECURRENT}, {PUSHED}", f"{RECURRENT}, {STUCK}")):
        energy = energies[name]
        colour, style, _ = look(n)
        times = SPEC.dt * np.arange(len(energy))
        ax.plot(times, energy, color=colour, linestyle=style, label=name)
    ax.axhline(1.0, color="#888888", linewidth=1)
    ax.set(xlabel="time [s]", ylabel="energy, in its ceiling", yscale="log")
