"""Seeds of episodes, and onsets of faults: all that is random about a run follows from one number."""

from __future__ import annotations

import zlib

import numpy as np

from asm_gym.validation import check_number

MOST_EPISODES = 10**6


def episode_seeds(seed: int, episodes: int, stage: int = 0) -> list[int]:
    """Return one seed per episode; lists of different ``stage`` have nothing in common."""
    check_number("stage", stage, low=0, whole=True)
    return _draw(seed, stage, episodes)


def role_seeds(seed: int, task: str, role: str, episodes: int) -> list[int]:
    """Return one seed per episode; those of different tasks and roles have nothing in common."""
    name = f"{task}/{role}"
    return _draw(seed, zlib.crc32(name.encode()), episodes)


def draw_onset(seed: int, horizon: int) -> int:
    """Return when a fault begins in the episode of ``seed`` [steps]: after step 10, in the first half."""
    check_number("horizon", horizon, low=0, high=1e9, whole=True)
    check_number("seed", seed, low=0, whole=True)
    rng = np.random.default_rng([seed, 1])
    latest = max(11, int(horizon) // 2)
    return int(rng.integers(10, latest))


def _draw(seed: int, key: int, episodes: int) -> list[int]:
    """Return one seed per episode; those of different ``key`` have nothing in common."""
    check_number("episodes", episodes, low=0, high=MOST_EPISODES, whole=True)
    check_number("seed", seed, low=0, whole=True)
    sequence = np.random.SeedSequence([seed, key])
    drawn = sequence.generate_state(episodes, np.uint32)
    return (drawn // 2).tolist()
