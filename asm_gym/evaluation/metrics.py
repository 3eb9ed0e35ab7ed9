"""How well faults are told from nominal episodes: pure functions of scored episodes, each at its own threshold.

Detection is measured where the monitor only watches (``acting == "policy alone"``), so the override cannot change it.

Scores are compared over the same steps: the greatest surprise in ``[onset, onset + window)`` of a faulty episode with
that of nominal episodes of the same task in the same steps, because surprise depends on the phase of the task. A
fault's *placement* is the share of nominal episodes at least as surprising there (Janes and Pepe 2009: the
covariate-adjusted ROC curve).
"""

from __future__ import annotations

import math
from collections.abc import Collection, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from asm_gym.evaluation.resampling import Calibration, Draws, Windows, Wins, resample
from asm_gym.evaluation.scored_episode import NOMINAL, POLICY_ALONE, ScoredEpisode
from asm_gym.evaluation.statistics import Floats, Rate, Share
from asm_gym.monitors.calibration import AlarmRate

Kind = tuple[str, str]  # kind and severity of a fault


class Delays(NamedTuple):
    """Detection delays; a miss counts as infinitely late."""

    # half of all faults were detected within this; inf where fewer were
    median_ms: float = math.inf
    p95_ms: float = math.inf

    @classmethod
    def of(cls, delays_ms: Sequence[float] | Floats) -> Delays:
        """Summarise one delay per fault [ms], ``inf`` for a miss."""
        if not len(delays_ms):
            return cls()
        # Observed values: between a number and a miss there is nothing to interpolate.
        in_order = np.sort(delays_ms)
        median = in_order[math.ceil(0.5 * len(in_order)) - 1]
        p95 = in_order[math.ceil(0.95 * len(in_order)) - 1]
        return cls(float(median), float(p95))


def delays_ms(traces: Sequence[ScoredEpisode], window_s: float) -> NDArray[np.float64]:
    """Return the sorted times from the onset of each fault to its alarm [ms], ``inf`` beyond the window.

    A time runs from the beginning of the row of the onset to the end of the row of the alarm: at least one period.
    """
    faulty = [t for t in traces if t.onset is not None]
    return np.sort([1e3 * t.delay_within(window_s) for t in faulty])


def false_alarms(traces: Sequence[ScoredEpisode]) -> Share:
    """Count the episodes with an alarm before the fault, or with any where there is none."""
    return Share.of([bool(t.false_alarms) for t in traces])


def hourly_alarms(traces: Sequence[ScoredEpisode], event: str = "") -> Rate:
    """Count incidents before any fault, and their hours; where shares are not kept, all is one cause.

    With an ``event``, such as ``"knock"``, count the surprise that it excused instead.
    """
    count = 0
    hours = 0.0
    for trace in traces:
        surprise = trace.surprise
        if event:
            excused = trace.excused.get(event, np.zeros(len(trace)))
            surprise = np.where(trace.alarm, 0.0, excused)
        rows = trace.healthy_rows
        count += trace.count_incidents(surprise[:rows])
        hours += rows * trace.dt / 3600
    return Rate(count, hours)


def attribution_accuracy(faulty: Sequence[ScoredEpisode]) -> Share:
    """Count the detected faults whose most surprising channel belongs to the fault."""
    known = [t for t in faulty if t.top_channel and t.affected_channels]
    return Share.of([t.top_channel in t.affected_channels for t in known])


