"""Seeds of episodes, and when in an episode a fault begins: all that is random about a run follows from one number."""

from __future__ import annotations

import zlib

import numpy as np


def episode_seeds(seed: int, episodes: int, stage: int = 0) -> list[int]:
    """One seed an episode; lists of different ``stage`` have nothing in common."""
    return _drawn([seed, stage], episodes)


def role_seeds(seed: int, task: str, role: str, episodes: int) -> list[int]:
    """One seed an episode; those of different tasks and roles have nothing in common."""
    return _drawn([seed, zlib.crc32(f"{task}/{role}".encode())], episodes)


def draw_onset(seed: int, horizon: int) -> int:
    """When a fault begins in the episode of ``seed``: after its first 10 steps, in its first half."""
    return int(np.random.default_rng([seed, 1]).integers(10, max(11, horizon // 2)))


def _drawn(entropy: list[int], count: int) -> list[int]:
    return [int(s) for s in np.random.SeedSequence(entropy).generate_state(count, np.uint32) // 2]
