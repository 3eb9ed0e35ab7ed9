"""What one memory of many skills is worth: against one for each, over seeds, and by the name it gives what runs."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from asm_gym.evaluation.plots import figure, look
from asm_gym.evaluation.report import Table
from asm_gym.evaluation.statistics import Spread


class Alarms(NamedTuple):
    """Share of the episodes in which one memory raised an alarm."""

    nominal: float
    switched: float  # with a change of skill


def share_right(right: Sequence[NDArray[np.bool_]], step: int) -> float:
    """Episodes whose running skill was named rightly ``step`` steps after it began (1 is its first row).

    Args:
        right: (T,) for each episode; of one that ends earlier its last step counts.
    """
    return float(np.mean([r[min(step, len(r)) - 1] for r in right]))


def alarms_table(found: Mapping[str, Sequence[Alarms]]) -> Table:
    """How often a change of skill is taken for a fault, by memory."""

    def shares(alarms: Sequence[Alarms], which: str) -> str:
        return Spread.of([100 * getattr(a, which) for a in alarms]).text(1, 1)

    rows = [(name, shares(alarms, "switched"), shares(alarms, "nominal")) for name, alarms in found.items()]
    return Table("Episodes with an alarm [%].", ("Memory", "with a change of skill", "nominal"), rows)


def naming_figure(curves: Mapping[str, Sequence[NDArray[np.bool_]]], dt: float, longest_s: float = 8.0) -> Figure:
    """How often the right skill was named, over the time since it began.

    Args:
        curves: (T,) for each episode, by the name of the line.
        dt: control period [s].
    """
    steps = np.arange(1, round(longest_s / dt) + 1)
    with figure(height=4.0, width=7.6) as fig:
        ax = fig.subplots()
        for i, (name, right) in enumerate(curves.items()):
            colour, line, _ = look(i)
            shares = [100 * share_right(right, int(n)) for n in steps]
            ax.plot(dt * steps, shares, color=colour, linestyle=line, linewidth=1.8, label=name)
        ax.set(xlim=(0, longest_s), ylim=(0, 101), xlabel="time since the skill began [s]")
        ax.set_ylabel("right skill named [% of episodes]")
        ax.grid(color="#dddddd", linewidth=0.6)
        fig.legend(loc="outside right upper", handlelength=3.5)
    return fig
