"""Unnamed skills: how many there are in a stream, and where each begins, found without a label.

A memory has learned letters, and nobody said how many. Then it reads one long stream of letters in random order, each
broken off somewhere after its middle, and is never told where one ends. ``segments`` says how it finds that, and which
are the same. The adjusted Rand index (Hubert and Arabie 1985) says how well the segments, step by step, are the letters
that were written. The same is asked of the rows alone. Then all of it is asked of robosuite skills: whole episodes in
random order, and some in which one skill follows another.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray
from rich.console import Console

from asm_gym.episode import Episode
from asm_gym.evaluation.figures import figure, look
from asm_gym.evaluation.tables import Table
from asm_gym.rollouts.parallel import parallel_map
from asm_gym.rollouts.progress import stage
from asm_gym.scripts.command import at_least
from asm_gym.scripts.reproduce import robot_unnamed
from asm_gym.scripts.reproduce.common import (
    SENSED,
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
from asm_gym.scripts.reproduce.expression import Memory, Rows
from asm_gym.scripts.reproduce.handwriting import STEPS, check_letters, copybook, repertoire
from asm_gym.scripts.reproduce.segments import NEAR, SOURCES, judged, parted, unnamed
from asm_gym.scripts.reproduce.skill_switch import Switch, record_switch

USUAL = 0.999
"""Quantile of what is usual within letters."""

EARLY = slice(10, 20)
"""Steps of a segment by which its letter is known: all segments are long enough."""


@dataclass(frozen=True)
class Args(Common):
    """What a memory finds in a stream that nobody has labelled."""

    repertoires: tuple[int, ...] = (3, 6, 12)
    """How many letters there are to be found."""
    hidden: int = 64
    """Hidden units."""
    writings: int = 8
    """Writings of each letter to learn from."""
    length: int = 8
    """How often each letter comes in the stream."""
    steps: int = 12000
    """Steps in which the synapses change."""
    tasks: tuple[str, ...] = ("Lift", "Stack", "Door", "PickPlaceCan", "PickPlaceMilk", "NutAssemblySquare")
    """The robosuite skills."""
    robot_episodes: int = 16
    """Episodes of each robosuite skill to learn from; 0 leaves robosuite out."""
    robot_asked: int = 6
    """Episodes of each in the stream."""
    switches: int = 8
    """Episodes in the stream in which one skill follows another."""
    robot_hidden: int = 256
    """Hidden units for robosuite."""
    robot_steps: int = 4000
    """Steps in which the synapses change, for robosuite."""

    def __post_init__(self) -> None:
        super().__post_init__()
        check_letters(*self.repertoires, least=2)
        at_least(1, self, "tasks", "writings", "steps", "robot_asked", "robot_steps")
        at_least(2, self, "length")
        at_least(0, self, "robot_episodes", "switches")
        wide_enough(self.hidden, 4)
        wide_enough(self.robot_hidden, SENSED)
        if not (self.repertoires or self.robot_episodes):
            raise ValueError("there is nothing to find: repertoires and robot_episodes are both left out")

    def scaled(self) -> Args:
        """With ``quick``, little of everything."""
        if not self.quick:
            return self
        few = {"repertoires": (3,), "hidden": 32, "writings": 4, "steps": 1500}
        return replace(self, seeds=min(self.seeds, 2), robot_episodes=0, **few)  # type: ignore[arg-type]


def one(condition: tuple[int, int], args: Args) -> list[Record]:
    """What is found by one memory, for (seed, letters)."""
    seed, count = condition
    rng = np.random.default_rng(condition)
    letters = repertoire(count, 2, rng)
    train = copybook(letters, args.writings, 2, rng)
    memory = Memory.learned(train, args.hidden, rng, args.steps)
    stream, skill, begins = strung(copybook(letters, args.length, 2, rng), rng)
    records = []
    for source, found in parted(memory, train, stream, USUAL).items():
        named, skills = unnamed(found, 2 * count + 2, EARLY)
        where = {"domain": "letters", "seed": seed, "skills": count, "source": source, "skills_found": skills}
        records.append(where | judged(found, named, skill, begins))
    return records


def strung(episodes: Sequence[Episode], rng: np.random.Generator) -> tuple[Rows, NDArray[np.str_], NDArray[np.intp]]:
    """One stream (T, D) of all episodes in random order, each broken off; (T,) its skill, and where each begins."""
    order = rng.permutation(len(episodes))
    lengths = rng.integers(STEPS // 2, STEPS + 1, len(order))
    parts = [episodes[n].stream[:k] for n, k in zip(order, lengths, strict=True)]
    skill = np.repeat([str(episodes[n].info["skill"]) for n in order], lengths)
    return np.concatenate(parts).astype(np.float64), skill, np.cumsum(lengths) - lengths


def tables(records: Sequence[Record], args: Args) -> list[Table]:
    """Skills, beginnings and segments; of letters, and of robosuite."""
    made = []
    if args.repertoires:
        heads = ("", *map(str, args.repertoires))

        def rows(value: str, digits: int = 2) -> list[tuple[str, ...]]:
            return [
                (
                    label,
                    *(shown(records, value, digits, domain="letters", skills=n, source=s) for n in args.repertoires),
                )
                for s, label in SOURCES.items()
            ]

        made += [
            Table("Skills found, by how many there are; mean ± SD over seeds", heads, rows("skills_found", 1)),
            Table("Adjusted Rand index of the segments", heads, rows("index")),
            Table(f"Beginnings found [share of those that are], within {NEAR} steps", heads, rows("found")),
            Table(f"Beginnings that are true [share of those found], within {NEAR} steps", heads, rows("true")),
        ]
    if args.robot_episodes:
        asked = {
            f"skills found, of {len(args.tasks)}": ("skills_found", 1),
            "adjusted Rand index": ("index", 2),
            "the same, of episodes with one skill": ("index_single", 2),
            "beginnings of episodes, found": ("starts", 2),
            "changes within an episode, found": ("changes", 2),
            "beginnings that are true, of those found": ("true", 2),
        }
        of = {"domain": "robosuite"}
        each = [
            (label, *(shown(records, value, digits, source=s, **of) for s in SOURCES))
            for label, (value, digits) in asked.items()
        ]
        episodes = f"{args.robot_asked} episodes of each skill, {args.switches} with a change"
        made.append(Table(f"Robosuite, {episodes}; mean ± SD over seeds", ("", *SOURCES.values()), each))
    return made


def drawn(records: Sequence[Record], args: Args) -> Figure:
    """Skills found, and the index; of letters by how many there are, or of robosuite."""
    with figure(height=3.0, width=7) as fig:
        axes = fig.subplots(1, 2)
        letters = bool(args.repertoires)
        counts = args.repertoires if letters else (len(args.tasks),)
        for i, (source, label) in enumerate(SOURCES.items()):
            for ax, value in zip(axes, ("skills_found", "index"), strict=True):
                of = {"domain": "letters" if letters else "robosuite", "source": source}
                curve(ax, counts, [over_seeds(records, value, skills=n, **of) for n in counts], i, label)
        axes[0].plot(counts, counts, color="#888888", linewidth=1, linestyle=look(0)[1])
        axes[0].set(xlabel="skills there are", ylabel="skills found", ylim=0)
        axes[1].set(xlabel="skills there are", ylabel="adjusted Rand index", ylim=(0, 1.02))
        axes[1].legend(fontsize=8)
    return fig


def study(args: Args, console: Console, seconds: dict[str, float]) -> Findings:
    """Every seed and repertoire, and robosuite."""
    args = args.scaled()
    jobs: list[Callable[[], list[Record]]] = []
    if args.robot_episodes:
        train = demonstrations(args, args.tasks, "fit", args.robot_episodes, console, seconds)
        asked = demonstrations(args, args.tasks, "nominal", args.robot_asked, console, seconds)
        with stage("changing skills", console, seconds) as progress:
            wanted = [args.out / "switches" / f"{args.seed + n}.npz" for n in range(args.switches)]
            paths = parallel_map(record_switch, wanted, args.workers, progress)
        asked += [Switch.read(path, train[0].spec).episode for path in paths]
        sizes = args.robot_hidden, args.robot_steps
        jobs += [partial(robot_unnamed.found, seed, train, asked, *sizes) for seed in args.repetitions]
    jobs += [partial(one, (seed, count), args) for seed in args.repetitions for count in args.repertoires]
    with stage("learning skills, and finding them", console, seconds) as progress:
        found = parallel_map(_done, jobs, args.workers, progress)
    records = [r for own in found for r in own]
    return Findings(records, tables(records, args), drawn(records, args), {})


def _done(job: Callable[[], list[Record]]) -> list[Record]:
    return job()


def main(argv: list[str] | None = None) -> int:
    """Runs the study, and returns the exit code."""
    return reproduce("unnamed_skills", study, Args, __doc__, argv)


if __name__ == "__main__":
    sys.exit(main())
