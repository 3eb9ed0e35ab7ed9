"""Ceilings: how far each sense goes at its worst in healthy hours, so that rare alarms are as rare in each."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

from asm_gym.detection import EvidenceDetection
from asm_gym.detection.events import Excuses
from asm_gym.detection.evidence import FEWEST_EPISODES
from asm_gym.episode import Episode
from asm_gym.monitors.calibrated_monitor import CalibratedMonitor
from asm_gym.monitors.stream_model import model_outputs
from asm_gym.monitors.training_data import check_fresh, check_nominal, hashes_of
from asm_gym.validation import typed

AT_ONCE = 400
"""Episodes: arrays of all rows of many hours would fill the memory."""


@typed
def learn_ceilings(monitor: CalibratedMonitor, episodes: Sequence[Episode]) -> CalibratedMonitor:
    """Learn from healthy hours how far each sense goes at its worst, and return the monitor.

    The episodes it was fitted to, babbling say, are not like hours of operation. It has no threshold then: calibrate it
    on other hours of the same policies and tasks.

    Args:
        monitor: fitted, under the detection of evidence; it is changed.
        episodes: healthy ones that ``fit`` has not seen, 100 at least, and one hit or so in each 50 at most.

    Raises:
        ValueError: too few, or bad ones; one given twice, or that ``fit`` has learned from.
        TypeError: its detection is not that of evidence.
    """
    monitor._require_fitted()
    if not isinstance(monitor.detection, EvidenceDetection):
        raise TypeError(f"the detection {monitor.detection.name} has no ceilings: learn those of evidence")
    check_nominal(episodes, monitor.spec, monitor.model.shortest)
    if len(episodes) < FEWEST_EPISODES:
        raise ValueError(f"ceilings take {FEWEST_EPISODES} healthy episodes or more, got {len(episodes)}")
    check_fresh(episodes, monitor.learned_from_)
    with threadpool_limits(1):
        maxima = _worst_of(monitor, monitor.detection, episodes)
    learned = monitor.detection.with_ceilings(maxima, anew=monitor.ceilings_from_ is None)
    monitor.detection = learned
    monitor.detections = {**monitor.detections, learned.name: learned}
    monitor.ceilings_from_ = hashes_of(episodes)
    monitor._uncalibrate()
    return monitor


def _worst_of(
    monitor: CalibratedMonitor, detection: EvidenceDetection, episodes: Sequence[Episode]
) -> NDArray[np.float64]:
    """Return the largest v (N, G, X) in each of N episodes.

    Surprise is v to a power of a half or less, so that v is divided by the square of what divides surprise.
    """
    detector, excuses = detection.detector_, getattr(monitor, "excuses_", None)
    assert detector is not None
    found = []
    for first in range(0, len(episodes), AT_ONCE):
        some = episodes[first : first + AT_ONCE]
        for episode, output in zip(some, model_outputs(monitor.model, some), strict=True):
            strengths, _ = detector.strengths(output)
            if isinstance(excuses, Excuses):
                strengths /= excuses.divisors(episode.stream)[:, None, None] ** 2
            found.append(strengths.max(axis=0))
    return np.array(found)
