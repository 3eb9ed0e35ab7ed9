"""Episodes to learn from and to calibrate on: valid, and fresh where a promise is made of them.

    mark of a stretch = hash(x_t, …, x_{t+L-1})

Sensors are noisy, so a stretch of numbers that occurs twice is the same stretch; one in which a row repeats the one
before has no mark. A monitor keeps the least marks of each episode that it learned from (bottom sketch, Broder 1997),
so that an episode that is cut or joined anew is known by them.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from asm_gym.episode import Episode
from asm_gym.spec import StreamSpec

WILD = 1e6
"""Largest distance of a number from its channel's median, in ranges of the channel."""

STRETCH = 20
"""L [rows]. Shorter episodes have no marks."""

KEPT = 8
"""Marks of an episode that a monitor keeps."""

BITS = np.uint64(12)
"""Dropped of 64, so that a double holds the rest exactly."""

Marks = NDArray[np.float64]
_Hash = NDArray[np.uint64]


def check_nominal(episodes: Sequence[Episode], spec: StreamSpec, shortest: int) -> None:
    """Raise ValueError for episodes that a monitor of this stream cannot learn from."""
    if isinstance(episodes, Episode):
        raise TypeError("episodes must be a list of them, got a single Episode")
    if len(episodes) == 0:
        raise ValueError("at least one episode is needed, got none")
    for n, episode in enumerate(episodes):
        spec.require(episode.spec, f"episode {n}")
        if len(episode) < shortest:
            raise ValueError(f"episode {n} must be at least {shortest} steps long, got {len(episode)}")
        bad = np.argwhere(~np.isfinite(episode.stream))
        if len(bad):
            step, column = bad[0]
            label, value = spec.labels[column], episode.stream[step, column]
            raise ValueError(f"episode {n}, step {step}, {label} must be finite, got {value}")
    _check_range(episodes)


def _check_range(episodes: Sequence[Episode]) -> None:
    """Raise ValueError for a number out of all proportion, beside which its channel would look constant."""
    if max(float(np.abs(e.stream).max()) for e in episodes) <= WILD / 2:
        return
    rows = np.concatenate([e.stream for e in episodes]).astype(np.float64)
    low, middle, high = np.quantile(rows, (0.01, 0.5, 0.99), axis=0)
    reach = WILD * np.maximum(np.maximum(high - low, np.abs(middle)), 1.0)
    for n, episode in enumerate(episodes):
        wild = np.argwhere(np.abs(episode.stream - middle) > reach)
        if len(wild):
            step, column = wild[0]
            label, value = episode.spec.labels[column], episode.stream[step, column]
            raise ValueError(
                f"episode {n}, step {step}, {label} is {value:g}, where 98 % of all lie between {low[column]:g} and "
                f"{high[column]:g}: leave the episode out"
            )


def marks(episode: Episode) -> Marks:
    """Return the mark of each stretch of an episode, in order."""
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
    """Return the marks to keep of episodes that are learned from."""
    kept: Marks = np.unique(np.concatenate([np.zeros(0), *(np.sort(marks(e))[:KEPT] for e in episodes)]))
    return kept


def overlaps(episode: Episode, *learned: Marks | None) -> bool:
    """Return whether a stretch of an episode was learned from, by marks that ``sketch`` kept; None knows nothing."""
    found = marks(episode)
    return any(some is not None and np.isin(found, some).any() for some in learned)


def check_fresh(episodes: Sequence[Episode], *learned: Marks | None) -> None:
    """Raise ValueError where two episodes share a stretch of rows, or one was learned from; arguments as above."""
    for n, episode in enumerate(episodes):
        if overlaps(episode, *learned):
            raise ValueError(
                f"episode {n} was learned from: such episodes surprise too little to promise by; give others"
            )
    own = [np.unique(marks(e)) for e in episodes]
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
    """Mix bits by the last step of SplitMix64 (Steele et al. 2014), modulo 2⁶⁴."""
    for shift, factor in ((30, 0xBF58476D1CE4E5B9), (27, 0x94D049BB133111EB)):
        x = (x ^ (x >> np.uint64(shift))) * np.uint64(factor)
    mixed: _Hash = x ^ (x >> np.uint64(31))
    return mixed
