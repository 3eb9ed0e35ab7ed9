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

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
from matplotlib.figure import Figure

from asm_gym.episode import Episode
from asm_gym.evaluation.figures import figure
from asm_gym.evaluation.tables import Table
from asm_gym.scripts.options import option
from asm_gym.scripts.reproduce import kit
from asm_gym.scripts.reproduce.curves import curve
from asm_gym.scripts.reproduce.expression import Memory, mean_demonstrations, recalled
from asm_gym.scripts.reproduce.handwriting import NAMES, NOISE, check_letters, copybook, pen_spec, repertoire
from asm_gym.scripts.reproduce.kit import Findings, Record, over_seeds
from asm_gym.scripts.reproduce.recordings import wide_enough

WAYS = ("at once", "one after another", "replay from a cue", "replay from nothing")
BEGUN = 8
"""Rows that begin a replay."""

CUE = 20
"""Rows that are read before a letter is asked for."""


@dataclass(frozen=True)
class Config(kit.Config):
    """What is kept of skills that were learned first."""

    skills: int = option(8, quick=4, check=partial(check_letters, least=2))
    """Letters."""
    blocks: int = option(4, quick=2, least=2)
    """Lessons that the letters are shared out to, one block each."""
    hidden: int = option(64, quick=32, check=partial(wide_enough, channels=4))
    """Hidden units."""
    writings: int = option(8, quick=4, least=1)
    """Writings of each letter to learn from, and replays of each."""
    steps: int = option(16000, quick=1500, least=1)
    """Steps in which the synapses change, in all."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.skills % self.blocks:
            raise ValueError(f"{self.skills} skills cannot be shared out evenly among {self.blocks} blocks")


def one_seed(seed: int, config: Config) -> list[Record]:
    """Every way, and after each lesson every block that was learned so far."""
    rng = np.random.default_rng(seed)
    letters = repertoire(config.skills, 2, rng)
    train, tests = copybook(letters, config.writings, 2, rng), copybook(letters, 4, 2, rng)
    means = mean_demonstrations(train, 2)

    def of(block: int, episodes: Sequence[Episode]) -> list[Episode]:
        each = len(episodes) // config.blocks
        return list(episodes[block * each : (block + 1) * each])

    records = []
    for way in WAYS:
        own = np.random.default_rng(seed)
        lessons = [train] if way == "at once" else [of(block, train) for block in range(config.blocks)]
        memory = Memory.untaught(lessons[0], config.hidden, own, 5, 30.0)
        known: list[Episode] = []
        for number, lesson in enumerate(lessons):
            again = replayed(memory, known, way, config.writings, own)
            memory = memory.taught([*lesson, *again], own, config.steps // len(lessons))
            # What was made up stands for what was seen, so that nothing else need be kept.
            known = [*again, *lesson] if way == "replay from nothing" else [*known, *lesson[:: config.writings]]
            for block in range(config.blocks if way == "at once" else number + 1):
                error, right = recalled(memory, of(block, tests), means, CUE, NAMES[: config.skills])
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


def tables(records: Sequence[Record], config: Config) -> list[Table]:
    """By way: what is left of each block after the last lesson."""
    blocks = {f"block {b}": {"block": b} for b in range(1, config.blocks + 1)} | {"all": {}}
    ways = {way: {"way": way, "last": True} for way in WAYS}
    what = f"of {config.skills} letters in {config.blocks} blocks after the last lesson"
    what += f", cue of {CUE}; mean ± SD over seeds"
    return [
        kit.grid(f"Offline error [cm] {what}", records, "error_cm", ways, blocks),
        kit.grid("Right letter recalled [share]", records, "right", ways, blocks),
    ]


def drawn(records: Sequence[Record], config: Config) -> Figure:
    """The first block over the lessons, and each block after the last."""
    lessons = range(1, config.blocks + 1)
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


def run(config: Config) -> Findings:
    """Every seed."""
    work = partial(one_seed, config=config)
    records = kit.together(kit.each("learning letters in blocks", work, config.repetitions, config))
    return Findings(records, tables(records, config), drawn(records, config))
