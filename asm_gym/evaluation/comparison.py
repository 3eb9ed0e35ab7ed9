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

    task: str
    kind: str
    severity: str
    seed: int
    separation: float  # S at the end of the window
    delay: float | None  # time from the onset until the observer is sure [s]; None if never


def noise_floor(noise: Array, streams: list[Array]) -> NDArray[np.float64]:
    """Return (D,) noise: the sensors' own ``noise`` (D,), at least ``RESOLUTION`` of the spread of ``streams``."""
    spread = np.concatenate(streams).astype(np.float64).std(axis=0)
    return np.maximum(np.maximum(noise, RESOLUTION * spread), 1e-9)


def separation(faulty: Array, twin: Array, noise: Array, onset: int) -> NDArray[np.float64]:
    """Return (T - onset,) S up to each step of an episode (T, D) and its twin in noise (D,); ValueError: no twins."""
    length = min(len(faulty), len(twin))
    if not np.array_equal(faulty[: min(onset, length)], twin[: min(onset, length)]):
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
    return int(enough[0]) if enough.size else None


def mean_power(faults: Sequence[Detectability], rate: float) -> float:
    """Return the share of these faults that the ideal observer finds at a false-alarm ``rate``."""
    return float(np.mean(power_bound(np.array([d.separation for d in faults]), rate)))


def detectability_of(
    nominal: Sequence[Episode], faulty: Sequence[Episode], window_s: float
) -> list[Detectability]:
    """Return what an ideal observer could detect of the faulty episodes, whose nominal twins it knows."""
    twins = {(e.labelled.task, e.labelled.seed): e.stream for e in nominal}
    noises: dict[str, Any] = {}
    found = []
    for episode in faulty:
        label, dt = episode.labelled, episode.spec.dt
        if label.task not in noises:
            own = [e.stream for e in nominal if e.labelled.task == label.task]
            noises[label.task] = noise_floor(episode.spec.noise, own)
        summed = separation(
            episode.stream,
            twins[label.task, label.seed],
            noises[label.task],
            onset_row(episode) or 0,
        )
        window = summed[: window_steps(window_s, dt)]
        sure, most = earliest(window), float(window[-1]) if len(window) else 0.0
        delay = None if sure is None else (sure + 1) * dt
        found.append(Detectability(label.task, label.kind, label.severity, label.seed, most, delay))
    return found


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
        return cls(
            auroc=float(np.mean(auroc_bound(np.array([d.separation for d in faults]))))
            if n
            else math.nan,
            found={
                AlarmRate(r, EPISODE): Share(round(n * mean_power(faults, r)), n)
                for r in {*RATES, rate}
                if n
            },
            delays=Delays.of([math.inf if d.delay is None else 1e3 * d.delay for d in faults]),
        )


@dataclass(frozen=True, eq=False)
class BenchmarkResult:
    """The scores of monitors on a run's episodes, and the bound of the ideal observer."""

    monitors: Mapping[str, DetectionMetrics]  # by name, on all kinds of fault
    detectability: Sequence[Detectability]  # of every faulty episode
    rate: float  # false-alarm rate at which monitors are judged
    window_s: float  # an alarm within this time of the onset is a detection [s]
    # numbers of nominal episodes in which the policy failed, and crashed
    left_out: tuple[int, int] = (
        0,
        0,
    )

    @property
    def promise(self) -> AlarmRate:
        """The run's own false-alarm rate as a promise."""
        return AlarmRate(self.rate, EPISODE)

    @cached_property
    def visible(self) -> dict[Kind, bool]:
        """Whether the ideal observer could detect each kind and severity."""
        return visible_kinds(self.detectability)

    def bound(self, kinds: Collection[Kind]) -> Bound:
        """Return what the ideal observer detects of these kinds."""
        return Bound.of([d for d in self.detectability if (d.kind, d.severity) in kinds], self.rate)

    @cached_property
    def on_visible(self) -> list[DetectionMetrics]:
        """Each monitor on the visible kinds of fault."""
        kinds = [kind for kind, seen in self.visible.items() if seen]
        return [m.only(kinds) for m in self.monitors.values()]
