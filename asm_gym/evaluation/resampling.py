"""How sure the figures of a comparison are: scenes and calibration episodes drawn anew, with replacement.

All faults of one seed and task share a scene and the course of one episode, and all are judged by one threshold. So it
is scenes that are drawn and not faults, and the threshold is set anew on calibration episodes drawn anew: a cluster
bootstrap (Davison and Hinkley 1997, ch. 3.8) with percentile intervals. Monitors are drawn alike, so that their
differences are paired.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from asm_gym.detection import Blocks, conformal_episodes, conformal_threshold, hourly_threshold
from asm_gym.evaluation.scored_episode import ScoredEpisode, window_steps
from asm_gym.evaluation.statistics import Estimate, Floats

DRAWS = 400
"""How often everything is drawn anew."""


class Calibration(NamedTuple):
    """From what a monitor's thresholds are set, and for which promises.

    Attributes:
        maxima: (n,) the greatest surprise in each calibration episode.
        blocks: the same by the hour; None where nothing is promised by it.
        rates: of nominal episodes with an alarm; those that n is too small for are left out.
        hourly: of alarms an hour.
    """

    maxima: Floats
    blocks: Blocks | None = None
    rates: tuple[float, ...] = ()
    hourly: tuple[float, ...] = ()

    def anew(self, rng: np.random.Generator) -> tuple[dict[float, float], dict[float, float]]:
        """Thresholds from episodes, and from blocks, drawn anew with replacement: by rate, and by alarms an hour."""
        again = rng.integers(len(self.maxima), size=len(self.maxima))
        possible = [r for r in self.rates if len(self.maxima) >= conformal_episodes(r)]
        by_rate = {r: conformal_threshold(self.maxima[again], r) for r in possible}
        if self.blocks is None or not self.hourly:
            return by_rate, {}
        again = rng.integers(len(self.blocks.maxima), size=len(self.blocks.maxima))
        # As many hours as there were: short episodes drawn more often promise nothing else.
        drawn = self.blocks._replace(maxima=self.blocks.maxima[again])
        return by_rate, {r: hourly_threshold(drawn, r) for r in self.hourly}


class Draws(NamedTuple):
    """Figures of one monitor, once for each time that everything was drawn anew.

    Attributes:
        auroc: (R,) over matched steps, the mean over kinds.
        found: (R,) share of faults detected within the window, by the false-alarm rate the threshold was set for.
        hourly: (R,) the same, by the false alarms an hour that it was set for.
    """

    auroc: Floats
    found: Mapping[float, Floats]
    hourly: Mapping[float, Floats]


def interval(value: float, draws: Floats) -> Estimate:
    """The 95 % percentile interval about a figure; NaN where nothing was drawn."""
    if not len(draws) or np.isnan(draws).all():
        return Estimate(value, math.nan, math.nan)
    low, high = np.nanquantile(draws, [0.025, 0.975])
    return Estimate(value, float(low), float(high))


def drawn_anew(
    faulty: Sequence[ScoredEpisode],
    nominal: Sequence[ScoredEpisode],
    calibration: Calibration,
    window_s: float,
    seed: int = 0,
    draws: int = DRAWS,
) -> Draws:
    """The figures of one monitor over scenes and calibration episodes drawn anew.

    Args:
        faulty: traces with an onset; twins of nominal ones share their seed.
        nominal: traces without one; each is a scene of its task.
        calibration: by which thresholds are set anew.
        window_s: how soon an alarm must come to count as detection [s].
        seed: of what is drawn; the same for all monitors that are to be compared.
    """
    rng = np.random.default_rng(seed)
    names = sorted({(t.task, t.seed) for t in (*nominal, *faulty)})
    place = {name: i for i, name in enumerate(names)}
    tasks = [task for task, _ in names]
    kinds: dict[tuple[str, str], int] = {}
    kind = np.array([kinds.setdefault((t.kind, t.severity), len(kinds)) for t in faulty], int)
    scene = np.array([place[t.task, t.seed] for t in faulty], int)
    beaten = _beaten(faulty, nominal, place, window_s)
    known, beaten = ~np.isnan(beaten), np.nan_to_num(beaten)
    alarms = _Alarms(faulty, window_s)
    own = [np.array([i for i, name in enumerate(tasks) if name == task]) for task in dict.fromkeys(tasks)]
    auroc = np.full(draws, math.nan)
    found: tuple[dict[float, Floats], dict[float, Floats]] = {}, {}
    for k in range(draws):
        weights = np.zeros(len(names))  # how often each scene was drawn
        for scenes in own:
            np.add.at(weights, rng.choice(scenes, len(scenes)), 1.0)
        auroc[k] = _mean_auroc(beaten, known, weights, weights[scene], kind, len(kinds))
        for kept, thresholds in zip(found, calibration.anew(rng), strict=True):
            for rate, threshold in thresholds.items():
                kept.setdefault(rate, np.full(draws, math.nan))[k] = _mean(alarms.over(threshold), weights[scene])
    return Draws(auroc, *found)


def _beaten(
    faulty: Sequence[ScoredEpisode],
    nominal: Sequence[ScoredEpisode],
    place: Mapping[tuple[str, int], int],
    window_s: float,
) -> NDArray[np.float32]:
    """(F, scenes) 1 where a fault surprised more than the nominal episode in the same steps, ½ in ties, else NaN."""
    won = np.full((len(faulty), len(place)), np.nan, np.float32)
    by_task: dict[str, list[ScoredEpisode]] = {}
    for trace in nominal:
        by_task.setdefault(trace.task, []).append(trace)
    for row, trace in zip(won, faulty, strict=True):
        steps = trace.window(window_s)
        if steps.stop <= steps.start:
            continue
        mine = trace.surprise[steps].max()
        for other in by_task.get(trace.task, []):
            if len(other) > steps.start:
                theirs = other.surprise[steps].max()
                row[place[other.task, other.seed]] = 0.5 * ((mine > theirs) + float(mine >= theirs))
    return won


def _mean_auroc(
    beaten: Floats, known: NDArray[np.bool_], scenes: Floats, faults: Floats, kind: NDArray[np.int_], kinds: int
) -> float:
    """The mean over kinds, where each scene and each fault counts as often as it was drawn."""
    reached = known @ scenes
    each = (beaten @ scenes) / np.maximum(reached, 1.0)
    counts = np.where(reached > 0, faults, 0.0)
    total, drawn = (np.bincount(kind, w, kinds) for w in (counts * each, counts))
    return float((total[drawn > 0] / drawn[drawn > 0]).mean()) if drawn.any() else math.nan


def _mean(values: Floats, weights: Floats) -> float:
    return float(values @ weights / weights.sum()) if weights.sum() else math.nan


class _Alarms:
    """Which faults are detected at a threshold, without going through all traces again."""

    def __init__(self, faulty: Sequence[ScoredEpisode], window_s: float) -> None:
        self._faulty, self._window_s = faulty, window_s
        before = [t.surprise[o - 1] if (o := t.onset or 0) and o <= len(t) else -math.inf for t in faulty]
        self._before = np.array(before, float)
        self._peak = np.array([t.surprise[t.window(window_s)].max(initial=-math.inf) for t in faulty], float)

    def over(self, threshold: float) -> NDArray[np.float64]:
        """(F,) 1 where an alarm is raised within the window."""
        hit = (self._peak > threshold).astype(float)
        for i in np.flatnonzero(self._before > threshold):  # an alarm that was up already says nothing
            trace = self._faulty[i]
            late = trace.at(threshold).detected_after
            hit[i] = late is not None and late < window_steps(self._window_s, trace.dt)
        return hit
