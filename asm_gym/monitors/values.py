"""Values beside changes: a push that is held is explained by its own past to who judges changes, and not by the rest.

    s = max(s_changes, s_values)        each is 1 at what it seldom exceeds in nominal episodes

Errors of values are not whitened: how those of a few minutes belong together is not known.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from asm_gym.detection import EvidenceDetection
from asm_gym.episode import Episode
from asm_gym.monitors.base import Surprise
from asm_gym.monitors.baselines.association_values import ValueAssociation
from asm_gym.monitors.monitor import CalibratedMonitor
from asm_gym.spec import StreamSpec

PREFIX = "values."
"""What the names of its arrays begin with in a checkpoint."""


def values_monitor(spec: StreamSpec, seed: int) -> CalibratedMonitor:
    """Not yet fitted."""
    detection = EvidenceDetection(spec, shrinkage=1.0, habituates=False)
    return CalibratedMonitor(ValueAssociation(spec, changes=False), detection, seed=seed)


def learned_values(episodes: Sequence[Episode], seed: int) -> CalibratedMonitor | None:
    """Fitted to nominal episodes; None where nothing tells any value."""
    monitor = values_monitor(episodes[0].spec, seed).fit(episodes)
    return monitor if len(monitor.learned_["judged_values"]) else None


def greater(changes: Surprise, values: Surprise) -> Surprise:
    """The greater of the two in each row, attributed as that one is."""
    held = values.value > changes.value
    shares = np.where(held[:, None], values.attribution, changes.attribution)
    return changes._replace(value=np.where(held, values.value, changes.value), attribution=shares)
