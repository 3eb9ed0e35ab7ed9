"""What a memory calls the skill that runs, and whether it takes a change of skill for a fault."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from asm_gym.episode import Episode
from asm_gym.evaluation.figures import figure, look
from asm_gym.evaluation.statistics import Spread
from asm_gym.evaluation.tables import Table
from asm_gym.monitors import NeuralASM
from asm_gym.rollouts.run_folder import recorded
from asm_gym.rollouts.scoring import fitted
from asm_gym.scripts.reproduce.skill_switch import Switch

AFTER_S = (0.5, 1.0, 2.0, 5.0)
"""How long after a skill began it is asked for [s]."""


class Alarms(NamedTuple):
    """Share of the episodes in which one memory raised an alarm."""

    nominal: float
    switched: float  # with a change of skill


class Naming(NamedTuple):
    """How one memory named what runs: a (T,) array of right or wrong for each episode."""

    nominal: list[NDArray[np.bool_]]
    switched: list[NDArray[np.bool_]]  # from the change of skill on
    alarms: Alarms


def name_skills(seed: int, run: Path, tasks: tuple[str, ...], rate: float, switches: Sequence[Path]) -> Naming:
    """What the memory of ``seed`` calls the skills of nominal test episodes, and of those that change skill."""
    recordings = recorded(run, tasks).roles
    memory = fitted(run, "neural_asm", recordings["fit"], seed)
    assert isinstance(memory, NeuralASM)
    memory.calibrate(recordings["calibration"], rate)
    memory.name_skills(recordings["fit"])
    nominal = [memory.skills(r.stream) == r.labelled.task for r in recordings["nominal"]]
    changes = [Switch.read(path, memory.spec) for path in switches]
    switched = [(memory.skills(s.episode.stream) == s.skills)[s.changed :] for s in changes]
    return Naming(nominal, switched, alarms_of(memory, recordings["nominal"], changes))


def alarms_of(memory: NeuralASM, nominal: Sequence[Episode], changes: Sequence[Switch]) -> Alarms:
    """What a calibrated memory makes of them."""

    def share(episodes: Sequence[Episode]) -> float:
        alarms = [s.value.max() > memory.threshold for s in memory.score_episodes(episodes)]
        return float(np.mean(alarms)) if alarms else math.nan

    return Alarms(share(nominal), share([s.episode for s in changes]))


def experienced(
    seed: int, run: Path, tasks: tuple[str, ...], rate: float, switches: Sequence[Path], experience: Sequence[Path]
) -> Alarms:
    """What a memory makes of a change of skill that has seen others, unlabelled among its episodes."""
    recordings = recorded(run, tasks).roles
    spec = recordings["fit"][0].spec
    changes = [Switch.read(path, spec).episode for path in experience]
    calibration = changes[: len(changes) // 3]
    memory = NeuralASM(spec, seed=seed).fit([*recordings["fit"], *changes[len(calibration) :]])
    memory.calibrate([*recordings["calibration"], *calibration], rate)
    return alarms_of(memory, recordings["nominal"], [Switch.read(path, spec) for path in switches])


def share_right(right: Sequence[NDArray[np.bool_]], step: int) -> float:
    """Episodes whose running skill was named rightly ``step`` steps after it began (1 is its first row).

    Args:
        right: (T,) for each episode; of one that ends earlier its last step counts.
    """
    return float(np.mean([r[min(step, len(r)) - 1] for r in right]))


def naming_table(found: Sequence[Naming], skills: int, dt: float) -> Table:
    """How often the right one of so many skills is named; ``dt`` is the control period [s]."""

    def row(name: str, which: str) -> tuple[str, ...]:
        shares = [[100 * share_right(getattr(n, which), round(s / dt)) for n in found] for s in AFTER_S]
        return (name, *(Spread.of(x).text(1, 1) for x in shares))  # fmt: skip

    rows = [row("from the start of an episode", "nominal")]
    caption = f"Right skill of {skills} named so long after it began [% of episodes]."
    if found[0].switched:
        rows.append(row("after a change of skill", "switched"))
    return Table(caption, ("", *(f"{s:g} s" for s in AFTER_S)), rows)


def alarms_table(found: Mapping[str, Sequence[Alarms]]) -> Table:
    """How often a change of skill is taken for a fault, by memory."""

    def shares(alarms: Sequence[Alarms], which: str) -> str:
        return Spread.of([100 * getattr(a, which) for a in alarms]).text(1, 1)

    rows = [(name, shares(alarms, "switched"), shares(alarms, "nominal")) for name, alarms in found.items()]
    return Table("Episodes with an alarm [%].", ("Memory", "with a change of skill", "nominal"), rows)


def naming_figure(
    curves: Mapping[str, Sequence[NDArray[np.bool_]]], dt: float, longest_s: float = 8.0, since: str = "the skill began"
) -> Figure:
    """How often the right skill was named, over the time since it began.

    Args:
        curves: (T,) for each episode, by the name of the line.
        dt: control period [s].
        longest_s: the last time shown [s].
        since: from when time is counted.
    """
    steps = np.arange(1, round(longest_s / dt) + 1)
    with figure(height=4.0, width=7.6) as fig:
        ax = fig.subplots()
        for i, (name, right) in enumerate(curves.items()):
            colour, line, _ = look(i)
            shares = [100 * share_right(right, int(n)) for n in steps]
            ax.plot(dt * steps, shares, color=colour, linestyle=line, linewidth=1.8, label=name)
        ax.set(xlim=(0, longest_s), ylim=(0, 101), xlabel=f"time since {since} [s]")
        ax.set_ylabel("right skill named [% of episodes]")
        ax.grid(color="#dddddd", linewidth=0.6)
        fig.legend(loc="outside upper center", ncols=2, handlelength=3.5)
    return fig
