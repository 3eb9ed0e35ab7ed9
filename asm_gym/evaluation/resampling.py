"""Detections at many thresholds, and their confidence intervals: scenes and calibration episodes drawn again.

All faults of one seed and task share a scene, and all are judged by one threshold. So scenes are resampled, not faults,
and the threshold is set anew on resampled calibration episodes: a cluster bootstrap (Davison and Hinkley 1997, ch. 3.8)
with percentile intervals. Monitors are resampled alike, so their differences are paired.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from asm_gym.detection import Blocks
from asm_gym.detection.alarm_rule import alarms_begin, rows_over
from asm_gym.detection.conformal import HOUR
from asm_gym.evaluation.scored_episode import ScoredEpisode, window_steps
from asm_gym.evaluation.statistics import Estimate, Floats
from asm_gym.monitors.calibration import AlarmRate

DRAWS = 400  # bootstrap resamples


@dataclass(frozen=True, eq=False)
class Calibration:
    """The thresholds of a monitor, and the scores that they were set on."""

    thresholds: Mapping[AlarmRate, float] = field(default_factory=dict)
    maxima: Floats = field(default_factory=lambda: np.zeros(0))  # (n,) of each episode
    blocks: Blocks | None = None  # the maxima by the hour; None if not calibrated by the hour

    def resampled(self, rng: np.random.Generator) -> dict[AlarmRate, float]:
        """Return the thresholds from resampled episodes and blocks; the hours stay as they were."""
        if not len(self.maxima):
            return {}
        maxima = rng.choice(self.maxima, len(self.maxima))
        blocks = self.blocks
        if blocks is not None and any(promise.per == HOUR for promise in self.thresholds):
            blocks = blocks._replace(maxima=rng.choice(blocks.maxima, len(blocks.maxima)))
        return {promise: promise.threshold(maxima, blocks) for promise in self.thresholds}


class Draws(NamedTuple):
    """Results of one monitor in each of R resamples."""

    auroc: Floats  # (R,) over matched steps, the mean over kinds
    # (R,) share of faults detected within the window, by the promised rate
    found: Mapping[AlarmRate, Floats]


def interval(value: float, draws: Floats) -> Estimate:
    """Return the 95 % percentile interval about a value; NaN where nothing was resampled."""
    if not len(draws) or np.isnan(draws).all():
        return Estimate(value, math.nan, math.nan)
    low, high = np.nanquantile(draws, [0.025, 0.975])
    return Estimate(value, float(low), float(high))


class Wins:
    """Faults compared with nominal episodes of their task in the same steps."""

    def __init__(
        self, faulty: Sequence[ScoredEpisode], nominal: Sequence[ScoredEpisode], window_s: float
    ) -> None:
        shape = (len(faulty), len(nominal))
        self.won = np.zeros(shape)  # (F, N) 1 where a fault surprised more, ½ in ties
        self.comparable = np.zeros(shape)  # (F, N) 1 where both have a row in the window
        kind_of_fault = [(t.kind, t.severity) for t in faulty]
        kinds = list(dict.fromkeys(kind_of_fault))
        numbers = [kinds.index(kind) for kind in kind_of_fault]
        self.kind = np.array(numbers, int)  # (F,)

        for row, trace in enumerate(faulty):
            steps = trace.window(window_s)
            if trace.onset is None or steps.stop <= steps.start:
                continue
            peak = trace.surprise[steps].max()
            for column, other in enumerate(nominal):
                if other.task != trace.task or len(other) <= steps.start:
                    continue
                nominal_peak = other.surprise[steps].max()
                self.comparable[row, column] = 1.0
                if peak > nominal_peak:
                    self.won[row, column] = 1.0
                elif peak == nominal_peak:
                    self.won[row, column] = 0.5

    def auroc(self) -> float:
        """Return the mean over kinds of fault; NaN where nothing can be compared."""
        faulty, nominal = self.won.shape
        return self.weighted_auroc(np.ones(faulty), np.ones(nominal))

    def weighted_auroc(self, fault_weights: Floats, nominal_weights: Floats) -> float:
        """Return the same, with faults (F,) and nominal episodes (N,) counted so many times."""
        compared = self.comparable @ nominal_weights  # (F,) episodes
        weights = np.where(compared > 0, fault_weights, 0.0)
        share_won = (self.won @ nominal_weights) / np.maximum(compared, 1.0)
        sum_by_kind = np.bincount(self.kind, weights * share_won)
        weight_by_kind = np.bincount(self.kind, weights)
        is_drawn = weight_by_kind > 0
        if not is_drawn.any():
            return math.nan
        auroc_by_kind = sum_by_kind[is_drawn] / weight_by_kind[is_drawn]
        return float(auroc_by_kind.mean())


class Windows:
    """The surprise of faults within the window and one step before; a fault is detected where an alarm begins there."""

    def __init__(self, faulty: Sequence[ScoredEpisode], window_s: float) -> None:
        longest = max((window_steps(window_s, t.dt) for t in faulty), default=0)
        self._surprise = np.full((len(faulty), longest + 1), -math.inf)  # (F, W + 1)
        for row, trace in zip(self._surprise, faulty, strict=True):
            steps = trace.window(window_s)
            first = max(steps.start - 1, 0)
            values = trace.surprise[first : steps.stop]
            column = first - (steps.start - 1)  # 1 where no step is before the window
            row[column : column + len(values)] = values

    def detected(self, threshold: float) -> NDArray[np.bool_]:
        """Return (F,) which faults are detected at a threshold."""
        alarm = rows_over(self._surprise, threshold)
        return np.asarray(alarms_begin(alarm).any(axis=1))


def resample(
    faulty: Sequence[ScoredEpisode],
    nominal: Sequence[ScoredEpisode],
    calibration: Calibration,
    window_s: float,
    seed: int = 0,
    draws: int = DRAWS,
) -> Draws:
    """Resample the results of one monitor.

    A scene is a task and a seed, which a fault shares with its twin. Monitors are paired by the same ``seed``.
    """
    rng = np.random.default_rng(seed)
    scenes = sorted({(t.task, t.seed) for t in (*nominal, *faulty)})
    number = {scene: n for n, scene in enumerate(scenes)}
    scene_of_fault = np.array([number[t.task, t.seed] for t in faulty], int)  # (F,)
    scene_of_nominal = np.array([number[t.task, t.seed] for t in nominal], int)  # (N,)
    tasks = np.array([task for task, _ in scenes])
    scenes_by_task = [np.flatnonzero(tasks == task) for task in dict.fromkeys(tasks)]

    wins = Wins(faulty, nominal, window_s)
    windows = Windows(faulty, window_s)
    auroc = np.full(draws, math.nan)
    found: dict[AlarmRate, Floats] = {}
    for draw in range(draws):
        times_drawn = np.zeros(len(scenes))
        for scenes_of_task in scenes_by_task:
            drawn = rng.choice(scenes_of_task, len(scenes_of_task))
            np.add.at(times_drawn, drawn, 1.0)
        fault_weights = times_drawn[scene_of_fault]  # (F,)
        nominal_weights = times_drawn[scene_of_nominal]  # (N,)
        auroc[draw] = wins.weighted_auroc(fault_weights, nominal_weights)
        for promise, threshold in calibration.resampled(rng).items():
            shares = found.setdefault(promise, np.full(draws, math.nan))
            if fault_weights.any():
                is_detected = windows.detected(threshold)
                shares[draw] = is_detected @ fault_weights / fault_weights.sum()
    return Draws(auroc=auroc, found=found)
