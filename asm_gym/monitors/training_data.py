"""Episodes to learn from and to calibrate on: valid, and fresh where a promise is made of them.

A monitor keeps a hash of the rows of each episode that it learned from.
"""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from asm_gym.data.action_identification import found_meaning
from asm_gym.data.action_meaning import ACTIONS
from asm_gym.data.episode import CONTROLLER, Episode
from asm_gym.data.schema import LOG_SCHEMA
from asm_gym.spec import StreamSpec

WILD = 1e6  # largest distance of a number from its channel's median, in ranges of the channel

ALIKE = 1.0 - 1e-9  # correlation of copies
MOST_NAMED = 6  # names that a message lists

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
    if max(float(np.abs(episode.stream).max()) for episode in episodes) > WILD / 2:
        _check_proportions(episodes, spec)


def _check_proportions(episodes: Sequence[Episode], spec: StreamSpec) -> None:
    """Raise ValueError for a number out of all proportion.

    Beside it, its channel would look constant.
    """
    rows = np.concatenate([episode.stream for episode in episodes]).astype(np.float64)
    low, middle, high = np.quantile(rows, (0.01, 0.5, 0.99), axis=0)
    reach = WILD * np.maximum(np.maximum(high - low, np.abs(middle)), 1.0)
    for n, episode in enumerate(episodes):
        for step, column in np.argwhere(np.abs(episode.stream - middle) > reach):
            value = episode.stream[step, column]
            raise ValueError(
                f"episode {n}, step {step}, {spec.labels[column]} is {value:g}, where 98 % of all "
                f"lie between {low[column]:g} and {high[column]:g}: leave the episode out"
            )


def with_held_out(
    episodes: Sequence[Episode], one_in: int, rng: np.random.Generator
) -> tuple[list[Episode], list[Episode]]:
    """Return the episodes to learn and those held out: ``one_in`` so many, in random order; none for 0."""
    if not one_in:
        return list(episodes), []
    shuffled = [episodes[n] for n in rng.permutation(len(episodes))]
    count = len(episodes) // one_in
    return shuffled[count:], shuffled[:count]


def about_episodes(episodes: Sequence[Episode], with_actions: bool) -> dict[str, Any]:
    """Return the facts to save with a monitor: controller and schema that all share, and what actions mean."""
    about: dict[str, Any] = {}
    for key in (CONTROLLER, LOG_SCHEMA):
        first = episodes[0].info.get(key)
        if first and all(episode.info.get(key) == first for episode in episodes):
            about[key] = first
    if with_actions and len(episodes[0].spec.motor):
        about[ACTIONS] = found_meaning(episodes).to_json()
    return about


def mute_channels(episodes: Sequence[Episode]) -> list[str]:
    """Say, a line each, which numbers of the stream never move, and which are copies of others."""
    rows = np.concatenate([e.stream for e in episodes]).astype(np.float64)
    labels = np.array(episodes[0].spec.labels)
    moves = np.ptp(rows, axis=0) > 0
    still = "never moves in these episodes: its motion will be an alarm"
    notes = [f"{label} {still}" for label in labels[~moves]]
    moving = labels[moves]
    correlation = np.corrcoef(rows[:, moves], rowvar=False).reshape(len(moving), -1)
    for column, own in enumerate(np.abs(correlation) > ALIKE):
        first = np.argmax(own)
        if first < column:
            notes.append(f"{moving[column]} is a copy of {moving[first]}, and cannot check it")
    return notes


def hashes_of(episodes: Sequence[Episode]) -> Hashes:
    """Return the hash (N,) of the rows of each episode."""
    rows = (np.ascontiguousarray(e.stream, np.float32).tobytes() for e in episodes)
    digests = (hashlib.blake2b(data, digest_size=8).digest() for data in rows)
    return np.array([float(int.from_bytes(digest, "little") >> 12) for digest in digests])


def check_fresh(episodes: Sequence[Episode], *learned: Hashes | None) -> None:
    """Check that calibration episodes were not learned from, and that each is given once.

    Args:
        episodes: to calibrate on.
        *learned: hashes of episodes that were learned from, each perhaps None.

    Raises:
        ValueError: some were, or are copies of others; the message gives their numbers.
    """
    hashes = hashes_of(episodes)
    for known in learned:
        if known is None:
            continue
        stale = np.flatnonzero(np.isin(hashes, known))
        if len(stale):
            raise ValueError(
                "calibrate() needs episodes that were not learned from, as the surprise of others "
                f"is too low to set a threshold: leave out episodes {shortened(stale)}, "
                "or replace them"
            )
    _, first, group = np.unique(hashes, return_index=True, return_inverse=True)
    original = first[group]  # (N,) number of the first episode with the same rows
    copies = np.flatnonzero(original != np.arange(len(hashes)))
    if len(copies):
        raise ValueError(
            f"calibrate() needs each episode once: leave out episodes {shortened(copies)}, "
            f"whose rows are those of episodes {shortened(original[copies])}"
        )


def shortened(names: Sequence[object] | NDArray[np.intp]) -> str:
    """Return the first names, and how many more there are."""
    text = ", ".join(map(str, names[:MOST_NAMED]))
    if len(names) > MOST_NAMED:
        text += f" and {len(names) - MOST_NAMED} more"
    return text
