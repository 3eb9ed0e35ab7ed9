"""Unnamed skills: how many there are in a stream, and where each begins, found without a label.

A memory has learned letters, and nobody said how many. Then it reads one long stream of letters in random order, each
broken off somewhere after its middle, and is never told where one ends. Where the error of the prediction leaves what
is usual, it asks whether the next few rows are better explained by what it carries on, or by beginning anew, and takes
the better. The states inside a segment, averaged, are clustered; there are as many skills as make the clusters stand
apart best. The adjusted Rand index says how well the segments, step by step, are
the letters that were written. The same is done with the rows instead of the states.

Sources: Zacks et al. 2007 (Psychological Bulletin 133(2)) for segments between errors of prediction; Rousseeuw 1987 for
the silhouette; Hubert and Arabie 1985 for the index.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray
from rich.console import Console
from sklearn.cluster import AgglomerativeClustering
from sklearn.metrics import adjusted_rand_score, silhouette_score

from asm_gym.episodes import Episode
from asm_gym.evaluation.figures import figure, look
from asm_gym.evaluation.tables import Table
from asm_gym.memory.energy import Array
from asm_gym.memory.recall import Recalled, follow
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
from asm_gym.scripts.reproduce.expression import Memory, Rows, read
from asm_gym.scripts.reproduce.handwriting import STEPS, check_letters, copybook, repertoire

USUAL = 0.999
"""Quantile of the errors within letters, over which another has begun."""

SHORTEST = 10
"""Steps between two beginnings at least."""

CONVINCED = 0.5
"""Share of the error of going on that beginning anew must stay below."""

AHEAD = 5
"""Steps by which it is settled whether something has begun."""

EARLY = 10
"""A segment is known by its states from this step on, for as many: all segments are long enough."""

NEAR = 3
"""Steps that a beginning may be off to count as found."""

SOURCES = {"state": "state of the memory", "row": "rows alone"}


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

    def __post_init__(self) -> None:
        super().__post_init__()
        at_least(1, self, "repertoires")
        check_letters(*self.repertoires, least=2)
        at_least(1, self, "writings", "steps")
        at_least(2, self, "length")
        wide_enough(self.hidden, 4)

    def scaled(self) -> Args:
        """With ``quick``, little of everything."""
        if not self.quick:
            return self
        return replace(self, seeds=min(self.seeds, 2), repertoires=(3,), hidden=32, writings=4, steps=1500)


def one(condition: tuple[int, int], args: Args) -> list[Record]:
    """What is found by one memory, for (seed, letters)."""
    seed, count = condition
    rng = np.random.default_rng(condition)
    letters = repertoire(count, 2, rng)
    train = copybook(letters, args.writings, 2, rng)
    memory = Memory.learned(train, args.hidden, rng, args.steps)
    stream, skill, begins = strung(copybook(letters, args.length, 2, rng), rng)
    rows = (stream - memory.reader.mean) / memory.reader.spread
    states, found = read_on(memory, stream, usual_error(memory, train))
    features = {"state": np.tanh(states), "row": rows}
    hits = [np.abs(found - b).min() <= NEAR for b in begins]
    true = [np.abs(begins - f).min() <= NEAR for f in found]
    records = []
    for source, values in features.items():
        named, skills = unnamed(values, found, 2 * count + 2)
        where = {"seed": seed, "skills": count, "source": source, "index": adjusted_rand_score(skill, named)}
        records.append({**where, "skills_found": skills, "found": float(np.mean(hits)), "true": float(np.mean(true))})
    return records


def strung(episodes: Sequence[Episode], rng: np.random.Generator) -> tuple[Rows, NDArray[np.str_], NDArray[np.intp]]:
    """One stream (T, D) of all episodes in random order, each broken off; (T,) its skill, and where each begins."""
    order = rng.permutation(len(episodes))
    lengths = rng.integers(STEPS // 2, STEPS + 1, len(order))
    parts = [episodes[n].stream[:k] for n, k in zip(order, lengths, strict=True)]
    skill = np.repeat([str(episodes[n].info["skill"]) for n in order], lengths)
    return np.concatenate(parts).astype(np.float64), skill, np.cumsum(lengths) - lengths


def usual_error(memory: Memory, episodes: Sequence[Episode]) -> float:
    """What the error of a row stays below in these; their first rows, of which little is known yet, do not count."""
    senses, commands = read(memory.reader, np.stack([e.stream for e in episodes], axis=1).astype(np.float64))
    start = memory.network.at_rest(len(episodes))
    return float(np.quantile(errors(memory, start, senses, commands)[0][SHORTEST:], USUAL))


def errors(memory: Memory, c: Array, senses: Array, commands: Array) -> tuple[NDArray[np.float64], Recalled]:
    """(T, B) mean square of what was not expected of each row, read after the traces ``c``; and what was."""
    recalled = follow(memory.network, c, senses, commands)
    wrong = np.concatenate([senses - recalled.senses, commands[:, :, :-1] - recalled.commands], axis=2)
    return np.mean(wrong.astype(np.float64) ** 2, axis=2), recalled


def read_on(memory: Memory, stream: Rows, usual: float) -> tuple[NDArray[np.float32], NDArray[np.intp]]:
    """The states (T, H) of a stream (T, D), and the steps where something was taken to begin."""
    senses, commands = read(memory.reader, stream[:, None])
    rest = memory.network.at_rest(1)
    c, begins, states = rest, [0], []
    for t in range(len(stream)):
        on, now = errors(memory, c, senses[t : t + 1], commands[t : t + 1])
        if on[0, 0] > usual and t - begins[-1] >= SHORTEST:
            on = errors(memory, c, senses[t : t + 1 + AHEAD], commands[t : t + 1 + AHEAD])[0]
            fresh = read(memory.reader, stream[t : t + 1 + AHEAD, None])  # nothing has moved yet
            anew = errors(memory, rest, *fresh)[0]
            if anew[1:].sum() < CONVINCED * on[1:].sum():
                begins.append(t)
                now = errors(memory, rest, fresh[0][:1], fresh[1][:1])[1]
        c = now.traces
        states.append(now.hidden[0, 0])
    return np.stack(states), np.array(begins)


def unnamed(values: NDArray[np.floating[Any]], found: NDArray[np.intp], most: int) -> tuple[NDArray[np.intp], int]:
    """(T,) the cluster of each step, and how many there are.

    Args:
        values: (T, C) what says which skill runs.
        found: where each segment begins.
        most: skills that are thought possible.
    """
    lengths = np.diff([*found, len(values)])
    parts = np.split(values, found[1:])
    segments = np.stack([part[min(EARLY, len(part) // 2) : 2 * EARLY].mean(axis=0) for part in parts])
    best = (-1.0, np.zeros(len(segments), np.intp))
    for count in range(2, min(most, len(segments) - 1) + 1):
        clusters = AgglomerativeClustering(count).fit_predict(segments)
        best = max(best, (float(silhouette_score(segments, clusters)), clusters), key=lambda b: b[0])
    return np.repeat(best[1], lengths), int(best[1].max()) + 1


def tables(records: Sequence[Record], args: Args) -> list[Table]:
    """Skills, beginnings and segments."""
    heads = ("", *map(str, args.repertoires))

    def row(label: str, value: str, source: str, digits: int = 2) -> tuple[str, ...]:
        return (label, *(shown(records, value, digits, skills=n, source=source) for n in args.repertoires))

    return [
        Table(
            "Skills found, by how many there are; mean ± SD over seeds",
            heads,
            [row(label, "skills_found", s, 1) for s, label in SOURCES.items()],
        ),
        Table("Adjusted Rand index of the segments", heads, [row(label, "index", s) for s, label in SOURCES.items()]),
        Table(
            f"Beginnings [share], within {NEAR} steps",
            heads,
            [row("of those that are, found", "found", "state"), row("of those found, true", "true", "state")],
        ),
    ]


def drawn(records: Sequence[Record], args: Args) -> Figure:
    """Skills found, and the index."""
    with figure(height=3.0, width=7) as fig:
        axes = fig.subplots(1, 2)
        for i, (source, label) in enumerate(SOURCES.items()):
            for ax, value in zip(axes, ("skills_found", "index"), strict=True):
                found = [over_seeds(records, value, skills=n, source=source) for n in args.repertoires]
                curve(ax, args.repertoires, found, i, label)
        axes[0].plot(args.repertoires, args.repertoires, color="#888888", linewidth=1, linestyle=look(0)[1])
        axes[0].set(xlabel="skills there are", ylabel="skills found", ylim=0)
        axes[1].set(xlabel="skills there are", ylabel="adjusted Rand index", ylim=(0, 1.02))
        axes[1].legend(fontsize=8)
    return fig


def study(args: Args, console: Console, seconds: dict[str, float]) -> Findings:
    """Every seed and repertoire."""
    args = args.scaled()
    conditions = [(seed, count) for seed in args.repetitions for count in args.repertoires]
    with stage("learning letters, and finding them", console, seconds) as progress:
        found = parallel_map(partial(one, args=args), conditions, args.workers, progress)
    records = [r for own in found for r in own]
    return Findings(records, tables(records, args), drawn(records, args), {})


def main(argv: list[str] | None = None) -> int:
    """Runs the study, and returns the exit code."""
    return reproduce("unnamed_skills", study, Args, __doc__, argv)


if __name__ == "__main__":
    sys.exit(main())
