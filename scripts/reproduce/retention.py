"""Retention: skills learned one after another, and what the last leave of the first.

The same letters are learned by the same memory in four ways, in as many updates:

at once               all letters together
one after another     block by block, and nothing of those before
replay from a cue     beside each block, what the memory itself recalls
replay from nothing   the same, begun by chance

A cue is the first rows of one writing of a letter, which is all that is kept of it. What is begun by chance begins with
rows drawn from a Gaussian of how writings have begun.

Sources: McCloskey and Cohen 1989 for forgetting in blocks; Robins 1995 (Connection Science 7(2)) for rehearsal of what
a network itself makes.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from matplotlib.figure import Figure
from rich.console import Console

from asm_gym.episode import Episode
from asm_gym.evaluation.figures import figure
from asm_gym.evaluation.tables import Table
from asm_gym.rollouts.parallel import parallel_map
from asm_gym.rollouts.progress import stage
from asm_gym.scripts.command import at_least
from asm_gym.scripts.reproduce.common import (
    Common,
    Findings,
    Record,
    over_seeds,
    reproduce,
    shown,
    wide_enough,
)
from asm_gym.scripts.reproduce.curves import curve
from asm_gym.scripts.reproduce.expression import Memory, mean_demonstrations, recalled
from asm_gym.scripts.reproduce.handwriting import NAMES, NOISE, check_letters, copybook, pen_spec, repertoire

WAYS = ("at once", "one after another", "replay from a cue", "replay from nothing")
BEGUN = 8
"""Rows that begin a replay."""

CUE = 20
"""Rows that are read before a letter is asked for."""


@dataclass(frozen=True)
class Args(Common):
    """What is kept of skills that were learned first."""

    skills: int = 8
    """Letters."""
    blocks: int = 4
    """Lessons that the letters are shared out to, one block each."""
    hidden: int = 64
    """Hidden units."""
    writings: int = 8
    """Writings of each letter to learn from, and replays of each."""
    steps: int = 16000
    """Steps in which the synapses change, in all."""

    def __post_init__(self) -> None:
        super().__post_init__()
        check_letters(self.skills, least=2)
        at_least(2, self, "blocks")
        if self.skills % self.blocks:
            raise ValueError(f"{self.skills} skills cannot be shared out evenly among {self.blocks} blocks")
        at_least(1, self, "writings", "steps")
        wide_enough(self.hidden, 4)

    def scaled(self) -> Args:
        """With ``quick``, little of everything."""
        if not self.quick:
            return self
        return replace(self, seeds=min(self.seeds, 2), skills=4, blocks=2, hidden=32, writings=4, steps=1500)


def one_seed(seed: int, args: Args) -> list[Record]:
    """Every way, and after each lesson every block that was learned so far."""
    rng = np.random.default_rng(seed)
    letters = repertoire(args.skills, 2, rng)
    train, tests = copybook(letters, args.writings, 2, rng), copybook(letters, 4, 2, rng)
    means = mean_demonstrations(train, 2)

    def of(block: int, episodes: Sequence[Episode]) -> list[Episode]:
        each = len(episodes) // args.blocks
        return list(episodes[block * each : (block + 1) * each])

    records = []
    for way in WAYS:
        own = np.random.default_rng(seed)
        lessons = [train] if way == "at once" else [of(block, train) for block in range(args.blocks)]
        memory = Memory.untaught(lessons[0], args.hidden, own, 5, 30.0)
        known: list[Episode] = []
        for number, lesson in enumerate(lessons):
            again = replayed(memory, known, way, args.writings, own)
            memory = memory.taught([*lesson, *again], own, args.steps // len(lessons))
            # What was made up stands for what was seen, so that nothing else need be kept.
            known = [*again, *lesson] if way == "replay from nothing" else [*known, *lesson[:: args.writings]]
            for block in range(args.blocks if way == "at once" else number + 1):
                error, right = recalled(memory, of(block, tests), means, CUE, NAMES[: args.skills])
                where = {"seed": seed, "way": way, "after": number + 1, "block": block + 1}
                records.append({**where, "last": number + 1 == len(lessons), "error_cm": error, "right": right})
    return records


def replayed(
    memory: Memory, known: Sequence[Episode], way: str, writings: int, rng: np.random.Generator
) -> list[Episode]:
    """What the memory makes of the letters that it knows; nothing where this way has no replay, or it knows none.

    Args:
        known: of a replay from a cue one writing of each letter, whose first rows are read; from nothing, what it was
            taught last, of whose beginnings mean and covariance are read.
        writings: replays of each letter.
    """
    if not known or not way.startswith("replay"):
        return []
    begun = np.stack([e.stream[:BEGUN] for e in known]).astype(np.float64)  # (N, BEGUN, D)
    if way == "replay from a cue":
        begun = np.repeat(begun, writings, axis=0)
        begun[:, :, :2] += NOISE * rng.standard_normal(begun[:, :, :2].shape)
    else:
        flat = begun.reshape(len(begun), -1)
        begun = rng.multivariate_normal(flat.mean(axis=0), np.cov(flat.T), len(begun)).reshape(begun.shape)
    streams = np.zeros((len(known[0]), len(begun), begun.shape[2]))
    streams[:BEGUN] = begun.transpose(1, 0, 2)
    streams[BEGUN:] = memory.express(streams, BEGUN)[BEGUN:]
    noise = NOISE * rng.standard_normal((*streams.shape[:2], 2))  # a pen is sensed with noise, and is dreamt of without
    streams[BEGUN:, :, :2] += noise[BEGUN:]
    return [Episode.from_stream(streams[:, n], pen_spec(2)) for n in range(streams.shape[1])]


def tables(records: Sequence[Record], args: Args) -> list[Table]:
    """By way: what is left of each block after the last lesson."""
    blocks = range(1, args.blocks + 1)
    heads = ("", *(f"block {b}" for b in blocks), "all")

    def rows(value: str) -> list[tuple[str, ...]]:
        def last(way: str, **where: int) -> str:
            return shown(records, value, way=way, last=True, **where)

        return [(way, *(last(way, block=b) for b in blocks), last(way)) for way in WAYS]

    what = f"of {args.skills} letters in {args.blocks} blocks after the last lesson, cue of {CUE}; mean ± SD over seeds"
    return [
        Table(f"Offline error [cm] {what}", heads, rows("error_cm")),
        Table("Right letter recalled [share]", heads, rows("right")),
    ]


def drawn(records: Sequence[Record], args: Args) -> Figure:
    """The first block over the lessons, and each block after the last."""
    lessons = range(1, args.blocks + 1)
    with figure(height=3.0, width=8) as fig:
        axes = fig.subplots(1, 2)
        for i, way in enumerate(WAYS):
            if way != "at once":
                first = [over_seeds(records, "error_cm", way=way, after=n, block=1) for n in lessons]
                curve(axes[0], lessons, first, i, None)
            left = [over_seeds(records, "error_cm", way=way, last=True, block=b) for b in lessons]
            curve(axes[1], lessons, left, i, way)
        axes[0].set(xlabel="lessons so far", ylabel="offline error [cm]", title="the first block", ylim=0)
        axes[1].set(xlabel="block", title="after the last lesson", ylim=0)
        for ax in axes:
            ax.set_xticks(lessons)
        fig.legend(loc="outside upper center", ncols=4)
    return fig


def study(args: Args, console: Console, seconds: dict[str, float]) -> Findings:
    """Every seed."""
    args = args.scaled()
    with stage("learning letters in blocks", console, seconds) as progress:
        found = parallel_map(partial(one_seed, args=args), list(args.repetitions), args.workers, progress)
    records = [r for own in found for r in own]
    return Findings(records, tables(records, args), drawn(records, args), {})


def main(argv: list[str] | None = None) -> int:
    """Runs the study, and returns the exit code."""
    return reproduce("retention", study, Args, __doc__, argv)


if __name__ == "__main__":
    sys.exit(main())
