"""Monitors side by side with the ideal observer, whom no monitor can surpass."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import NamedTuple

import numpy as np

from asm_gym.evaluation.defaults import RATES
from asm_gym.evaluation.ideal import auroc_bound, power_bound
from asm_gym.evaluation.metrics import Delays, DetectionMetrics, Kind, KindMetrics, false_alarms, in_words
from asm_gym.evaluation.resampling import Calibration
from asm_gym.evaluation.scored_episode import NOMINAL, ScoredEpisode
from asm_gym.evaluation.statistics import Share

IDEAL = "ideal observer"

VISIBLE = 0.5
"""A kind counts where the ideal observer finds at least this share of its faults at a false-alarm rate of 1 %."""


@dataclass(frozen=True)
class Detectability:
    """What the ideal observer could detect of one faulty episode.

    Args:
        task, kind, severity, seed: identify the episode.
        separation: S at the end of the window.
        earliest: rows from the onset until the observer is sure; None if never.
        dt: period of the rows [s].
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
        """Time from the onset until the observer is sure [s]; None if never."""
        return None if self.earliest is None else (self.earliest + 1) * self.dt


@dataclass(frozen=True, eq=False)
class MonitorResult:
    """The scores of one monitor on a run's episodes.

    Args:
        traces: nominal and faulty episodes, judged at the run's own false-alarm rate.
        harmless: episodes of harmless variations, likewise.
        calibration: the monitor's thresholds.
        examples: typical faulty episodes with the detail that figures need.
    """

    traces: Sequence[ScoredEpisode]
    harmless: Sequence[ScoredEpisode]
    calibration: Calibration
    examples: Sequence[ScoredEpisode] = ()

    def metrics(self, name: str, window_s: float, visible: Mapping[Kind, bool] | None = None) -> DetectionMetrics:
        """Sum up all kinds of fault, or those that are ``visible``."""
        nominal = [t for t in self.traces if t.kind == NOMINAL]
        faulty = [t for t in self.traces if t.onset is not None]
        if visible is not None:
            faulty = [t for t in faulty if visible.get((t.kind, t.severity), False)]
        return DetectionMetrics(name, faulty, nominal, window_s, self.calibration)


class LeftOut(NamedTuple):
    """Numbers of nominal episodes that are no example of normal operation.

    Attributes:
        failed: the policy did not do its task.
        crashed: it did, but hit something by itself.
    """

    failed: int = 0
    crashed: int = 0


@dataclass(frozen=True, eq=False)
class BenchmarkResult:
    """The scores of monitors on a run's episodes, and the bound of the ideal observer.

    Args:
        monitors: by name.
        detectability: of every faulty episode.
        rate: the run's own false-alarm rate.
        window_s: an alarm within this time of the onset is a detection [s].
        left_out: nominal episodes that are not used.
    """

    monitors: Mapping[str, MonitorResult]
    detectability: Sequence[Detectability]
    rate: float
    window_s: float
    left_out: LeftOut = field(default_factory=LeftOut)

    @cached_property
    def visible(self) -> dict[Kind, bool]:
        """Whether the ideal observer could detect each kind and severity."""
        return visible_kinds(self.detectability)

    @cached_property
    def on_all(self) -> list[DetectionMetrics]:
        """Each monitor on all kinds of fault."""
        return [m.metrics(name, self.window_s) for name, m in self.monitors.items()]

    @cached_property
    def on_visible(self) -> list[DetectionMetrics]:
        """Each monitor on the visible kinds of fault."""
        return [m.metrics(name, self.window_s, self.visible) for name, m in self.monitors.items()]

    @property
    def ideal(self) -> KindMetrics:
        """The bound over the visible kinds."""
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
        """Count the episodes of each harmless variation with an alarm, by monitor."""
        return {
            name: {
                kind: false_alarms([t for t in monitor.harmless if t.kind == kind])
                for kind in dict.fromkeys(t.kind for t in monitor.harmless)
            }
            for name, monitor in self.monitors.items()
        }


def visible_kinds(detectability: Sequence[Detectability]) -> dict[Kind, bool]:
    """Return whether an ideal observer could detect each kind and severity, in order of appearance."""
    kinds: dict[Kind, list[Detectability]] = {}
    for one in detectability:
        kinds.setdefault((one.kind, one.severity), []).append(one)
    return {kind: _mean_power(own, 0.01) >= VISIBLE for kind, own in kinds.items()}


def ideal_metrics(name: str, detectability: Sequence[Detectability], rates: Sequence[float] = RATES) -> KindMetrics:
    """Return the bound on the results of any monitor on these faults."""
    separations = np.array([d.separation for d in detectability])
    n = len(separations)
    return KindMetrics(
        name=name,
        auroc=float(np.mean(auroc_bound(separations))) if n else math.nan,
        found={r: Share(round(n * _mean_power(detectability, r)), n) for r in rates if n},
        delays=Delays.of([math.inf if d.delay is None else 1e3 * d.delay for d in detectability]),
    )


def _mean_power(detectability: Sequence[Detectability], rate: float) -> float:
    return float(np.mean(power_bound(np.array([d.separation for d in detectability]), rate)))
