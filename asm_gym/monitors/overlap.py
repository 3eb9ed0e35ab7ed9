"""Whether episodes are fresh: whether stretches of rows stand in two of them, or were learned from.

    mark of a stretch = hash(x_t, …, x_{t+L-1})

Sensors are noisy, so the same second of numbers twice is the same second. A stretch in which a row repeats the one
before is left out: a robot that stands still without noise is not told apart from another that does.

A memory keeps the few least marks of each episode that it learned from (bottom sketch, Broder 1997), whichever rows
they are of: an episode that is cut or joined anew is known by them, as long as such a stretch is whole.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from asm_gym.episode import Episode

STRETCH = 20
"""L, rows. Episodes that are shorter cannot be told."""

KEPT = 8
"""Marks of an episode that a memory keeps."""

BITS = np.uint64(12)
"""That are dropped of 64, so that a double holds the rest exactly."""

Marks = NDArray[np.float64]
_Hash = NDArray[np.uint64]


def marks(episode: Episode) -> Marks:
    """One for each stretch of an episode, in order; none where a row repeats the one before."""
    rows = np.ascontiguousarray(episode.stream, np.float32) + np.float32(0)  # of two zeros one
    steps, width = rows.shape
    if steps < STRETCH:
        return np.zeros(0)
    row = _mixed((rows.view(np.uint32).astype(np.uint64) * _odd(width)).sum(axis=1, dtype=np.uint64))  # (T,)
    found = sum(row[n : steps - STRETCH + 1 + n] * m for n, m in enumerate(_odd(STRETCH)))
    still = np.concatenate([[0], np.cumsum(row[1:] == row[:-1])])  # (T,) repetitions so far
    moves = still[STRETCH - 1 :] == still[: steps - STRETCH + 1]
    kept: Marks = (_mixed(np.asarray(found, np.uint64)) >> BITS)[moves].astype(np.float64)
    return kept


def sketch(episodes: Sequence[Episode]) -> Marks:
    """What is kept of episodes that are learned from."""
    kept: Marks = np.unique(np.concatenate([np.zeros(0), *(np.sort(marks(e))[:KEPT] for e in episodes)]))
    return kept


def shares(found: Marks, *learned: Marks | None) -> bool:
    """Whether one of these marks is of what was learned from; no, where that is not known."""
    return any(some is not None and np.isin(found, some).any() for some in learned)


def check_fresh(episodes: Sequence[Episode], *learned: Marks | None) -> None:
    """Raises ValueError where two episodes share a stretch of rows, or one was learned from.

    Args:
        *learned: as ``sketch`` kept it; None where that is not known.
    """
    own = [np.unique(marks(e)) for e in episodes]
    for n, found in enumerate(own):
        if shares(found, *learned):
            raise ValueError(
                f"episode {n} was learned from: such episodes surprise too little to promise by; give others"
            )
    which = np.repeat(np.arange(len(own)), [len(found) for found in own])
    everything = np.concatenate([np.zeros(0), *own])
    order = np.argsort(everything, kind="stable")
    twice = np.flatnonzero(np.diff(everything[order]) == 0)
    if len(twice):
        first, second = which[order[twice[0]]], which[order[twice[0] + 1]]
        raise ValueError(
            f"episodes {first} and {second} overlap, {STRETCH} rows or more are the same: give each hour once"
        )


def _odd(count: int) -> _Hash:
    return _mixed(np.arange(1, count + 1, dtype=np.uint64)) | np.uint64(1)


def _mixed(x: _Hash) -> _Hash:
    """The last step of SplitMix64 (Steele et al. 2014), modulo 2⁶⁴."""
    for shift, factor in ((30, 0xBF58476D1CE4E5B9), (27, 0x94D049BB133111EB)):
        x = (x ^ (x >> np.uint64(shift))) * np.uint64(factor)
    mixed: NDArray[Any] = x ^ (x >> np.uint64(31))
    return mixed
