"""How well faults were told from nominal episodes: pure functions of traces, each judged by its own threshold.

Detection is measured where the monitor only watches (``acting == "policy alone"``), so that the override cannot
change what it is judged on; what the override changes is measured on the other traces.

Scores are compared over the same steps: the greatest surprise in ``[onset, onset + window)`` of a faulty episode stands
against that of nominal episodes of the same task in the same steps, because surprise depends on the phase of the task.
A fault's *placement* is the share of nominal episodes that were at least as surprising there (Janes and Pepe 2009: the
covariate-adjusted ROC curve). It is uniform on [0, 1] for nominal episodes, so that placements of all tasks and onsets
can be pooled.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from asm_gym.detection import Blocks, alarms_in
from asm_gym.evaluation.earliness import aucpdt
from asm_gym.evaluation.resampling import Calibration, Draws, drawn_anew
from asm_gym.evaluation.scored_episode import NOMINAL, POLICY_ALONE, ScoredEpisode, window_steps
from asm_gym.evaluation.statistics import Floats, Rate, Share, auroc

Kind = tuple[str, str]
"""Of a fault, and its severity."""


def in_words(kind: Kind) -> str:
    """Such as ``weak joint mild``."""
    return " ".join(part.replace("_", " ") for part in kind if part)


def placements(
    faulty: Sequence[ScoredEpisode], nominal: Sequence[ScoredEpisode], window_s: float
) -> NDArray[np.float64]:
    """(F,) for each fault, the share of nominal episodes of its task at least as surprising in the same steps.

    Ties count half. Episodes without a fault are left out, and faults that no nominal episode of their task reaches.
    """
    by_task: dict[str, list[ScoredEpisode]] = {}
    for trace in nominal:
        by_task.setdefault(trace.task, []).append(trace)
    values = []
    for trace in faulty:
        steps = trace.window(window_s)
        if trace.onset is None or steps.stop <= steps.start:
            continue
        others = [n.surprise[steps].max() for n in by_task.get(trace.task, []) if len(n) > steps.start]
        if others:
            values.append(1.0 - auroc([trace.surprise[steps].max()], others))
    return np.array(values)


def time_matched_auroc(faulty: Sequence[ScoredEpisode], nominal: Sequence[ScoredEpisode], window_s: float) -> float:
    """AUROC of the greatest surprise within the window, each fault against the same steps of nominal episodes.

    Equal to :func:`auroc` where all onsets are; NaN where nothing can be compared.
    """
    values = placements(faulty, nominal, window_s)
    return float(1.0 - values.mean()) if values.size else math.nan


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

    @classmethod
    def of(cls, delays_ms: Sequence[float] | Floats) -> Delays | None:
        """Of one delay a fault [ms], ``inf`` for a miss; None without faults."""
        late = sorted(map(float, delays_ms))
        if not late:
            return None
        # Observed values, not interpolated ones: between a number and a miss there is nothing.
        median, p95 = (late[math.ceil(q * len(late)) - 1] for q in (0.5, 0.95))
        detected = sum(map(math.isfinite, late))
        return cls(median, p95, detected, len(late) - detected)


def delays_ms(traces: Sequence[ScoredEpisode], window_s: float) -> NDArray[np.float64]:
    """(F,) sorted times from the fault to its alarm [ms], ``inf`` where that took longer than the window.

    Only the traces with a fault. The time runs from the beginning of the control step the fault began in to the end
    of the one that raised the alarm, so the shortest is one control period.
    """
    found = [(t.detected_after, window_steps(window_s, t.dt), t.delay) for t in traces if t.onset is not None]
    return np.sort([math.inf if k is None or d is None or k >= window else 1e3 * d for k, window, d in found])


def detected(traces: Sequence[ScoredEpisode], window_s: float) -> Share:
    """Faults with an alarm raised within the window."""
    return Share.of([math.isfinite(d) for d in delays_ms(traces, window_s)])


def false_alarms(traces: Sequence[ScoredEpisode]) -> Share:
    """Episodes with an alarm before the fault, or with any where there is none."""
    return Share.of([bool(t.false_alarms) for t in traces])


def hourly_alarms(traces: Sequence[ScoredEpisode]) -> Rate:
    """Alarms before any fault, and the hours of that; one that persists, or comes back within a minute, is one."""
    return _hourly([(t, t.surprise) for t in traces])


def hourly_events(traces: Sequence[ScoredEpisode], event: str) -> Rate:
    """The same of ``"knock"`` or ``"stop"``, as far as those rows are no faults."""
    own = ((t, t.excused.get(event, np.zeros(len(t)))) for t in traces)
    return _hourly([(t, np.where(t.alarm, 0.0, raw)) for t, raw in own])


def _hourly(traces: Sequence[tuple[ScoredEpisode, Floats]]) -> Rate:
    nominal = [(t, value, len(t) if t.onset is None else t.onset) for t, value in traces]
    alarms = sum(alarms_in(value[:until], t.threshold, t.dt) for t, value, until in nominal)
    return Rate(alarms, sum(until * t.dt for t, _, until in nominal) / 3600)


def attribution_accuracy(faulty: Sequence[ScoredEpisode]) -> Share:
    """Of the faults that raised an alarm, those whose most surprising channel belonged to the fault."""
    return Share.of([t.top_channel in t.affected_channels for t in faulty if t.top_channel and t.affected_channels])


def typical(traces: Sequence[ScoredEpisode]) -> ScoredEpisode:
    """The episode whose greatest surprise since the onset is the median one."""
    return sorted(traces, key=lambda t: float(t.surprise[t.onset or 0 :].max(initial=0.0)))[len(traces) // 2]


class KindMetrics(NamedTuple):
    """How well faults of one kind and severity were detected, or could be.

    Attributes:
        name: in words.
        auroc: over matched steps.
        found: faults detected within the window, by the false-alarm rate that the threshold was set for.
        delays: at the threshold of the traces; None without faults.
    """

    name: str
    auroc: float
    found: Mapping[float, Share]
    delays: Delays | None


class ActingMetrics(NamedTuple):
    """How episodes ended with one kind of acting.

    Attributes:
        acting: ``"policy alone"``, or what the alarm did.
        success: episodes that solved the task.
        ended_by_alarm: episodes that the alarm ended.
        peak_force: median over episodes of the greatest contact force [N]; NaN where it was not measured.
    """

    acting: str
    success: Share
    ended_by_alarm: Share
    peak_force: float


@dataclass(frozen=True, eq=False)
class DetectionMetrics:
    """Traces of one monitor summed up: a row of a table, a curve of a figure.

    Args:
        name: of a condition, or of a monitor.
        traces: of any kind of fault and acting.
        nominal: traces that the faulty ones are compared with.
        window_s: how soon an alarm must come to count as detection [s].
        thresholds: others to detect by, by the false-alarm rate that each was set for.
        maxima: (n,) the greatest surprise in each calibration episode, from which thresholds are set.
        hourly: others again, by the false alarms an hour that each was set for.
        blocks: the same by the hour, as the monitor was calibrated on it.
    """

    name: str
    traces: Sequence[ScoredEpisode]
    nominal: Sequence[ScoredEpisode]
    window_s: float
    thresholds: Mapping[float, float] = field(default_factory=dict)
    maxima: Floats = field(default_factory=lambda: np.zeros(0))
    hourly: Mapping[float, float] = field(default_factory=dict)
    blocks: Blocks | None = None

    @cached_property
    def draws(self) -> Draws:
        """The same figures over scenes and calibration episodes drawn anew."""
        how = Calibration(self.maxima, self.blocks, tuple(self.thresholds), tuple(self.hourly))
        return drawn_anew(self.faulty, self.nominal, how, self.window_s)

    @cached_property
    def watched(self) -> list[ScoredEpisode]:
        """Those in which the policy acted alone: detection is measured on them."""
        return [t for t in self.traces if t.watched_only]

    @cached_property
    def faulty(self) -> list[ScoredEpisode]:
        return [t for t in self.watched if t.onset is not None]

    @cached_property
    def kinds(self) -> dict[Kind, KindMetrics]:
        """By kind and severity, in order of appearance."""
        groups: dict[Kind, list[ScoredEpisode]] = {}
        for trace in self.faulty:
            groups.setdefault((trace.kind, trace.severity), []).append(trace)
        return {kind: self._of(kind, group) for kind, group in groups.items()}

    def _of(self, kind: Kind, faulty: Sequence[ScoredEpisode]) -> KindMetrics:
        placed = placements(faulty, self.nominal, self.window_s)
        return KindMetrics(
            name=in_words(kind),
            auroc=float(1.0 - placed.mean()) if placed.size else math.nan,
            found={r: detected([t.at(q) for t in faulty], self.window_s) for r, q in self.thresholds.items()},
            delays=Delays.of(delays_ms(faulty, self.window_s)),
        )

    @property
    def auroc(self) -> float:
        """Mean over kinds; NaN without faults."""
        return float(np.mean([k.auroc for k in self.kinds.values()])) if self.kinds else math.nan

    @property
    def unmatched_auroc(self) -> float:
        """As an alarm sees it: the peak in the window against the peak of whole nominal episodes; mean over kinds."""
        nominal = [t.surprise.max() for t in self.nominal]
        peaks: dict[Kind, list[float]] = {}
        for t in self.faulty:
            peaks.setdefault((t.kind, t.severity), []).append(t.surprise[t.window(self.window_s)].max(initial=0.0))
        return float(np.mean([auroc(own, nominal) for own in peaks.values()])) if peaks and nominal else math.nan

    @property
    def found(self) -> dict[float, Share]:
        """All faults detected within the window, by false-alarm rate."""
        each = [k.found for k in self.kinds.values()]
        return {r: Share(sum(f[r].k for f in each), sum(f[r].n for f in each)) for r in self.thresholds}

    @cached_property
    def found_hourly(self) -> dict[float, Share]:
        """All faults detected within the window, by the false alarms an hour that the threshold was set for."""
        return {r: detected([t.at(q) for t in self.faulty], self.window_s) for r, q in self.hourly.items()}

    @cached_property
    def aucpdt(self) -> float:
        """Precision, recall and delay in one number, the lower the better."""
        return aucpdt(self.faulty, self.nominal, self.window_s)

    @cached_property
    def delays(self) -> Delays | None:
        return Delays.of(delays_ms(self.faulty, self.window_s))

    @property
    def detected(self) -> Share:
        """Faults detected within the window."""
        return detected(self.faulty, self.window_s)

    @property
    def top_channels(self) -> list[tuple[str, int]]:
        """The channels that surprised most at the alarms, with the number of episodes; the three most frequent."""
        return Counter(t.top_channel for t in self.watched if t.top_channel).most_common(3)

    @cached_property
    def outcomes(self) -> list[ActingMetrics]:
        """One for each kind of acting, the policy alone first."""
        actings = sorted(dict.fromkeys(t.acting for t in self.traces), key=lambda a: a != POLICY_ALONE)
        return [_ended(a, [t for t in self.traces if t.acting == a]) for a in actings]


def _ended(acting: str, traces: Sequence[ScoredEpisode]) -> ActingMetrics:
    ends = [t.outcome for t in traces]
    return ActingMetrics(
        acting=acting,
        success=Share.of([o.success for o in ends]),
        ended_by_alarm=Share.of([o.ended_by_alarm for o in ends]),
        peak_force=float(np.median([o.contact_force for o in ends])),
    )


def by_condition(traces: Sequence[ScoredEpisode], window_s: float) -> list[DetectionMetrics]:
    """One for each condition, the nominal one first, then in order of appearance."""
    nominal = [t for t in traces if t.kind == NOMINAL and t.watched_only]
    conditions = sorted(dict.fromkeys(t.condition for t in traces), key=lambda c: c != NOMINAL)
    return [DetectionMetrics(c, [t for t in traces if t.condition == c], nominal, window_s) for c in conditions]
