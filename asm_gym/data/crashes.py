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
    if not np.isfinite(force).any():
        return float("nan")
    return float(np.nanmax(force))


def peak_torques(episode: Episode) -> NDArray[np.float64]:
    """Return (T,) the largest external torque on a joint in each row [N m]; 0 where none is sensed.

    The largest torque within a row is taken where the robot senses it.
    """
    for ending in ("external_torque_peak", "external_torque"):
        channels = [s for name, s in episode.spec.slices.items() if name.endswith(ending)]
        if channels:
            torques = np.hstack([episode.stream[:, s] for s in channels])
            largest = np.abs(torques).max(axis=1)
            return largest.astype(np.float64)
    return np.zeros(len(episode))


def crashes(
    episodes: Sequence[Episode],
    tasks: Sequence[str],
    reference: Sequence[bool] = (),
) -> dict[int, float]:
    """Return the crashes, as how many times as hard as is usual they press, by the number of the episode.

    Args:
        episodes: of any tasks.
        tasks: the task of each episode.
        reference: whether an episode tells what is usual in its task; by default, and where none of a task does, all.
    """
    import pandas as pd

    peaks = pd.Series([peak_force(e) for e in episodes], dtype=np.float64)
    by_task = np.asarray(tasks)
    usual = peaks.groupby(by_task).transform("median")
    if reference:
        chosen = peaks.where(np.asarray(reference))
        usual = chosen.groupby(by_task).transform("median").fillna(usual)
    times = peaks / usual.where(usual > 0)
    return times[times > CRASH].to_dict()
