"""Memorise and recall: one network learns a repertoire without labels, and expresses each skill from a cue.

Repertoires of handwriting-like movements in two and three dimensions, and three robosuite skills. The temporal
predictive coding network on traces, learned by local rules, against a GRU and a plain RNN of the same width trained by
backpropagation through time; the GRU with errors that go back one step, which is as local; a modern continuous Hopfield
network, which keeps every window; and a library of movement primitives, which is told the skill. Online, every row is
read after it was expected; offline, none after the cue.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, NamedTuple

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
from asm_gym.scripts.reproduce.expression import (
    Backpropagated,
    Expresser,
    Hopfield,
    Library,
    Memory,
    mean_demonstrations,
    recalled,
)
from asm_gym.scripts.reproduce.handwriting import NAMES, STEPS, check_letters, copybook, repertoire
from asm_gym.scripts.reproduce.robot_recall import RECALLED, ROBOT_CUE

MODELS = ("memory", "gru", "rnn", "gru_one_step", "hopfield", "library")
CALLED = {
    "memory": "temporal predictive coding, local",
    "gru": "GRU, BPTT",
    "rnn": "RNN, BPTT",
    "gru_one_step": "GRU, BPTT of one step",
    "hopfield": "modern Hopfield",
    "library": "primitives, told the skill",
}


@dataclass(frozen=True)
class Args(Common):
    """Recall from a cue, against what else can recall."""

    repertoires: tuple[int, ...] = (1, 2, 4, 8, 16, 32)
    """How many letters one network learns."""
    widths: tuple[int, ...] = (16, 32, 64, 128, 256, 512)
    """Hidden units, for a repertoire of eight."""
    hidden: int = 64
    """Hidden units for the other repertoires."""
    dims: tuple[int, ...] = (2, 3)
    """Dimensions to write in; 3 with a repertoire of eight only."""
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
        at_least(1, self, "repertoires", "widths", "cues")
        for hidden in (*self.widths, self.hidden):
            wide_enough(hidden, 2 * 3)
        wide_enough(self.robot_hidden, SENSED)
        for cue in self.cues:
            if not 1 <= cue < STEPS:
                raise ValueError(f"a cue must be shorter than the letter, 1 to {STEPS - 1} steps, got {cue}")
        at_least(1, self, "writings", "steps", "updates")
        at_least(0, self, "robot_episodes")
        if 2 not in self.dims or not set(self.dims) <= {2, 3}:
            raise ValueError(f"letters are written in 2 dimensions, or in 2 and 3, got {self.dims}")

    def scaled(self) -> Args:
        """With ``quick``, little of everything."""
        if not self.quick:
            return self
        few = {"repertoires": (1, 4), "widths": (16, 32), "hidden": 32, "steps": 1500, "updates": 40}
        return replace(self, seeds=min(self.seeds, 2), robot_episodes=0, writings=4, **few)  # type: ignore[arg-type]


class Condition(NamedTuple):
    """What one network is asked to learn."""

    seed: int
    skills: int
    hidden: int
    dims: int


def conditions(args: Args) -> list[Condition]:
    """Repertoires, then widths, then three dimensions."""
    middle = 8 if 8 in args.repertoires else max(args.repertoires)
    plan = [(n, args.hidden, 2) for n in args.repertoires] + [(middle, h, 2) for h in args.widths]
    plan += [(middle, args.hidden, d) for d in args.dims if d > 2]
    return [Condition(s, *p) for s in args.repetitions for p in dict.fromkeys(plan)]


def letters(condition: Condition, args: Args) -> list[Record]:
    """Every model on one repertoire."""
    seed, skills, hidden, dims = condition
    rng = np.random.default_rng([seed, dims])
    repertory = repertoire(len(NAMES), dims, rng)[:skills]
    train, tests = copybook(repertory, args.writings, dims, rng), copybook(repertory, 4, dims, rng)
    told = [str(e.info["skill"]) for e in tests]
    models: dict[str, Expresser] = {
        "memory": Memory.learned(train, hidden, rng, args.steps),
        "gru": Backpropagated.learned(train, "gru", hidden, rng, args.updates),
        "rnn": Backpropagated.learned(train, "rnn", hidden, rng, args.updates),
        "gru_one_step": Backpropagated.learned(train, "gru", hidden, rng, args.updates, truncated=True),
        "hopfield": Hopfield.learned(train),
        "library": Library.learned(train, told),
    }
    means = mean_demonstrations(train, dims)
    records: list[Record] = []
    for name, model in models.items():
        for cue in (*args.cues, STEPS):
            error, right = recalled(model, tests, means, cue)
            where = {"domain": "letters", "model": name, **condition._asdict(), "cue": cue, "online": cue == STEPS}
            records.append({**where, "error_cm": error, "right": right})
    return records


def tables(records: Sequence[Record], args: Args) -> list[Table]:
    """Repertoires, widths, cues, and robosuite."""
    middle = 8 if 8 in args.repertoires else max(args.repertoires)
    longest = max(args.cues)

    def rows(key: str, values: Sequence[int], value: str = "error_cm", **where: Any) -> list[tuple[str, ...]]:
        own = {"domain": "letters", "dims": 2, "skills": middle, "hidden": args.hidden, "cue": longest, **where}
        return [(CALLED[m], *(shown(records, value, **own | {key: v, "model": m}) for v in values)) for m in MODELS]

    sizes, widths, cues = (("", *map(str, v)) for v in (args.repertoires, args.widths, args.cues))
    units = f"{args.hidden} units, cue of {longest}; mean ± SD over seeds"
    made = [
        Table(f"Offline error [cm] by skills, {units}", sizes, rows("skills", args.repertoires)),
        Table(f"Right skill recalled [share] by skills, {units}", sizes, rows("skills", args.repertoires, "right")),
        Table("Online error [cm] by skills", sizes, rows("skills", args.repertoires, cue=STEPS)),
        Table(f"Offline error [cm] by hidden units, {middle} skills", widths, rows("hidden", args.widths)),
        Table(f"Offline error [cm] by cue, {middle} skills", cues, rows("cue", args.cues)),
        Table(f"Right skill recalled [share] by cue, {middle} skills", cues, rows("cue", args.cues, "right")),
    ]
    if len(args.dims) > 1:
        heads = ("", *map(str, args.dims))
        made.append(Table(f"Offline error [cm] by dimensions, {middle} skills", heads, rows("dims", args.dims)))
    if args.robot_episodes:
        names = {**CALLED, "mean": "mean demonstration, told the skill"}
        made.append(
            Table(
                f"Offline error of the hand [cm], one network for three robosuite skills, cue of {ROBOT_CUE}",
                ("", *RECALLED),
                [(names[m], *(shown(records, "error_cm", 1, domain=t, model=m) for t in RECALLED)) for m in names],
            )
        )
    return made


def drawn(records: Sequence[Record], args: Args) -> Figure:
    """Error by repertoire, width and cue; robosuite."""
    middle = 8 if 8 in args.repertoires else max(args.repertoires)
    longest = max(args.cues)
    base = {"domain": "letters", "dims": 2, "skills": middle, "hidden": args.hidden, "cue": longest}
    panels: list[tuple[str, str, Sequence[int], str]] = [
        ("skills", "skills in the repertoire", args.repertoires, "error_cm"),
        ("hidden", "hidden units", args.widths, "error_cm"),
        ("cue", "cue [steps]", args.cues, "error_cm"),
        ("cue", "cue [steps]", args.cues, "right"),
    ]
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
        _robot(axes[1, 2], records)
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


def _robot(ax: Any, records: Sequence[Record]) -> None:
    names = [*MODELS, "mean"]
    for i, model in enumerate(names):
        mean, spread = np.array([over_seeds(records, "error_cm", domain=t, model=model) for t in RECALLED]).T
        colour = look(i)[0] if model != "mean" else "#999999"
        x = np.arange(len(RECALLED)) + 0.12 * (i - 3)
        ax.bar(x, mean, 0.11, yerr=spread, color=colour, error_kw={"linewidth": 1})
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
    jobs += [partial(letters, condition, args) for condition in conditions(args)]
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
