"""Monitors side by side with the ideal observer, whom no monitor can surpass.

The twin of a faulty episode has the same seed and sensor noise but no fault, so d_t = x_t - x'_t is the effect on the
stream. An observer who knew both courses would form the likelihood ratio under the sensor noise σ. Its logarithm is
N(±S/2, S):

    S_T = Σ_{t ≤ T} Σ_i (d_ti / σ_i)²
    AUROC = Φ(√(S/2)),    power at the false-alarm rate α: Φ(√S - Φ⁻¹(1 - α))

(Neyman and Pearson 1933; Van Trees 1968, section 2.2: a known signal in white noise.) No detector does better.
"""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.stats import norm

from asm_gym.data.episode import Episode
from asm_gym.detection.conformal import EPISODE
from asm_gym.evaluation.defaults import RATES, REPORTED_RATE
from asm_gym.evaluation.metrics import Delays, DetectionMetrics, Kind
from asm_gym.evaluation.scored_episode import onset_row, window_steps
from asm_gym.evaluation.statistics import Share
from asm_gym.monitors.calibration import AlarmRate

Array = NDArray[np.floating[Any]]

RESOLUTION = 1e-3
"""Noise of a channel without any, as a share of its spread: commands are exact, but nobody predicts them exactly."""
VISIBLE = 0.5
"""A kind counts where the ideal observer finds at least this share of its faults at a false-alarm rate of 1 %."""
SURE = 0.95  # power of detection from which the ideal observer is sure
IDEAL = "ideal observer"


class Detectability(NamedTuple):
    """What the ideal observer could detect of one faulty episode."""

    kind: str
    severity: str
    separation: float  # S at the end of the window
    delay: float | None  # time from the onset until the observer is sure [s]; None if never


def noise_floor(noise: Array, streams: list[Array]) -> NDArray[np.float64]:
    """Return (D,) noise: the sensors' own ``noise`` (D,), at least ``RESOLUTION`` of the spread of ``streams``."""
    spread = np.concatenate(streams).astype(np.float64).std(axis=0)
    return np.maximum(np.maximum(noise, RESOLUTION * spread), 1e-9)


def separation(faulty: Array, twin: Array, noise: Array, onset: int) -> NDArray[np.float64]:
    """Return (T - onset,) S up to each step of an episode (T, D) and its twin in noise (D,); ValueError: no twins."""
    length = min(len(faulty), len(twin))
    before = min(onset, length)
    if not np.array_equal(faulty[:before], twin[:before]):
        raise ValueError(
            f"the episodes differ before the onset at step {onset}: they are not twins"
        )
    difference = np.asarray(faulty[onset:length], np.float64) - twin[onset:length]
    # A reading that is not finite is seen at once.
    gain = np.where(np.isfinite(difference), (difference / noise) ** 2, np.inf).sum(axis=1)
    return np.cumsum(gain)


def auroc_bound(separation: Array | float) -> NDArray[np.float64]:
    """Return the largest AUROC of any detector at this S."""
    return norm.cdf(np.sqrt(np.asarray(separation, np.float64) / 2))


def power_bound(separation: Array | float, rate: float) -> NDArray[np.float64]:
    """Return the largest probability of detection at this S and false-alarm ``rate``."""
    return norm.cdf(np.sqrt(np.asarray(separation, np.float64)) - norm.isf(rate))


def earliest(separation: Array) -> int | None:
    """Return the first step since the onset at which the power at ``REPORTED_RATE`` reaches ``SURE``; None if never."""
    enough = np.flatnonzero(power_bound(separation, REPORTED_RATE) >= SURE)
    if not enough.size:
        return None
    return int(enough[0])


def mean_power(faults: Sequence[Detectability], rate: float) -> float:
    """Return the share of these faults that the ideal observer finds at a false-alarm ``rate``."""
    return float(np.mean(power_bound(np.array([d.separation for d in faults]), rate)))


