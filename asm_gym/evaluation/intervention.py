"""What acting on alarms is worth: the policy alone against a reflex, paired by seed. Pure functions."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from asm_gym.evaluation.metrics import Share

Floats = NDArray[np.floating[Any]]

RESAMPLES = 2000


@dataclass(frozen=True)
class Reaction:
    """One closed-loop episode.

    Args:
        task, fault, acting: which; ``fault`` is ``"nominal"`` where there was none.
        seed: two that differ in nothing but ``acting`` share it.
        success: the task was solved at some step.
        peak_force: the largest external force on an arm since the onset [N].
        impulse: its time integral since the onset [N s].
        alarm_s: time in alarm [s].
        acted_s: time in which the reflex acted [s].
        delay_ms: from the onset to the first alarm raised since; infinite without one.
        ended: the wrapper ended the episode.
    """

    task: str
    fault: str
    acting: str
    seed: int
    success: bool
    peak_force: float
    impulse: float
    alarm_s: float
    acted_s: float
    delay_ms: float
    ended: bool


class Estimate(NamedTuple):
    """A number and its 95 % bootstrap interval."""

    value: float
    low: float
    high: float


@dataclass(frozen=True)
class Comparison:
    """A reflex against the policy alone, over the seeds they share.

    Args:
        fault, acting: which.
        success, alone: episodes solved, with the reflex and by the policy alone.
        gained: difference of the two shares.
        peak, impulse: how much smaller on average, as a share of what the policy alone suffered.
        alarm_s: mean time in alarm [s].
        ended: episodes that the wrapper ended.
        median_delay_ms: from the onset; NaN where there was none.
    """

    fault: str
    acting: str
    success: Share
    alone: Share
    gained: Estimate
    peak: Estimate
    impulse: Estimate
    alarm_s: float
    ended: Share
    median_delay_ms: float


def bootstrap(
    statistic: Callable[[Floats], Floats], pairs: Floats, rng: np.random.Generator, resamples: int = RESAMPLES
) -> Estimate:
    """Percentile interval over resampled episodes (Efron and Tibshirani 1993, ch. 13).

    Args:
        statistic: from (…, n, 2) to (…).
        pairs: (n, 2) what was measured with the policy alone, and with the reflex.
    """
    drawn = statistic(pairs[rng.integers(len(pairs), size=(resamples, len(pairs)))])
    low, high = np.nanquantile(drawn, [0.025, 0.975])
    return Estimate(float(statistic(pairs)), float(low), float(high))


def gain(pairs: Floats) -> Floats:
    """Mean difference, reflex less policy alone."""
    difference: Floats = pairs[..., 1].mean(axis=-1) - pairs[..., 0].mean(axis=-1)
    return difference


def reduction(pairs: Floats) -> Floats:
    """1 - the mean with the reflex over the mean with the policy alone; NaN where that is 0."""
    alone = pairs[..., 0].mean(axis=-1)
    with np.errstate(divide="ignore", invalid="ignore"):
        share: Floats = np.where(alone > 0, 1.0 - pairs[..., 1].mean(axis=-1) / alone, math.nan)
    return share


def compare(alone: Sequence[Reaction], reacted: Sequence[Reaction], seed: int = 0) -> Comparison:
    """One reflex under one fault.

    Args:
        alone, reacted: of the same tasks and seeds, in any order.
        seed: of the resampling.

    Raises:
        ValueError: they are not pairs.
    """
    first, second = ({(r.task, r.seed): r for r in rs} for rs in (alone, reacted))
    if first.keys() != second.keys() or not first:
        raise ValueError("every episode of the reflex needs its twin with the policy alone")

    def pairs(name: str) -> Floats:
        return np.array([[float(getattr(one[k], name)) for one in (first, second)] for k in first])

    rng = np.random.default_rng(seed)
    delays = sorted(r.delay_ms for r in reacted)
    return Comparison(
        fault=reacted[0].fault,
        acting=reacted[0].acting,
        success=Share.of([r.success for r in reacted]),
        alone=Share.of([r.success for r in alone]),
        gained=bootstrap(gain, pairs("success"), rng),
        peak=bootstrap(reduction, pairs("peak_force"), rng),
        impulse=bootstrap(reduction, pairs("impulse"), rng),
        alarm_s=float(np.mean([r.alarm_s for r in reacted])),
        ended=Share.of([r.ended for r in reacted]),
        median_delay_ms=delays[(len(delays) - 1) // 2],
    )
