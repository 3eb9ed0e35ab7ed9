"""Which episodes can be learned from: at least one, of the right stream, long enough, with sound numbers."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from asm_gym.episode import Episode
from asm_gym.spec import StreamSpec

WILD = 1e6
"""How many times the range of its channel a number may be away from the median."""


def check_nominal(episodes: Sequence[Episode], spec: StreamSpec, shortest: int) -> None:
    """Raises ValueError for episodes that a monitor of this stream cannot learn from."""
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
    refuse_wild(episodes)


def refuse_wild(episodes: Sequence[Episode]) -> None:
    """Raises ValueError for a number out of all proportion, which would hide whatever its channel does otherwise."""
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
