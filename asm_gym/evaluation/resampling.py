"""Confidence intervals of a comparison: scenes and calibration episodes resampled with replacement.

All faults of one seed and task share a scene, and all are judged by one threshold. So scenes are resampled, not faults,
and the threshold is set anew on resampled calibration episodes: a cluster bootstrap (Davison and Hinkley 1997, ch. 3.8)
with percentile intervals. Monitors are resampled alike, so their differences are paired.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from asm_gym.detection import Blocks, conformal_episodes, conformal_threshold, hourly_threshold
from asm_gym.evaluation.scored_episode import ScoredEpisode, window_steps
from asm_gym.evaluation.statistics import Estimate, Floats

DRAWS = 400
"""Bootstrap resamples."""


@dataclass(frozen=True, eq=False)
class Calibration:
    """The thresholds of a monitor, and the scores that they were set on.

    Attributes:
        thresholds: by the share of nominal episodes that may raise an alarm.
        hourly: by the false alarms per hour.
        maxima: (n,) the greatest surprise of each calibration episode.
        blocks: the maxima by the hour; None if not calibrated by the hour.
    """

    thresholds: Mapping[float, float] = field(default_factory=dict)
    hourly: Mapping[float, float] = field(default_factory=dict)
    maxima: Floats = field(default_factory=lambda: np.zeros(0))
    blocks: Blocks | None = None

    def resampled(self, rng: np.random.Generator) -> tuple[dict[float, float], dict[float, float]]:
        """Return thresholds by rate, and by alarms per hour, from resampled episodes and blocks."""
        maxima = self.maxima[rng.integers(len(self.maxima), size=len(self.maxima))]
        possible = [r for r in self.thresholds if len(maxima) >= conformal_episodes(r)]
        by_rate = {r: conformal_threshold(maxima, r) for r in possible}
        if self.blocks is None or not self.hourly:
            return by_rate, {}
        again = rng.integers(len(self.blocks.maxima), size=len(self.blocks.maxima))
        drawn = self.blocks._replace(maxima=self.blocks.maxima[again])  # the hours stay as they were
        return by_rate, {r: hourly_threshold(drawn, r) for r in self.hourly}


class Draws(NamedTuple):
    """Results of one monitor in each of R resamples.

    Attributes:
        auroc: (R,) over matched steps, the mean over kinds.
        found: (R,) share of faults detected within the window, by false-alarm rate.
        hourly: (R,) the same, by false alarms per hour.
    """

    auroc: Floats
    found: Mapping[float, Floats]
    hourly: Mapping[float, Floats]


def interval(value: float, draws: Floats) -> Estimate:
    """Return the 95 % percentile interval about a value; NaN where nothing was resampled."""
    if not len(draws) or np.isnan(draws).all():
        return Estimate(value, math.nan, math.nan)
    low, high = np.nanquantile(draws, [0.025, 0.975])
    return Estimate(value, float(low), float(high))


def resample(
    faulty: Sequence[ScoredEpisode],
    nominal: Sequence[ScoredEpisode],
    calibration: Calibration,
    window_s: float,
    seed: int = 0,
    draws: int = DRAWS,
) -> Draws:
    """Resample the results of one monitor.

    Args:
        faulty: episodes with an onset; twins of nominal ones share their seed.
        nominal: episodes without one; each is a scene of its task.
        calibration: sets the thresholds anew.
        window_s: an alarm within this time of the onset is a detection [s].
        seed: the same for all monitors that are compared.
        draws: number of resamples.
    """
    rng = np.random.default_rng(seed)
    names = sorted({(t.task, t.seed) for t in (*nominal, *faulty)})
    place = {name: i for i, name in enumerate(names)}
    tasks = [task for task, _ in names]
    kinds: dict[tuple[str, str], int] = {}
    kind = np.array([kinds.setdefault((t.kind, t.severity), len(kinds)) for t in faulty], int)
    scene = np.array([place[t.task, t.seed] for t in faulty], int)
    wins = _wins(faulty, nominal, place, window_s)
    known, wins = ~np.isnan(wins), np.nan_to_num(wins)
    detections = _detector(faulty, window_s)
    own = [np.array([i for i, name in enumerate(tasks) if name == task]) for task in dict.fromkeys(tasks)]
    auroc = np.full(draws, math.nan)
    found: tuple[dict[float, Floats], dict[float, Floats]] = {}, {}
    for k in range(draws):
        weights = np.zeros(len(names))  # how often each scene was drawn
        for scenes in own:
            np.add.at(weights, rng.choice(scenes, len(scenes)), 1.0)
        auroc[k] = _mean_auroc(wins, known, weights, weights[scene], kind, len(kinds))
        for kept, thresholds in zip(found, calibration.resampled(rng), strict=True):
            for rate, threshold in thresholds.items():
                shares = kept.setdefault(rate, np.full(draws, math.nan))
                shares[k] = _mean(detections(threshold), weights[scene])
    return Draws(auroc, *found)


def _wins(
    faulty: Sequence[ScoredEpisode],
    nominal: Sequence[ScoredEpisode],
    place: Mapping[tuple[str, int], int],
    window_s: float,
) -> NDArray[np.float32]:
    """Return (F, scenes) 1 where a fault surprised more than the nominal episode in the same steps, ½ in ties."""
    won = np.full((len(faulty), len(place)), np.nan, np.float32)
    for row, trace in zip(won, faulty, strict=True):
        steps = trace.window(window_s)
        if steps.stop <= steps.start:
            continue
        mine = trace.surprise[steps].max()
        for other in nominal:
            if other.task == trace.task and len(other) > steps.start:
                theirs = other.surprise[steps].max()
                row[place[other.task, other.seed]] = 0.5 * ((mine > theirs) + float(mine >= theirs))
    return won


def _mean_auroc(
    wins: Floats, known: NDArray[np.bool_], scenes: Floats, faults: Floats, kind: NDArray[np.int_], kinds: int
) -> float:
    """Return the mean over kinds, each scene and each fault weighted by how often it was drawn."""
    reached = known @ scenes
    each = (wins @ scenes) / np.maximum(reached, 1.0)
    counts = np.where(reached > 0, faults, 0.0)
    total, drawn = (np.bincount(kind, w, kinds) for w in (counts * each, counts))
    return float((total[drawn > 0] / drawn[drawn > 0]).mean()) if drawn.any() else math.nan


def _mean(values: Floats, weights: Floats) -> float:
    return float(values @ weights / weights.sum()) if weights.sum() else math.nan


def _detector(faulty: Sequence[ScoredEpisode], window_s: float) -> Callable[[float], Floats]:
    """Return a function of a threshold that gives (F,) 1 for each fault detected within the window."""
    before = np.array([t.surprise[o - 1] if (o := t.onset or 0) and o <= len(t) else -math.inf for t in faulty])
    peak = np.array([t.surprise[t.window(window_s)].max(initial=-math.inf) for t in faulty])

    def detections(threshold: float) -> Floats:
        hit = (peak > threshold).astype(float)
        for i in np.flatnonzero(before > threshold):  # an alarm that was up already is no detection
            late = faulty[i].at(threshold).detected_after
            hit[i] = late is not None and late < window_steps(window_s, faulty[i].dt)
        return hit

    return detections
