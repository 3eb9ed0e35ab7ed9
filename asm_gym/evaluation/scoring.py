"""How well one monitor told faults from nominal episodes, at any threshold: pure functions of recorded verdicts.

Scores are compared over the same steps: the greatest surprise in ``[onset, onset + window)`` of a faulty episode stands
against that of nominal episodes of the same task in the same steps, because surprise depends on the phase of the task.
A fault's *placement* is the share of nominal episodes that were at least as surprising there (Janes and Pepe 2009); it
is uniform on [0, 1] for nominal episodes, so that placements of all tasks and onsets can be pooled.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from asm_gym.evaluation.metrics import Delays
from asm_gym.evaluation.statistics import Share, auroc
from asm_gym.evaluation.trace import spans, window_steps

Floats = NDArray[np.floating[Any]]


@dataclass(frozen=True, eq=False)
class Verdict:
    """What one monitor said of one recorded episode.

    Args:
        task, monitor: which, by name.
        kind: of the fault, ``"nominal"``, or the name of a harmless variation.
        severity: ``"mild"``, ``"medium"``, ``"strong"``, or empty.
        seed: of the episode; twins share it.
        dt: control period [s].
        surprise: (T,) never NaN.
        onset: the first step with a fault; None without one.
        blamed: the channel with the greatest share at the first alarm since the onset; empty without an alarm.
        guilty: channels in which an attentive observer would see this fault first.
    """

    task: str
    monitor: str
    kind: str
    severity: str
    seed: int
    dt: float
    surprise: Floats
    onset: int | None = None
    blamed: str = ""
    guilty: frozenset[str] = frozenset()

    def __len__(self) -> int:
        return len(self.surprise)

    def window(self, window_s: float) -> slice:
        """The steps in which a detection counts."""
        start = self.onset or 0
        stop = len(self) if self.onset is None else min(start + window_steps(window_s, self.dt), len(self))
        return slice(start, stop)

    def detected_after(self, threshold: float) -> int | None:
        """Steps from the onset to the first alarm raised at or after it; an alarm that stood before does not count."""
        if self.onset is None:
            return None
        raised = [start for start, _ in spans(self.surprise > threshold) if start >= self.onset]
        return raised[0] - self.onset if raised else None


def placements(faulty: Sequence[Verdict], nominal: Sequence[Verdict], window_s: float) -> NDArray[np.float64]:
    """(F,) for each fault, the share of nominal episodes of its task at least as surprising in the same steps.

    Ties count half. Faults that no nominal episode of their task reaches in time are left out.
    """
    by_task: dict[str, list[Verdict]] = {}
    for v in nominal:
        by_task.setdefault(v.task, []).append(v)
    values = []
    for verdict in faulty:
        steps = verdict.window(window_s)
        others = [v.surprise[steps].max() for v in by_task.get(verdict.task, []) if len(v) > steps.start]
        if others and steps.stop > steps.start:
            values.append(1.0 - auroc([verdict.surprise[steps].max()], others))
    return np.array(values)


def average_precision(placements: Floats) -> float:
    """Area under the precision-recall curve, where as many episodes are faulty as nominal.

    At the k-th smallest placement u the recall is k/F and the false-alarm rate u: precision (k/F) / (k/F + u).
    """
    u = np.sort(np.asarray(placements, np.float64))
    recall = (np.arange(len(u)) + 1) / len(u)
    return float((recall / (recall + u)).mean()) if len(u) else math.nan


def detections(faulty: Sequence[Verdict], threshold: float, window_s: float) -> Share:
    """Faults with an alarm raised within the window."""
    found = []
    for v in faulty:
        after = v.detected_after(threshold)
        found.append(after is not None and after < window_steps(window_s, v.dt))
    return Share.of(found)


def delays(faulty: Sequence[Verdict], threshold: float, window_s: float) -> Delays | None:
    """Median and 95th percentile of the time to the alarm within the window; a miss counts as infinitely late."""
    times = []
    for v in faulty:
        after = v.detected_after(threshold)
        late = after is None or after >= window_steps(window_s, v.dt)
        times.append(math.inf if after is None or late else 1e3 * (after + 1) * v.dt)
    if not times:
        return None
    times.sort()
    median, p95 = (times[math.ceil(q * len(times)) - 1] for q in (0.5, 0.95))
    detected = sum(map(math.isfinite, times))
    return Delays(median, p95, detected, len(times) - detected)


def coverage(nominal: Sequence[Verdict], threshold: float) -> Share:
    """Nominal episodes with any alarm: what a calibrated threshold keeps at its rate."""
    return Share.of([bool((v.surprise > threshold).any()) for v in nominal])


def false_alarms_per_hour(nominal: Sequence[Verdict], threshold: float) -> float:
    """Alarms raised in nominal episodes per robot-hour; NaN without episodes."""
    hours = sum(len(v) * v.dt for v in nominal) / 3600
    return sum(len(spans(v.surprise > threshold)) for v in nominal) / hours if hours else math.nan


def balanced_accuracy(
    faulty: Sequence[Verdict], nominal: Sequence[Verdict], threshold: float, window_s: float
) -> float:
    """Mean of the share of faults detected and the share of nominal episodes without an alarm."""
    return 0.5 * (detections(faulty, threshold, window_s).value + 1.0 - coverage(nominal, threshold).value)


def timestep_weighted_accuracy(faulty: Sequence[Verdict], nominal: Sequence[Verdict], threshold: float) -> float:
    """Balanced accuracy in which a detection counts the less the later it comes (FIPER; Römer et al. 2025).

    ½ (share of nominal episodes without an alarm + mean over faults of 1 - t/T), where t of the T steps left at the
    onset had passed at the alarm; an undetected fault counts 0.
    """
    early = []
    for v in faulty:
        after = v.detected_after(threshold)
        early.append(0.0 if after is None else 1.0 - after / (len(v) - (v.onset or 0)))
    return 0.5 * (float(np.mean(early)) + 1.0 - coverage(nominal, threshold).value) if early else math.nan


def attribution_accuracy(faulty: Sequence[Verdict]) -> Share:
    """Of the faults that raised an alarm, those whose most surprising channel belonged to the fault."""
    return Share.of([v.blamed in v.guilty for v in faulty if v.blamed and v.guilty])