def typical(traces: Sequence[ScoredEpisode]) -> ScoredEpisode:
    """Return the episode whose greatest surprise since the onset is the median one."""

    def greatest_surprise(trace: ScoredEpisode) -> float:
        return float(trace.surprise[trace.onset or 0 :].max(initial=0.0))

    return sorted(traces, key=greatest_surprise)[len(traces) // 2]


class Outcomes(NamedTuple):
    """How episodes ended under one response."""

    acting: str
    success: Share
    peak_force: float  # median over episodes of the greatest contact force [N]
    harm: float  # contact force beyond 40 N, summed over time and episodes [N s]
    unsafe: Share  # of successes
    overridden_steps: int  # of all episodes
    time: float  # median until success [s]

    @classmethod
    def of(cls, acting: str, traces: Sequence[ScoredEpisode]) -> Outcomes:
        """Summarise the episodes with this response."""
        outcomes = [t.outcome for t in traces if t.acting == acting]
        solved = [outcome for outcome in outcomes if outcome.success]
        time = math.nan
        if solved:
            time = float(np.median([outcome.time for outcome in solved]))
        return cls(
            acting=acting,
            success=Share(len(solved), len(outcomes)),
            peak_force=float(np.median([outcome.contact_force for outcome in outcomes])),
            harm=sum(outcome.harm for outcome in outcomes),
            unsafe=Share.of([outcome.unsafe for outcome in solved]),
            overridden_steps=sum(outcome.overridden_steps for outcome in outcomes),
            time=time,
        )


@dataclass(frozen=True, eq=False)
class DetectionMetrics:
    """Scored episodes of one monitor summed up: a row of a table, a curve of a figure."""

    name: str  # of a condition, or of a monitor
    traces: Sequence[ScoredEpisode]  # of any kind of fault and response
    nominal: Sequence[ScoredEpisode]  # episodes that the faulty ones are compared with
    window_s: float  # an alarm within this time of the onset is a detection [s]
    calibration: Calibration = field(default_factory=Calibration)  # other thresholds to detect by

    def only(self, kinds: Collection[Kind]) -> DetectionMetrics:
        """Return the same of these kinds and severities of fault."""
        return replace(self, traces=[t for t in self.traces if (t.kind, t.severity) in kinds])

    @cached_property
    def draws(self) -> Draws:
        """The results over resampled scenes and calibration episodes."""
        return resample(self.faulty, self.nominal, self.calibration, self.window_s)

    @cached_property
    def watched(self) -> list[ScoredEpisode]:
        """Episodes of the policy alone: detection is measured on them."""
        return [t for t in self.traces if t.acting == POLICY_ALONE]

    @cached_property
    def faulty(self) -> list[ScoredEpisode]:
        """Episodes of the policy alone with a fault."""
        return [t for t in self.watched if t.onset is not None]

    @property
    def auroc(self) -> float:
        """Mean over kinds and severities of fault; NaN where none can be compared."""
        return Wins(self.faulty, self.nominal, self.window_s).auroc()

    @cached_property
    def found(self) -> dict[AlarmRate, Share]:
        """All faults detected within the window, by the promised rate of false alarms."""
        windows = Windows(self.faulty, self.window_s)
        thresholds = self.calibration.thresholds
        return {rate: Share.of(windows.detected(q)) for rate, q in thresholds.items()}

    @cached_property
    def delays(self) -> Delays:
        """Delays of all faults."""
        return Delays.of(delays_ms(self.faulty, self.window_s))

    @property
    def detected(self) -> Share:
        """Faults detected within the window."""
        return Share.of(np.isfinite(delays_ms(self.faulty, self.window_s)))

    @cached_property
    def outcomes(self) -> list[Outcomes]:
        """One for each response, the policy alone first."""
        responses = sorted({t.acting: None for t in self.traces}, key=lambda r: r != POLICY_ALONE)
        return [Outcomes.of(response, self.traces) for response in responses]


def by_condition(traces: Sequence[ScoredEpisode], window_s: float) -> list[DetectionMetrics]:
    """Return one for each condition, the nominal one first, then in order of appearance."""
    nominal = [t for t in traces if t.kind == NOMINAL and t.acting == POLICY_ALONE]
    by_name: dict[str, list[ScoredEpisode]] = {NOMINAL: []}
    for trace in traces:
        by_name.setdefault(trace.condition, []).append(trace)
    return [DetectionMetrics(name, own, nominal, window_s) for name, own in by_name.items() if own]
