"""What one training run cost in violations, and came to: counted as it goes, kept as one record."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

COUNTED = ("over", "contacts", "limited", "touched", "alarms", "acted", "noticed")
"""Names of what ``TrainingOutcome`` counts."""


@dataclass(frozen=True)
class TrainingOutcome:
    """One training run; counts are of its control steps, one number for each ``span`` of them.

    Args:
        condition, seed: which; runs that differ in the condition alone share the seed.
        steps: how many.
        span: steps that are counted together; the last ones may be fewer.
        over: steps with an external force on an arm above the limit.
        contacts: such steps after one without.
        limited: steps in which a joint's motor stood at its torque limit throughout.
        touched: steps in which one reached it in some physics substep.
        alarms: steps in alarm.
        acted: steps in which the reflex acted.
        noticed: contacts with an alarm in their first step.
        curve: (steps, share of successes) of evaluations without the wrapper.
        success: of the last agent without the wrapper.
        episodes: that ``success`` is a share of.
    """

    condition: str
    seed: int
    steps: int
    span: int
    over: tuple[int, ...]
    contacts: tuple[int, ...]
    limited: tuple[int, ...]
    touched: tuple[int, ...]
    alarms: tuple[int, ...]
    acted: tuple[int, ...]
    noticed: tuple[int, ...]
    curve: tuple[tuple[int, float], ...]
    success: float
    episodes: int

    def each_10k(self, name: str) -> float:
        """How many of 10,000 steps."""
        return 1e4 * float(sum(getattr(self, name))) / self.steps


def count(
    force: NDArray[np.floating[Any]], limit: float, flags: Mapping[str, NDArray[np.bool_]], span: int
) -> dict[str, tuple[int, ...]]:
    """What ``TrainingOutcome`` counts of one run's steps.

    Args:
        force: (N,) largest external force of each step [N]; what is not finite counts as above the limit.
        limit: [N].
        flags: (N,) each: ``limited``, ``touched``, ``alarms`` and ``acted``.
        span: steps that are counted together.
    """
    over = ~(force <= limit)
    begun = over & ~np.concatenate([[False], over[:-1]])
    every = {"over": over, "contacts": begun, "noticed": begun & flags["alarms"], **flags}
    starts = np.arange(0, len(force), span)
    return {name: tuple(np.add.reduceat(every[name].astype(int), starts).tolist()) for name in COUNTED}
