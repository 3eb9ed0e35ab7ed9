"""Monitors side by side, and the ideal observer, whom no monitor can surpass."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import NamedTuple

import numpy as np

from asm_gym.detection import Blocks
from asm_gym.evaluation.defaults import RATES
from asm_gym.evaluation.ideal import auroc_bound, power_bound
from asm_gym.evaluation.metrics import Delays, DetectionMetrics, Kind, KindMetrics, false_alarms, in_words
from asm_gym.evaluation.scored_episode import NOMINAL, ScoredEpisode
from asm_gym.evaluation.statistics import Floats, Share

IDEAL = "ideal observer"

VISIBLE = 0.5
"""A kind counts where the ideal observer finds at least this share of its faults at a false-alarm rate of 1 %."""


@dataclass(frozen=True)
class Detectability:
    """What the ideal observer could see of one faulty episode.

    Args:
        task, kind, severity, seed: which.
        separation: S at the end of the window.
        earliest: steps from the onset to the first at which it could be sure; None where it never could.
        dt: control period [s].
    """

    task: str
    kind: str
    severity: str
    seed: int
    separation: float
    earliest: int | None
    dt: float

    @property
    def delay(self) -> float | None:
        """Time from the beginning of the fault to being sure [s]; None where it never could be."""
        return None if self.earliest is None else (self.earliest + 1) * self.dt


@dataclass(frozen=True, eq=False)
class MonitorResult:
    """What one monitor made of a run's episodes.

    Args:
        traces: of nominal and faulty episodes, judged at the run's own false-alarm rate.
        harmless: of harmless variations, likewise.
        thresholds: by the false-alarm rate they were set for.
        examples: typical faulty episodes with all that figures need.
        maxima: (n,) the greatest surprise in each calibration episode.
        hourly: thresholds again, by the false alarms an hour that they were set for.
        blocks: the maxima by the hour; None where it was not calibrated so.
        calibration_tasks: (n,) of those episodes, where they are known.
    """

    traces: Sequence[ScoredEpisode]
    harmless: Sequence[ScoredEpisode]
    thresholds: Mapping[float, float]
    examples: Sequence[ScoredEpisode] = ()
    maxima: Floats = field(default_factory=lambda: np.zeros(0))
    hourly: Mapping[float, float] = field(default_factory=dict)
    blocks: Blocks | None = None
    calibration_tasks: Sequence[str] = ()


class LeftOut(NamedTuple):
    """Nominal episodes that are no example of what is normal.

    Attributes:
        failed: the policy did not do its task.
        crashed: it did, but hit something by itself.
    """

    failed: int = 0
    crashed: int = 0


@dataclass(frozen=True, eq=False)
class BenchmarkResult:
    """What monitors made of a run's episodes, and what an ideal observer could.

    Args:
        monitors: by name.
        detectability: of every faulty episode.
        rate: the run's own false-alarm rate.
        window_s: how soon an alarm must come to count as detection [s].
        left_out: how many nominal episodes are, and why.
    """

    monitors: Mapping[str, MonitorResult]
    detectability: Sequence[Detectability]
    rate: float
    window_s: float
    left_out: LeftOut = field(default_factory=LeftOut)

    @cached_property
    def visible(self) -> dict[Kind, bool]:
        return visible_kinds(self.detectability)

    @cached_property
    def on_all(self) -> list[DetectionMetrics]:
        """Each monitor on all kinds of fault."""
        return [monitor_metrics(n, m, self.window_s) for n, m in self.monitors.items()]

    @cached_property
    def on_visible(self) -> list[DetectionMetrics]:
        """Each monitor on the kinds of fault that can be seen."""
        return [monitor_metrics(n, m, self.window_s, self.visible) for n, m in self.monitors.items()]

    @property
    def ideal(self) -> KindMetrics:
        """The bound, over the kinds that can be seen."""
        seen = [d for d in self.detectability if self.visible[d.kind, d.severity]]
        return ideal_metrics(IDEAL, seen, (*RATES, self.rate))

    @cached_property
    def kinds(self) -> dict[str, dict[Kind, KindMetrics]]:
        """Each monitor on each kind of fault, the ideal observer first."""
        bound = {}
        for kind in self.visible:
            own = [d for d in self.detectability if (d.kind, d.severity) == kind]
            bound[kind] = ideal_metrics(in_words(kind), own, (*RATES, self.rate))
        return {IDEAL: bound} | {m.name: m.kinds for m in self.on_all}

    def false_alarms_by_variation(self) -> dict[str, dict[str, Share]]:
        """Episodes of each harmless variation with an alarm, by monitor."""
        return {
            name: {
                kind: false_alarms([t for t in monitor.harmless if t.kind == kind])
                for kind in dict.fromkeys(t.kind for t in monitor.harmless)
            }
            for name, monitor in self.monitors.items()
        }


def visible_kinds(detectability: Sequence[Detectability]) -> dict[Kind, bool]:
    """Whether an ideal observer could see faults of a kind and severity, in order of appearance."""
    kinds: dict[Kind, list[Detectability]] = {}
    for one in detectability:
        kinds.setdefault((one.kind, one.severity), []).append(one)
    return {kind: _mean_power(own, 0.01) >= VISIBLE for kind, own in kinds.items()}


def ideal_metrics(name: str, detectability: Sequence[Detectability], rates: Sequence[float] = RATES) -> KindMetrics:
    """The bound on what any monitor can score on these faults."""
    separations = np.array([d.separation for d in detectability])
    return KindMetrics(
        name=name,
        auroc=float(np.mean(auroc_bound(separations))) if len(separations) else math.nan,
        found={
            r: Share(round(len(separations) * _mean_power(detectability, r)), len(separations))
            for r in rates
            if len(separations)
        },
        delays=Delays.of([math.inf if d.delay is None else 1e3 * d.delay for d in detectability]),
    )


def monitor_metrics(
    name: str, result: MonitorResult, window_s: float, visible: Mapping[Kind, bool] | None = None
) -> DetectionMetrics:
    """One monitor on all kinds of fault, or on those that are ``visible``."""
    nominal = [t for t in result.traces if t.kind == NOMINAL]
    faulty = [t for t in result.traces if t.onset is not None]
    if visible is not None:
        faulty = [t for t in faulty if visible.get((t.kind, t.severity), False)]
    kept = result.thresholds, result.maxima, result.hourly, result.blocks
    return DetectionMetrics(name, faulty, nominal, window_s, *kept)


def _mean_power(detectability: Sequence[Detectability], rate: float) -> float:
    return float(np.mean(power_bound(np.array([d.separation for d in detectability]), rate)))