def detectability_of(
    nominal: Sequence[Episode], faulty: Sequence[Episode], window_s: float
) -> list[Detectability]:
    """Return what an ideal observer could detect of the faulty episodes, whose nominal twins it knows."""
    twins = {(e.labelled.task, e.labelled.seed): e.stream for e in nominal}
    streams: defaultdict[str, list[Array]] = defaultdict(list)  # by task
    for episode in nominal:
        streams[episode.labelled.task].append(episode.stream)
    noises: dict[str, Array] = {}  # by task

    detectability = []
    for episode in faulty:
        label = episode.labelled
        dt = episode.spec.dt
        if label.task not in noises:
            noises[label.task] = noise_floor(episode.spec.noise, streams[label.task])
        twin = twins[label.task, label.seed]
        onset = onset_row(episode) or 0
        window = separation(episode.stream, twin, noises[label.task], onset)
        window = window[: window_steps(window_s, dt)]
        delay = None
        sure = earliest(window)
        if sure is not None:
            delay = (sure + 1) * dt
        detectability.append(
            Detectability(
                kind=label.kind,
                severity=label.severity,
                separation=float(window.max(initial=0.0)),
                delay=delay,
            )
        )
    return detectability


def visible_kinds(detectability: Sequence[Detectability]) -> dict[tuple[str, str], bool]:
    """Return whether an ideal observer could detect each kind and severity, in order of appearance."""
    kinds: dict[Kind, list[Detectability]] = {}
    for one in detectability:
        kinds.setdefault((one.kind, one.severity), []).append(one)
    return {kind: mean_power(own, REPORTED_RATE) >= VISIBLE for kind, own in kinds.items()}


class Bound(NamedTuple):
    """The results of an ideal observer, which no monitor can surpass."""

    auroc: float
    found: Mapping[AlarmRate, Share]
    delays: Delays

    @classmethod
    def of(cls, faults: Sequence[Detectability], rate: float) -> Bound:
        """Return the bound on these faults, at ``RATES`` and at a false-alarm ``rate``."""
        n = len(faults)
        if not n:
            return cls(auroc=math.nan, found={}, delays=Delays())
        delays = [math.inf if fault.delay is None else 1e3 * fault.delay for fault in faults]
        found = {}
        for each in {*RATES, rate}:
            found[AlarmRate(each, EPISODE)] = Share(round(n * mean_power(faults, each)), n)
        auroc = auroc_bound(np.array([fault.separation for fault in faults])).mean()
        return cls(auroc=float(auroc), found=found, delays=Delays.of(delays))


class LeftOut(NamedTuple):
    """How much of a run's recordings was not used."""

    failed_episodes: int = 0  # healthy episodes in which the policy failed
    crashed_scenes: int = 0  # scenes, by task and seed, in which the robot crashes without a fault


@dataclass(frozen=True, eq=False)
class BenchmarkResult:
    """The scores of monitors on a run's episodes, and the bound of the ideal observer."""

    monitors: Mapping[str, DetectionMetrics]  # by name, on all kinds of fault
    detectability: Sequence[Detectability]  # of every faulty episode
    rate: float  # false-alarm rate at which monitors are judged
    window_s: float  # an alarm within this time of the onset is a detection [s]
    left_out: LeftOut = LeftOut()  # noqa: RUF009  (immutable)

    @property
    def promise(self) -> AlarmRate:
        """The run's own false-alarm rate as a promise."""
        return AlarmRate(self.rate, EPISODE)

    @cached_property
    def visible(self) -> dict[Kind, bool]:
        """Whether the ideal observer could detect each kind and severity."""
        return visible_kinds(self.detectability)

    @property
    def visible_kinds(self) -> list[Kind]:
        """The kinds and severities that the ideal observer could detect."""
        return [kind for kind, is_visible in self.visible.items() if is_visible]

    def bound(self, kinds: Collection[Kind]) -> Bound:
        """Return what the ideal observer detects of these kinds."""
        return Bound.of([d for d in self.detectability if (d.kind, d.severity) in kinds], self.rate)

    @cached_property
    def on_visible(self) -> list[DetectionMetrics]:
        """Each monitor on the visible kinds of fault."""
        return [m.only(self.visible_kinds) for m in self.monitors.values()]
