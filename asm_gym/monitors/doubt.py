"""Whether a threshold is that of healthy motion: one that a few crashes have raised hides whatever is milder."""

from __future__ import annotations

import logging
from collections.abc import Sequence

import numpy as np

from asm_gym.data.crashes import CRASH, crashes
from asm_gym.detection.base import Array
from asm_gym.episode import Episode
from asm_gym.monitors.promise import Asked

LOG = logging.getLogger("asm_gym.monitors")

RAISED = 1.5
"""How many times as high a threshold must be with the crashes as without them for anything to be said."""


def doubt_crashes(
    episodes: Sequence[Episode], values: Sequence[Array], threshold: float, asked: Asked, each: Sequence[str]
) -> None:
    """Logs a warning where crashes among nominal episodes have raised the threshold.

    Args:
        episodes: that it was set on.
        values: (T,) what was made of each.
        threshold, asked: the one that keeps what was asked.
        each: of each episode the task, where a promise is to hold in each; else its own label tells.
    """
    tasks = list(each) or [e.label.task if e.label else str(e.info.get("skill", "")) for e in episodes]
    hit = crashes(episodes, tasks)
    calm = [n for n in range(len(episodes)) if n not in hit]
    try:
        without = asked.threshold_of([values[n] for n in calm], episodes[0].spec.dt, [each[n] for n in calm if each])
    except ValueError:  # so few are no longer enough to promise by: more would not come to much more than these
        without = float(np.max([values[n].max() for n in calm]))
    if not hit or threshold <= RAISED * without:
        return
    worst = max(hit, key=lambda n: float(values[n].max()))
    LOG.warning(
        "%d of %d episodes press more than %g times as hard as is usual; with them the threshold is %.3g, without "
        "%.3g. The worst is episode %d, %.1f times as hard: look at it, and leave out what is not healthy, as "
        "asm_gym.harmless(episodes) does",
        *(len(hit), len(episodes), CRASH, threshold, without, worst, hit[worst]),
    )
