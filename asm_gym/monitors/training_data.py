"""Episodes to learn from and to calibrate on: valid, and fresh where a promise is made of them.

A monitor keeps a hash of the rows of each episode that it learned from.
"""

from __future__ import annotations

import hashlib
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from asm_gym.data.episode import Episode
from asm_gym.spec import StreamSpec

WILD = 1e6  # largest distance of a number from its channel's median, in ranges of the channel

ALIKE = 1.0 - 1e-9  # correlation of copies

Hashes = NDArray[np.float64]  # one of each episode, of 52 bits, which a double holds exactly


def check_nominal(episodes: Sequence[Episode], spec: StreamSpec, shortest: int) -> None:
    """Raise ValueError for episodes that a monitor of this stream cannot learn from."""
    if isinstance(episodes, Episode):
        raise TypeError("episodes must be a list of them, got a single Episode")
    if len(episodes) == 0:
        raise ValueError("at least one episode is needed, got none")
    for n, episode in enumerate(episodes):
        spec.require(episode.spec, f"episode {n}")
        if len(episode) < shortest:
            raise ValueError(
                f"episode {n} must be at least {shortest} steps long, got {len(episode)}"
            )
        for step, column in np.argwhere(~np.isfinite(episode.stream)):
            value = episode.stream[step, column]
            raise ValueError(
                f"episode {n}, step {step}, {spec.labels[column]} must be finite, got {value}"
            )
    # Beside a number out of all proportion its channel would look constant.
    if max(float(np.abs(e.stream).max()) for e in episodes) <= WILD / 2:
        return
    rows = np.concatenate([e.stream for e in episodes]).astype(np.float64)
    low, middle, high = np.quantile(rows, (0.01, 0.5, 0.99), axis=0)
    reach = WILD * np.maximum(np.maximum(high - low, np.abs(middle)), 1.0)
    for n, episode in enumerate(episodes):
        for step, column in np.argwhere(np.abs(episode.stream - middle) > reach):
            value = episode.stream[step, column]
            raise ValueError(
                f"episode {n}, step {step}, {spec.labels[column]} is {value:g}, where 98 % of all lie between "
                f"{low[column]:g} and {high[column]:g}: leave the episode out"
            )


def mute_channels(episodes: Sequence[Episode]) -> list[str]:
    """Say, a line each, which numbers of the stream never move, and which are copies of others."""
    rows, labels = (
        np.concatenate([e.stream for e in episodes]).astype(np.float64),
        episodes[0].spec.labels,
    )
    moves = np.ptp(rows, axis=0) > 0
    lines = [
        f"{labels[i]} never moves in these episodes: its motion will be an alarm"
        for i in np.flatnonzero(~moves)
    ]
    moving = np.flatnonzero(moves)
    alike = np.abs(np.corrcoef(rows[:, moving], rowvar=False).reshape(len(moving), -1)) > ALIKE
    pairs = ((i, np.argmax(own)) for i, own in enumerate(alike) if np.argmax(own) < i)
    return lines + [
        f"{labels[moving[i]]} is a copy of {labels[moving[j]]}, and cannot check it"
        for i, j in pairs
    ]


def hashes_of(episodes: Sequence[Episode]) -> Hashes:
    """Return the hash (N,) of the rows of each episode."""
    rows = (np.ascontiguousarray(e.stream, np.float32).tobytes() for e in episodes)
    digests = (hashlib.blake2b(data, digest_size=8).digest() for data in rows)
    return np.array([float(int.from_bytes(digest, "little") >> 12) for digest in digests])


def check_fresh(episodes: Sequence[Episode], *learned: Hashes | None) -> None:
    """Raise ValueError for an episode that is given twice or whose hash is among those ``learned`` from."""
    known = [hashes for hashes in learned if hashes is not None]
    first: dict[float, int] = {}
    for n, own in enumerate(hashes_of(episodes)):
        if any(own in hashes for hashes in known):
            raise ValueError(
                f"episode {n} was learned from, so its surprise is too low to set a threshold: give other episodes"
            )
        if own in first:
            raise ValueError(f"episodes {first[own]} and {n} are the same: give each once")
        first[own] = n
