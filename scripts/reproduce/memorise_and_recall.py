"""Memorise and recall: one network learns a repertoire without labels, and expresses each skill from a cue.

Repertoires of handwriting-like movements in two and three dimensions, of cubic splines, and of three robosuite skills.
Online, every row is read after it was expected; offline, none after the cue. What recalls them is in ``recall_rivals``
and ``robot_recall``.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from rich.console import Console

from asm_gym.evaluation.figures import figure, look
from asm_gym.evaluation.tables import Table
from asm_gym.rollouts.parallel import parallel_map
from asm_gym.rollouts.progress import stage
from asm_gym.scripts.command import at_least
from asm_gym.scripts.reproduce import robot_recall
from asm_gym.scripts.reproduce.common import (
    SENSED,
    SKILLS,
    Common,
    Findings,
    Record,
    demonstrations,
    over_seeds,
    reproduce,
    shown,
    wide_enough,
)
from asm_gym.scripts.reproduce.curves import curve
from asm_gym.scripts.reproduce.handwriting import STEPS, check_letters
from asm_gym.scripts.reproduce.recall_rivals import CALLED, MODELS, Condition, Practice, recall
from asm_gym.scripts.reproduce.robot_recall import RECALLED, ROBOT_CUE


@dataclass(frozen=True)
class Args(Common):
    """Recall from a cue, against what else can recall."""

    repertoires: tuple[int, ...] = (1, 2, 4, 8, 16, 32)
    """How many letters one network learns; none leaves letters out."""
    widths: tuple[int, ...] = (16, 32, 64, 128, 256, 512)
    """Hidden units, for a repertoire of eight."""
    hidden: int = 64
    """Hidden units for the other repertoires."""
    dims: tuple[int, ...] = (2, 3)
    """Dimensions to write in; 3 with a repertoire of eight only."""
    splines: int = 16
    """How many cubic splines one network learns; 0 leaves them out."""
    width_seeds: int = 1
    """How many of the seeds are repeated with other widths, and in three dimensions."""
    robot_hidden: int = 256
    """Hidden units for the robosuite skills."""
    cues: tuple[int, ...] = (1, 2, 5, 10, 20, 30)
    """Steps that are read before recall begins."""
    writings: int = 8
    """Writings of each letter to learn from."""
    robot_episodes: int = 40
    """Episodes of each robosuite skill to learn from; 0 leaves them out."""
    steps: int = 16000
    """Steps in which the synapses of the memory change."""
    updates: int = 1200
    """Updates of the networks trained by backpropagation through time, by 16 letters each."""

    def __post_init__(self) -> None:
        super().__post_init__()
        check_letters(*self.repertoires)
        at_least(1, self, "widths", "cues")
        for hidden in (*self.widths, self.hidden):
            wide_enough(hidden, 2 * 3)
        wide_enough(self.robot_hidden, SENSED)
        for cue in self.cues:
            if not 1 <= cue < STEPS:
                raise ValueError(f"a cue must be shorter than the letter, 1 to {STEPS - 1} steps, got {cue}")
        at_least(1, self, "writings", "steps", "updates")
        at_least(0, self, "robot_episodes", "splines", "width_seeds")
        if self.splines:
            check_letters(self.splines)
        if not (self.repertoires or self.splines or self.robot_episodes):
            raise ValueError("there is nothing to recall: repertoires, splines and robot_episodes are all left out")
        if 2 not in self.dims or not set(self.dims) <= {2, 3}:
            raise ValueError(f"letters are written in 2 dimensions, or in 2 and 3, got {self.dims}")

    def scaled(self) -> Args:
        """With ``quick``, little of everything."""
        if not self.quick:
            return self
        few = {"repertoires": (1, 4), "widths": (16, 32), "hidden": 32, "steps": 1500, "updates": 40, "splines": 2}
        return replace(self, seeds=min(self.seeds, 2), robot_episodes=0, writings=4, **few)  # type: ignore[arg-type]


def conditions(args: Args) -> list[Condition]:
    """Repertoires and splines for every seed; widths and three dimensions for some."""
    middle = _middle(args)
    few = args.repetitions[: args.width_seeds if args.repertoires else 0]
    all_seeds = [Condition(s, n, args.hidden, 2) for s in args.repetitions for n in args.repertoires]
    all_seeds += [Condition(s, args.splines, args.hidden, 2, "splines") for s in args.repetitions if args.splines]
    wide = [Condition(s, middle, h, 2) for s in few for h in args.widths]
    deep = [Condition(s, middle, args.hidden, d) for s in few for d in args.dims if d > 2]
    return list(dict.fromkeys(all_seeds + wide + deep))


def tables(records: Sequence[Record], args: Args) -> list[Table]:
    """Repertoires, widths, cues, splines, and robosuite."""
    middle, longest = _middle(args), max(args.cues)
    basis: Record = {"domain": "letters", "dims": 2, "skills": middle, "hidden": args.hidden, "cue": longest}

    def cell(right: bool, **where: Any) -> str:
        error = shown(records, "error_cm", **basis | where)
        return f"{error} ({over_seeds(records, 'right', **basis | where).mean:.2f})" if right and error else error

    def rows(key: str, values: Sequence[int], right: bool = True, **where: Any) -> list[tuple[str, ...]]:
        return [(CALLED[m], *(cell(right, **{**where, key: v, "model": m}) for v in values)) for m in MODELS]

    sizes, widths, cues = (("", *map(str, v)) for v in (args.repertoires, args.widths, args.cues))
    units = f"{args.hidden} units, cue of {longest}; mean ± SD over seeds, and share of right skills"
    made = []
    if args.repertoires:
        made.append(Table(f"Offline error [cm] by letters, {units}", sizes, rows("skills", args.repertoires)))
        online = rows("skills", args.repertoires, right=False, cue=STEPS)
        made.append(Table("Online error [cm] by letters", sizes, online))
    made += [
        Table(f"Offline error [cm] by cue, {n} letters", cues, rows("cue", args.cues, skills=n))
        for n in args.repertoires
        if n >= middle
    ]
    if args.splines:
        own = rows("cue", args.cues, domain="splines", skills=args.splines)
        made.append(Table(f"Offline error [cm] by cue, {args.splines} splines", cues, own))
    if args.repertoires and args.width_seeds:
        seeds = "one seed" if args.width_seeds == 1 else f"{args.width_seeds} seeds"
        where = f"{middle} letters, {seeds} for widths other than {args.hidden}"
        made.append(Table(f"Offline error [cm] by hidden units, {where}", widths, rows("hidden", args.widths)))
        if len(args.dims) > 1:
            heads = ("", *map(str, args.dims))
            made.append(Table(f"Offline error [cm] by dimensions, {middle} letters", heads, rows("dims", args.dims)))
    if args.robot_episodes:
        told = {"mean": "mean demonstration, told the skill"}
        names = {m: name for m, name in CALLED.items() if m != "memory_wide"} | told
        made.append(
            Table(
                f"Offline error of the hand [cm], one network for three robosuite skills, cue of {ROBOT_CUE}",
                ("", *RECALLED),
                [(names[m], *(shown(records, "error_cm", 1, domain=t, model=m) for t in RECALLED)) for m in names],
            )
        )
    return made


def _middle(args: Args) -> int:
    """The repertoire for which widths and dimensions are tried."""
    return 8 if 8 in args.repertoires else max(args.repertoires, default=0)


def drawn(records: Sequence[Record], args: Args) -> Figure:
    """Error by repertoire, width and cue; robosuite."""
    middle, longest = _middle(args), max(args.cues)
    base = {"domain": "letters", "dims": 2, "skills": middle, "hidden": args.hidden, "cue": longest}
    panels: list[tuple[str, str, Sequence[int], str]] = [
        ("skills", "skills in the repertoire", args.repertoires, "error_cm"),
        ("hidden", "hidden units", args.widths, "error_cm"),
        ("cue", "cue [steps]", args.cues, "error_cm"),
        ("cue", "cue [steps]", args.cues, "right"),
    ]
    if not args.width_seeds:
        del panels[1]
    if not args.repertoires:
        with figure(height=4.0, width=7.6) as fig:
            _robot(fig.subplots(), records, named=True)
            fig.legend(loc="outside right upper")
        return fig
    with figure(height=6.0, width=9.0) as fig:
        axes = fig.subplots(2, 3)
        for ax, (key, label, values, value) in zip(axes.flat, panels, strict=False):
            for i, model in enumerate(MODELS):
                found = [over_seeds(records, value, **{**base, key: v, "model": model}) for v in values]
                curve(ax, values, found, i, CALLED[model] if ax is axes[0, 0] else None)
            ax.set(xlabel=label, ylabel="offline error [cm]" if value == "error_cm" else "right skill [share]", ylim=0)
            if key != "cue":
                ax.set_xscale("log", base=2)
            ax.set_xticks(values, [str(v) for v in values])
        _online(axes[1, 1], records, args, base)
        if args.robot_episodes:
            _robot(axes[1, 2], records)
        for ax in axes.flat:
            ax.set_visible(ax.has_data())
        fig.legend(loc="outside upper center", ncols=3)
    return fig


def _online(ax: Any, records: Sequence[Record], args: Args, base: Record) -> None:
    for i, model in enumerate(MODELS):
        found = [
            over_seeds(records, "error_cm", **base | {"cue": STEPS, "skills": n, "model": model})
            for n in args.repertoires
        ]
        curve(ax, args.repertoires, found, i, None)
    ax.set_xscale("log", base=2)
    ax.set_xticks(args.repertoires, [str(v) for v in args.repertoires])
    ax.set(xlabel="skills in the repertoire", ylabel="online error [cm]", ylim=0)


def _robot(ax: Any, records: Sequence[Record], named: bool = False) -> None:
    names = [*(m for m in MODELS if m != "memory_wide"), "mean"]
    for i, model in enumerate(names):
        mean, spread = np.array([over_seeds(records, "error_cm", domain=t, model=model) for t in RECALLED]).T
        colour = look(i)[0] if model != "mean" else "#999999"
        x = np.arange(len(RECALLED)) + 0.12 * (i - 3)
        label = CALLED.get(model, "the mean") if named else None
        ax.bar(x, mean, 0.11, yerr=spread, color=colour, error_kw={"linewidth": 1}, label=label)
    ax.set_xticks(range(len(RECALLED)), [task.replace("Place", "Place\n") for task in RECALLED])
    ax.set(ylabel="offline hand error [cm]", title="robosuite; grey: the mean")


def study(args: Args, console: Console, seconds: dict[str, float]) -> Findings:
    """Runs every condition and sums up."""
    args = args.scaled()
    jobs: list[Callable[[], list[Record]]] = []
    if args.robot_episodes:
        train = demonstrations(args, SKILLS, "fit", args.robot_episodes, console, seconds)
        tests = demonstrations(args, SKILLS, "nominal", 15, console, seconds)
        sizes = args.robot_hidden, args.steps, args.updates // 2
        jobs += [partial(robot_recall.learned, seed, train, tests, *sizes) for seed in args.repetitions]
        jobs.append(partial(robot_recall.stored, train, tests, {"seed": args.seed, "hidden": args.robot_hidden}))
    # The longest first, so that no process is left with one of them at the end.
    practice = Practice(args.writings, args.steps, args.updates)
    jobs += [partial(recall, c, practice, args.cues) for c in conditions(args)]
    with stage("learning", console, seconds) as progress:
        records = [r for found in parallel_map(_done, jobs, args.workers, progress) for r in found]
    return Findings(records, tables(records, args), drawn(records, args), {})


def _done(job: Callable[[], list[Record]]) -> list[Record]:
    return job()


def main(argv: list[str] | None = None) -> int:
    """Runs the study, and returns the exit code."""
    return reproduce("memorise_and_recall", study, Args, __doc__, argv)


if __name__ == "__main__":
    sys.exit(main())
