"""How well faults were told from nominal episodes: pure functions of recorded traces.

Detection is measured where the monitor only watches (``acting == "policy alone"``), so that the override cannot
change what it is judged on; what the override changes is measured on the other traces.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from asm_gym.evaluation.statistics import Share, auroc
from asm_gym.evaluation.trace import NOMINAL, POLICY_ALONE, Trace, window_steps


def placements(faulty: Sequence[Trace], nominal: Sequence[Trace], window_s: float) -> NDArray[np.float64]:
    """For each fault, the share of nominal episodes that were at least as surprising over the same steps.

    The score is the greatest surprise in ``[onset, onset + window)``; a faulty episode is compared with the nominal
    ones over its own steps, because surprise depends on the phase of the task: the covariate-adjusted ROC curve of
    Janes & Pepe 2009, of which these are the placement values. Ties count half.

    Returns:
        (F,) for the F traces with a fault and at least one nominal episode that lasted until its onset.
    """
    values = []
    for trace in faulty:
        if trace.onset is None:
            continue
        end = min(trace.onset + window_steps(window_s, trace.dt), len(trace))
        negatives = [n.surprise[trace.onset : end].max() for n in nominal if len(n) > trace.onset]
        if negatives:
            values.append(1.0 - auroc([trace.surprise[trace.onset : end].max()], negatives))
    return np.array(values)


def time_matched_auroc(faulty: Sequence[Trace], nominal: Sequence[Trace], window_s: float) -> float | None:
    """AUROC of the greatest surprise within the window, each fault against the same steps of nominal episodes.

    Equal to :func:`auroc` where all onsets are; None where nothing can be compared.
    """
    values = placements(faulty, nominal, window_s)
    return float(1.0 - values.mean()) if values.size else None


class Delays(NamedTuple):
    """How long detection took; a miss counts as infinitely late.

    Attributes:
        median_ms: half of all faults were detected within this; ``inf`` where fewer were.
        p95_ms: the same for 95 % of all faults.
        detected: faults detected within the window.
        missed: faults that were not.
    """

    median_ms: float
    p95_ms: float
    detected: int
    missed: int


def delays_ms(traces: Sequence[Trace], window_s: float) -> NDArray[np.float64]:
    """(F,) sorted times from the fault to its alarm [ms], ``inf`` where that took longer than the window.

    Only the traces with a fault. The time runs from the beginning of the control step the fault began in to the end
    of the one that raised the alarm, so the shortest is one control period.
    """
    found = [(t.detected_after, window_steps(window_s, t.dt), t.delay) for t in traces if t.onset is not None]
    return np.sort([math.inf if k is None or d is None or k >= window else 1e3 * d for k, window, d in found])


def delay_summary(traces: Sequence[Trace], window_s: float) -> Delays | None:
    """Median and 95th percentile of the delay within the window; None where no trace holds a fault."""
    delays = delays_ms(traces, window_s)
    if not delays.size:
        return None
    # Observed values, not interpolated ones: between a number and a miss there is nothing.
    median, p95 = (float(delays[math.ceil(q * delays.size) - 1]) for q in (0.5, 0.95))
    detected = int(np.isfinite(delays).sum())
    return Delays(median, p95, detected, delays.size - detected)


def false_alarms_per_hour(traces: Sequence[Trace]) -> float:
    """Alarms raised before any fault, per hour of operation before any fault [1/h]; NaN where there was none."""
    hours = sum((len(t) if t.onset is None else t.onset) * t.dt for t in traces) / 3600
    return sum(len(t.false_alarms) for t in traces) / hours if hours else math.nan


@dataclass(frozen=True)
class Outcome:
    """How episodes of one condition ended, with one kind of acting.

    Args:
        acting: ``"policy alone"``, or what the alarm did.
        success: episodes that solved the task.
        ended_by_alarm: episodes that the alarm ended.
        peak_force: median over episodes of the greatest contact force [N]; NaN where it was not measured.
    """

    acting: str
    success: Share
    ended_by_alarm: Share
    peak_force: float


@dataclass(frozen=True)
class Row:
    """What one condition showed.

    Args:
        condition: ``"nominal"``, or the name of the fault.
        episodes: watched with the policy alone, as everything down to ``top_labels``.
        false_alarm_episodes: those with an alarm before the fault; with any alarm, where there is none.
        false_alarms_per_hour: [1/h] of operation before any fault.
        detected: faults with an alarm raised within the window; of 0 where there was no fault.
        delays: None where there was no fault.
        auroc: time-matched, against the nominal traces; None where there is nothing to compare.
        top_labels: the channel with the greatest share of surprise when the first alarm was raised (in a faulty
            episode, the first since the onset), with the number of episodes; the three most frequent.
        outcomes: one for each kind of acting, the policy alone first.
    """

    condition: str
    episodes: int
    false_alarm_episodes: Share
    false_alarms_per_hour: float
    detected: Share
    delays: Delays | None
    auroc: float | None
    top_labels: tuple[tuple[str, int], ...]
    outcomes: tuple[Outcome, ...]

    def outcome(self, acting: str) -> Outcome | None:
        """The outcome with this kind of acting; None where it was not tried."""
        return next((o for o in self.outcomes if o.acting == acting), None)


def summarise(traces: Sequence[Trace], window_s: float) -> list[Row]:
    """One row a condition, the nominal one first, then in order of appearance.

    Args:
        traces: any mixture of conditions and kinds of acting.
        window_s: how soon an alarm must come to count as detection [s].
    """
    conditions = sorted(dict.fromkeys(t.condition for t in traces), key=lambda c: c != NOMINAL)
    nominal = [t for t in traces if t.condition == NOMINAL and t.watched_only]
    return [_row(c, [t for t in traces if t.condition == c], nominal, window_s) for c in conditions]


def _row(condition: str, traces: Sequence[Trace], nominal: Sequence[Trace], window_s: float) -> Row:
    watched = [t for t in traces if t.watched_only]
    delays = delay_summary(watched, window_s)
    actings = sorted(dict.fromkeys(t.acting for t in traces), key=lambda a: a != POLICY_ALONE)
    return Row(
        condition=condition,
        episodes=len(watched),
        false_alarm_episodes=Share.of([bool(t.false_alarms) for t in watched]),
        false_alarms_per_hour=false_alarms_per_hour(watched),
        detected=Share(delays.detected, delays.detected + delays.missed) if delays else Share(0, 0),
        delays=delays,
        auroc=time_matched_auroc(watched, nominal, window_s),
        top_labels=tuple(Counter(t.top_channel for t in watched if t.top_channel).most_common(3)),
        outcomes=tuple(_outcome(a, [t for t in traces if t.acting == a]) for a in actings),
    )


def _outcome(acting: str, traces: Sequence[Trace]) -> Outcome:
    peaks = [t.outcome.contact_force for t in traces]
    return Outcome(
        acting=acting,
        success=Share.of([t.outcome.success for t in traces]),
        ended_by_alarm=Share.of([t.outcome.ended_by_alarm for t in traces]),
        peak_force=float(np.median(peaks)),
    )
