"""What of healthy episodes is a crash: what presses twice as hard as the policy does at its hardest in most of them.

    healthy    the task was solved, and the hardest moment is at most CRASH times that of the task's median episode

Forces of contact tell where an episode knows them, and external torques on joints where its stream has them.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from asm_gym.episode import Episode

CRASH = 2.0
"""How many times as hard as usual."""


def peak_torques(episode: Episode) -> NDArray[np.float64]:
    """(T,) the largest external torque on a joint in each row [N m], within it where that is sensed; 0 of none."""
    slices = episode.spec.slices
    sensed = [[s for name, s in slices.items() if name.endswith(f"external_torque{end}")] for end in ("_peak", "")]
    torques = [np.abs(episode.stream[:, s]).max(axis=1) for s in sensed[0] or sensed[1]]
    found: NDArray[np.float64] = np.max([np.zeros(len(episode)), *torques], axis=0)
    return found


def crashes(episodes: Sequence[Episode], tasks: Sequence[str]) -> dict[int, float]:
    """The numbers of those that crash, and how many times as hard as is usual they press.

    Args:
        episodes: of policies that do their tasks.
        tasks: of each, or whose policy it is.
    """
    of, times = np.asarray(tasks), np.zeros(len(episodes))
    force = np.array([np.nanmax(e.contact_force) if np.isfinite(e.contact_force).any() else np.nan for e in episodes])
    for hardest in (force, np.array([peak_torques(e).max() for e in episodes])):
        for task in dict.fromkeys(tasks):
            own = (of == task) & np.isfinite(hardest)
            if own.any() and (usual := np.median(hardest[own])) > 0:
                times[own] = np.maximum(times[own], hardest[own] / usual)
    return {int(n): float(times[n]) for n in np.flatnonzero(times > CRASH)}
