"""Monitors side by side, the ideal observer on top: tables of numbers, made from verdicts."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from asm_gym.evaluation import scoring
from asm_gym.evaluation.ideal import auroc_bound, power_bound
from asm_gym.evaluation.scoring import Verdict
from asm_gym.evaluation.statistics import Share

IDEAL = "ideal observer"

RATES = (0.005, 0.01, 0.05)
"""Shares of nominal episodes with an alarm, at which detection is compared."""

VISIBLE = 0.5
"""A kind counts where the ideal observer finds at least this share of its faults at a false-alarm rate of 1 %."""


@dataclass(frozen=True)
class Sight:
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


@dataclass(frozen=True)
class Cell:
    """One monitor on one kind of fault, or on several.

    Args:
        auroc, precision: over matched steps; AUROC and average precision.
        found: faults detected within the window, by the false-alarm rate the threshold was set for.
        median_ms, p95_ms: delay at the run's own rate, a miss counting as infinitely late.
    """

    auroc: float
    precision: float
    found: Mapping[float, Share]
    median_ms: float
    p95_ms: float


@dataclass(frozen=True)
class Score:
    """One monitor on all visible kinds.

    Args:
        monitor: by name.
        cell: means over kinds of AUROC and average precision; shares over all faults.
        false_alarms: nominal test episodes with an alarm.
        false_alarms_per_hour: [1/h].
        balanced_accuracy, timestep_weighted_accuracy: at the run's own rate.
        attribution: alarms whose most surprising channel belonged to the fault.
    """

    monitor: str
    cell: Cell
    false_alarms: Share
    false_alarms_per_hour: float
    balanced_accuracy: float
    timestep_weighted_accuracy: float
    attribution: Share


def visible_kinds(sights: Sequence[Sight]) -> dict[tuple[str, str], bool]:
    """(kind, severity): whether an ideal observer could see it, in order of appearance."""
    kinds = dict.fromkeys((s.kind, s.severity) for s in sights)
    return {k: _mean_power([s for s in sights if (s.kind, s.severity) == k], 0.01) >= VISIBLE for k in kinds}


def ideal_cell(sights: Sequence[Sight], rates: Sequence[float] = RATES) -> Cell:
    """The bound on what any monitor can score on these faults.

    The bound on average precision is not known in closed form and left out.
    """
    late = sorted(math.inf if s.earliest is None else 1e3 * (s.earliest + 1) * s.dt for s in sights)
    auroc = float(np.mean(auroc_bound(np.array([s.separation for s in sights])))) if sights else math.nan
    found = {r: Share(round(len(sights) * _mean_power(sights, r)), len(sights)) for r in rates if sights}
    return Cell(auroc, math.nan, found, _quantile(late, 0.5), _quantile(late, 0.95))


def cell(
    faulty: Sequence[Verdict],
    nominal: Sequence[Verdict],
    thresholds: Mapping[float, float],
    rate: float,
    window_s: float,
) -> Cell:
    """One monitor's score on some faults.

    Args:
        thresholds: by the false-alarm rate they were set for.
        rate: which of them delays are given for.
    """
    placed = scoring.placements(faulty, nominal, window_s)
    late = scoring.delays(faulty, thresholds[rate], window_s)
    return Cell(
        auroc=float(1.0 - placed.mean()) if placed.size else math.nan,
        precision=scoring.average_precision(placed),
        found={r: scoring.detections(faulty, q, window_s) for r, q in thresholds.items()},
        median_ms=late.median_ms if late else math.nan,
        p95_ms=late.p95_ms if late else math.nan,
    )


def by_kind(
    verdicts: Sequence[Verdict], thresholds: Mapping[float, float], rate: float, window_s: float
) -> dict[tuple[str, str], Cell]:
    """(kind, severity): one monitor's cell, in order of appearance."""
    nominal = [v for v in verdicts if v.kind == "nominal"]
    faulty = [v for v in verdicts if v.onset is not None]
    kinds = dict.fromkeys((v.kind, v.severity) for v in faulty)
    return {
        k: cell([v for v in faulty if (v.kind, v.severity) == k], nominal, thresholds, rate, window_s) for k in kinds
    }


def score(
    monitor: str,
    verdicts: Sequence[Verdict],
    thresholds: Mapping[float, float],
    rate: float,
    window_s: float,
    visible: Mapping[tuple[str, str], bool],
) -> Score:
    """One monitor's row: means over the kinds that an ideal observer can see."""
    nominal = [v for v in verdicts if v.kind == "nominal"]
    faulty = [v for v in verdicts if v.onset is not None and visible.get((v.kind, v.severity), False)]
    cells = list(by_kind([*nominal, *faulty], thresholds, rate, window_s).values())
    overall = cell(faulty, nominal, thresholds, rate, window_s)
    threshold = thresholds[rate]
    return Score(
        monitor=monitor,
        cell=Cell(
            auroc=float(np.mean([c.auroc for c in cells])) if cells else math.nan,
            precision=float(np.mean([c.precision for c in cells])) if cells else math.nan,
            found=overall.found,
            median_ms=overall.median_ms,
            p95_ms=overall.p95_ms,
        ),
        false_alarms=scoring.coverage(nominal, threshold),
        false_alarms_per_hour=scoring.false_alarms_per_hour(nominal, threshold),
        balanced_accuracy=scoring.balanced_accuracy(faulty, nominal, threshold, window_s),
        timestep_weighted_accuracy=scoring.timestep_weighted_accuracy(faulty, nominal, threshold),
        attribution=scoring.attribution_accuracy(faulty),
    )


def _mean_power(sights: Sequence[Sight], rate: float) -> float:
    return float(np.mean(power_bound(np.array([s.separation for s in sights]), rate))) if sights else math.nan


def _quantile(ordered: Sequence[float], q: float) -> float:
    return ordered[math.ceil(q * len(ordered)) - 1] if ordered else math.nan
