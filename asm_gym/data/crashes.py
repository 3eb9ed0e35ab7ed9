"""Crashes in healthy episodes: those that press twice as hard as the policy does at its hardest in most episodes.

healthy    the task was solved, and the greatest force is at most CRASH times that of the task's median episode
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from asm_gym.data.episode import Episode

CRASH = 2.0  # A crash presses this many times as hard as is usual


def peak_force(episode: Episode) -> float:
    """Return the greatest contact force [N]; NaN where none was measured."""
    force = episode.contact_force
    return float(np.nanmax(force)) if np.isfinite(force).any() else float("nan")


def peak_torques(episode: Episode) -> NDArray[np.float64]:
    """Return (T,) the largest external torque on a joint in each row [N m], within it where sensed; 0 without any."""
    slices = episode.spec.slices
    sensed = [
        [s for name, s in slices.items() if name.endswith(f"external_torque{end}")]
        for end in ("_peak", "")
    ]
    torques = [np.abs(episode.stream[:, s]).max(axis=1) for s in sensed[0] or sensed[1]]
    return np.max([np.zeros(len(episode)), *torques], axis=0)


def crashes(
    episodes: Sequence[Episode], tasks: Sequence[str], reference: Sequence[bool] = ()
) -> dict[int, float]:
    """Return the numbers of the episodes that crash, and how many times as hard as is usual in their tasks they press.

    ``reference`` says which episodes tell what is usual: by default, and where none does, all.
    """
    of, times = np.asarray(tasks), np.zeros(len(episodes))
    tells = np.array(reference or [True] * len(episodes), bool)
    peak = np.array([peak_force(e) for e in episodes])
    for task in dict.fromkeys(tasks):
        own = (of == task) & np.isfinite(peak)
        known = own & tells if (own & tells).any() else own
        if own.any() and (usual := np.median(peak[known])) > 0:
            times[own] = peak[own] / usual
    return {int(n): float(times[n]) for n in np.flatnonzero(times > CRASH)}
