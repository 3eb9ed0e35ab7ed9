"""Unnamed robosuite skills: whole episodes one after another, and some in which one skill follows another by itself."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from asm_gym.episodes import Episode
from asm_gym.monitors.model import running
from asm_gym.scripts.reproduce.common import Record
from asm_gym.scripts.reproduce.expression import Memory, Rows
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
    stream, skill, starts, changes = joined([asked[n] for n in rng.permutation(len(asked))])
    count = len(set(skill))
    records = []
    for source, own in parted(memory, train, stream, USUAL).items():
        named, skills = unnamed(own, 2 * count + 2, *KNOWN_BY)
        where = {"domain": "robosuite", "seed": seed, "skills": count, "source": source, "skills_found": skills}
        record = where | judged(own, named, skill, np.sort(np.concatenate([starts, changes])))
        record |= {"starts": share_near(starts, own.begins), "changes": share_near(changes, own.begins)}
        records.append(record)
    return records


def joined(
    episodes: Sequence[Episode],
) -> tuple[Rows, NDArray[np.str_], NDArray[np.intp], NDArray[np.intp]]:
    """One stream (T, D) of whole episodes, (T,) the skill that runs, where each episode begins, and where each changes.

    A change of skill within an episode goes without a jump.
    """
    skills = [running(e) for e in episodes]
    starts = np.cumsum([0, *map(len, episodes)])[:-1]
    changes = [start + np.flatnonzero(s[1:] != s[:-1]) + 1 for start, s in zip(starts, skills, strict=True)]
    stream = np.concatenate([e.stream for e in episodes]).astype(np.float64)
    return stream, np.concatenate(skills), starts, np.concatenate(changes)
