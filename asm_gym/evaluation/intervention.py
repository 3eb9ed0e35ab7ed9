"""What acting on alarms is worth: the policy alone against a reflex, paired by seed. Pure functions."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from asm_gym.evaluation.scored import InterventionOutcome, ScoredEpisode
from asm_gym.evaluation.statistics import Estimate, Floats, Share, bootstrap, gain, reduction


@dataclass(frozen=True)
class Comparison:
    """A reflex against the policy alone, over the seeds they share.

    Args:
        kind, acting: which.
        success, alone: episodes solved, with the reflex and by the policy alone.
        gained: difference of the two shares.
        peak, impulse: how much smaller on average, as a share of what the policy alone suffered.
        alarm_s: mean time in alarm [s].
        ended: episodes that the wrapper ended.
        median_delay_ms: from the onset; NaN where there was none.
    """

    kind: str
    acting: str
    success: Share
    alone: Share
    gained: Estimate
    peak: Estimate
    impulse: Estimate
    alarm_s: float
    ended: Share
    median_delay_ms: float


def compare(alone: Sequence[ScoredEpisode], acted: Sequence[ScoredEpisode], seed: int = 0) -> Comparison:
    """One reflex under one fault.

    Args:
        alone, acted: of the same tasks and seeds, in any order.
        seed: of the resampling.

    Raises:
        ValueError: they are not pairs.
    """
    first, second = ({(t.task, t.seed): t.outcome for t in traces} for traces in (alone, acted))
    if first.keys() != second.keys() or not first:
        raise ValueError("every episode of the reflex needs its twin with the policy alone")

    def pairs(measured: Callable[[InterventionOutcome], float]) -> Floats:
        return np.array([[float(measured(one[k])) for one in (first, second)] for k in first])

    rng = np.random.default_rng(seed)
    delays = sorted(math.inf if t.delay is None else 1e3 * t.delay for t in acted)
    return Comparison(
        kind=acted[0].kind,
        acting=acted[0].acting,
        success=Share.of([t.outcome.success for t in acted]),
        alone=Share.of([t.outcome.success for t in alone]),
        gained=bootstrap(gain, pairs(lambda o: o.success), rng),
        peak=bootstrap(reduction, pairs(lambda o: o.external_force), rng),
        impulse=bootstrap(reduction, pairs(lambda o: o.impulse), rng),
        alarm_s=float(np.mean([t.alarm.sum() * t.dt for t in acted])),
        ended=Share.of([t.outcome.ended_by_alarm for t in acted]),
        median_delay_ms=delays[(len(delays) - 1) // 2],
    )


@dataclass(frozen=True)
class IdealShare:
    """How much of what the ideal reflex gains over the policy alone a reflex gains: 0 for nothing, 1 for all.

    NaN where the ideal reflex gains nothing.
    """

    success: float
    peak: float
    impulse: float


def share_of_ideal(
    alone: Sequence[ScoredEpisode], acted: Sequence[ScoredEpisode], ideal: Sequence[ScoredEpisode]
) -> IdealShare:
    """Of sums over all episodes, within [0, 1].

    Raises:
        ValueError: they are not of the same tasks and seeds.
    """
    told = [{(t.task, t.seed): t.outcome for t in traces} for traces in (alone, acted, ideal)]
    if not told[0] or any(outcomes.keys() != told[0].keys() for outcomes in told):
        raise ValueError("every episode of the reflex needs its twins with the policy alone and the ideal reflex")

    def share(measured: Callable[[InterventionOutcome], float]) -> float:
        none, some, most = (float(np.nansum([measured(o) for o in outcomes.values()])) for outcomes in told)
        return float(np.clip((some - none) / (most - none), 0.0, 1.0)) if most != none else math.nan

    def gained(measured: Callable[[InterventionOutcome], float], sign: float) -> float:
        none, most = (sum(sign * measured(o) for o in outcomes.values()) for outcomes in (told[0], told[2]))
        return share(measured) if most > none else math.nan

    return IdealShare(
        gained(lambda o: float(o.success), 1.0),
        gained(lambda o: o.external_force, -1.0),
        gained(lambda o: o.impulse, -1.0),
    )
