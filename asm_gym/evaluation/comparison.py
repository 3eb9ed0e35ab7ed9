"""Monitors side by side with the ideal observer, whom no monitor can surpass."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from asm_gym.evaluation.defaults import RATES
from asm_gym.evaluation.ideal import Detectability, auroc_bound, mean_power, visible_kinds
from asm_gym.evaluation.metrics import Delays, DetectionMetrics, Kind, KindMetrics, false_alarms, in_words
from asm_gym.evaluation.resampling import Calibration, by_episode
from asm_gym.evaluation.scored_episode import NOMINAL, ScoredEpisode
from asm_gym.evaluation.statistics import Share
from asm_gym.monitors.calibration import AlarmRate

IDEAL = "ideal observer"


@dataclass(frozen=True, eq=False)
class MonitorResult:
    """The scores of one monitor on a run's episodes.

    Args:
        traces: nominal and faulty episodes, judged at the run's own false-alarm rate.
        harmless: episodes of harmless variations, likewise.
        calibration: the monitor's thresholds.
    """

    traces: Sequence[ScoredEpisode]
    harmless: Sequence[ScoredEpisode]
    calibration: Calibration

    def metrics(self, name: str, window_s: float, visible: Mapping[Kind, bool] | None = None) -> DetectionMetrics:
        """Sum up all kinds of fault, or those that are ``visible``."""
        nominal = [t for t in self.traces if t.kind == NOMINAL]
        faulty = [t for t in self.traces if t.onset is not None]
        if visible is not None:
            faulty = [t for t in faulty if visible.get((t.kind, t.severity), False)]
        return DetectionMetrics(name, faulty, nominal, window_s, self.calibration)


@dataclass(frozen=True, eq=False)
class BenchmarkResult:
    """The scores of monitors on a run's episodes, and the bound of the ideal observer.

    Args:
        monitors: by name.
        detectability: of every faulty episode.
        rate: the run's own false-alarm rate.
        window_s: an alarm within this time of the onset is a detection [s].
        left_out: numbers of nominal episodes in which the policy failed, and crashed.
    """

    monitors: Mapping[str, MonitorResult]
    detectability: Sequence[Detectability]
    rate: float
    window_s: float
    left_out: tuple[int, int] = (0, 0)

    @property
    def promise(self) -> AlarmRate:
        """The run's own false-alarm rate as a promise."""
        return by_episode(self.rate)

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
        return ideal_metrics(IDEAL, [d for d in self.detectability if self.visible[d.kind, d.severity]], self.rate)

    @cached_property
    def kinds(self) -> dict[str, dict[Kind, KindMetrics]]:
        """Each monitor on each kind of fault, the ideal observer first."""
        bound = {}
        for kind in self.visible:
            own = [d for d in self.detectability if (d.kind, d.severity) == kind]
            bound[kind] = ideal_metrics(in_words(kind), own, self.rate)
        return {IDEAL: bound} | {m.name: m.kinds for m in self.on_all}

    def harmless_alarms(self) -> dict[str, dict[str, Share]]:
        """Count the episodes of each harmless variation with an alarm, by monitor."""
        found: dict[str, dict[str, Share]] = {}
        for name, monitor in self.monitors.items():
            kinds = dict.fromkeys(t.kind for t in monitor.harmless)
            found[name] = {kind: false_alarms([t for t in monitor.harmless if t.kind == kind]) for kind in kinds}
        return found


def ideal_metrics(name: str, faults: Sequence[Detectability], rate: float) -> KindMetrics:
    """Return the bound on the results of any monitor on these faults."""
    n = len(faults)
    return KindMetrics(
        name=name,
        auroc=float(np.mean(auroc_bound(np.array([d.separation for d in faults])))) if n else math.nan,
        found={by_episode(r): Share(round(n * mean_power(faults, r)), n) for r in {*RATES, rate} if n},
        delays=Delays.of([math.inf if d.delay is None else 1e3 * d.delay for d in faults]),
    )
