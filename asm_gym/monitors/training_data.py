"""Episodes to learn from and to calibrate on: valid, and fresh where a promise is made of them.

A monitor keeps a hash of the rows of each episode that it learned from.
"""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from asm_gym.data.action_identification import identify_meaning
from asm_gym.data.action_meaning import ACTIONS
from asm_gym.data.episode import CONTROLLER, Episode
from asm_gym.data.schema import LOG_SCHEMA
from asm_gym.spec import StreamSpec

WILD = 1e6  # largest distance of a number from its channel's median, in ranges of the channel

COPY_CORRELATION = 1.0 - 1e-9  # least correlation of a channel and its copy
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
        bad = np.argwhere(~np.isfinite(episode.stream))
        if len(bad):
            step, column = bad[0]
            raise ValueError(
                f"episode {n}, step {step}, {spec.labels[column]} must be finite, "
                f"got {episode.stream[step, column]}"
            )
    largest = max(float(np.abs(episode.stream).max()) for episode in episodes)
    if largest > WILD / 2:
        _check_outliers(episodes, spec)


def _check_outliers(episodes: Sequence[Episode], spec: StreamSpec) -> None:
    """Raise ValueError for a number so far off that its channel would look constant beside it."""
    rows = np.concatenate([episode.stream for episode in episodes]).astype(np.float64)
    low, median, high = np.quantile(rows, (0.01, 0.5, 0.99), axis=0)
    size = np.maximum(high - low, np.abs(median))
    farthest = WILD * np.maximum(size, 1.0)
    for n, episode in enumerate(episodes):
        far = np.argwhere(np.abs(episode.stream - median) > farthest)
        if len(far):
            step, column = far[0]
            raise ValueError(
                f"episode {n}, step {step}, {spec.labels[column]} is "
                f"{episode.stream[step, column]:g}, where 98 % of all lie between "
                f"{low[column]:g} and {high[column]:g}: leave the episode out"
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
    first = episodes[0]
    for key in (CONTROLLER, LOG_SCHEMA):
        value = first.info.get(key)
        if value and all(episode.info.get(key) == value for episode in episodes):
            about[key] = value
    if with_actions and len(first.spec.motor):
        about[ACTIONS] = identify_meaning(episodes).to_json()
    return about


def mute_channels(episodes: Sequence[Episode]) -> list[str]:
    """Say, a line each, which numbers of the stream never move, and which are copies of others."""
    rows = np.concatenate([episode.stream for episode in episodes]).astype(np.float64)
    labels = np.array(episodes[0].spec.labels)
    moves = np.ptp(rows, axis=0) > 0
    still = "never moves in these episodes: its motion will be an alarm"
    notes = [f"{label} {still}" for label in labels[~moves]]
    if not moves.any():
        return notes

    moving = labels[moves]
    correlation = np.corrcoef(rows[:, moves], rowvar=False)
    is_copy = np.atleast_2d(np.abs(correlation) > COPY_CORRELATION)
    for label, original in zip(moving, moving[is_copy.argmax(axis=1)], strict=True):
        if label != original:
            notes.append(f"{label} is a copy of {original}, and cannot check it")
    return notes


def hashes_of(episodes: Sequence[Episode]) -> Hashes:
    """Return the hash (N,) of the rows of each episode."""
    hashes = []
    for episode in episodes:
        rows = np.ascontiguousarray(episode.stream, np.float32)
        digest = hashlib.blake2b(rows.tobytes(), digest_size=8).digest()
        hashes.append(int.from_bytes(digest, "little") >> 12)
    return np.array(hashes, np.float64)


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
    original = first[group]  # (N,) index of the first episode with the same rows
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
