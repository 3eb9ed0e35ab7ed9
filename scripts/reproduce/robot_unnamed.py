"""Unnamed robosuite skills: whole episodes one after another, and some in which one skill follows another by itself."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from sklearn.metrics import adjusted_rand_score

from asm_gym.episode import Episode
from asm_gym.monitors.model import running
from asm_gym.scripts.reproduce.expression import Memory, Rows
from asm_gym.scripts.reproduce.kit import Record
from asm_gym.scripts.reproduce.segments import judged, parted, share_near, unnamed

KNOWN_BY = slice(0, None), slice(-20, None)
"""Rows of a segment by which its skill is known: all, and how it ends."""

USUAL = 1.0
"""Quantile of what is usual within skills: the most, for there are ten times as many rows as in letters."""


def found(seed: int, train: Sequence[Episode], asked: Sequence[Episode], hidden: int, steps: int) -> list[Record]:
    """What one memory finds in a stream of robosuite episodes.

    Args:
        train: what it learns from, nothing but their rows.
        asked: the episodes of the stream; they say which skill runs in each row.
        hidden: units.
        steps: in which its synapses change.
    """
    rng = np.random.default_rng(seed)
    memory = Memory.learned(train, hidden, rng, steps)
    stream = joined([asked[n] for n in rng.permutation(len(asked))])
    count = len(set(stream.skill))
    records = []
    for source, own in parted(memory, train, stream.rows, USUAL).items():
        named, skills = unnamed(own, 2 * count + 2, *KNOWN_BY)
        where = {"domain": "robosuite", "seed": seed, "skills": count, "source": source, "skills_found": skills}
        record = where | judged(own, named, stream.skill, np.sort(np.concatenate([stream.starts, stream.changes])))
        for name, rows in (("starts", stream.starts), ("changes", stream.changes)):
            record[name] = share_near(rows, own.begins) if len(rows) else None
        record["index_single"] = adjusted_rand_score(stream.skill[stream.single], named[stream.single])
        records.append(record)
    return records


class Stream(NamedTuple):
    """Whole episodes one after another."""

    rows: Rows  # (T, D)
    skill: NDArray[np.str_]  # (T,) what runs
    starts: NDArray[np.intp]  # where each episode begins
    changes: NDArray[np.intp]  # where one skill follows another within an episode, which goes without a jump
    single: NDArray[np.bool_]  # (T,) rows of episodes with one skill


def joined(episodes: Sequence[Episode]) -> Stream:
    """One stream of these, which say which skill runs in each row."""
    skills = [running(e) for e in episodes]
    starts = np.cumsum([0, *map(len, episodes)])[:-1]
    changes = [start + np.flatnonzero(s[1:] != s[:-1]) + 1 for start, s in zip(starts, skills, strict=True)]
    single = np.concatenate([np.full(len(s), len(set(s)) == 1) for s in skills])
    rows = np.concatenate([e.stream for e in episodes]).astype(np.float64)
    return Stream(rows, np.concatenate(skills), starts, np.concatenate(changes), single)
