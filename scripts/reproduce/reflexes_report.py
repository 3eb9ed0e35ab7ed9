"""What became of reflexes: each against the policy alone, and the table of them."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import asdict
from typing import Any, NamedTuple, Protocol

from asm_gym.evaluation.contact import within_limits
from asm_gym.evaluation.intervention import Comparison, IdealShare, compare, share_of_ideal
from asm_gym.evaluation.scored import IDEAL, NOMINAL, POLICY_ALONE, ScoredEpisode
from asm_gym.evaluation.statistics import Share
from asm_gym.evaluation.tables import Table


class Asked(Protocol):
    """What was asked for: see the arguments of ``asm-gym react``."""

    @property
    def tasks(self) -> tuple[str, ...]: ...

    @property
    def policy(self) -> str: ...

    @property
    def reflexes(self) -> tuple[str, ...]: ...

    @property
    def faults(self) -> tuple[str, ...]: ...

    @property
    def episodes(self) -> int: ...

    @property
    def region(self) -> str: ...

    @property
    def seed(self) -> int: ...


class Measured(NamedTuple):
    """What became of one reflex under one fault, over all tasks."""

    comparison: Comparison
    ideal: IdealShare
    harmless: Share  # contacts within the limits
    settled: Share  # episodes that were solved, or ended by the wrapper
    named: Counter[str]  # families of causes at the first alarm


def comparisons(traces: Sequence[ScoredEpisode], args: Asked) -> list[Measured]:
    """Each reflex under each fault, over all tasks."""

    def of(fault: str, acting: str) -> list[ScoredEpisode]:
        return [t for t in traces if (t.kind, t.acting) == (fault, acting)]

    def measured(fault: str, reflex: str) -> Measured:
        alone, acted = of(fault, POLICY_ALONE), of(fault, reflex)
        ideal = share_of_ideal(alone, acted, of(fault, IDEAL))
        named = Counter(t.outcome.cause for t in acted if t.outcome.cause)
        contacts = within_limits([t.outcome.contact for t in acted], args.region)
        settled = Share.of([t.outcome.success or t.outcome.ended_by_alarm for t in acted])
        return Measured(compare(alone, acted, args.seed), ideal, contacts, settled, named)

    return [measured(fault, reflex) for fault in args.faults for reflex in (*args.reflexes, IDEAL)]


def table(found: Sequence[Measured], args: Asked) -> Table:
    """A row for each fault and reflex."""
    headings = (
        *("Fault", "Reflex", "Success", "alone", "gained", "Peak force less by", "Impulse less by"),
        *("Of the ideal reflex's", "Within limits", "Solved or ended", "Median delay [ms]", "Cause named"),
    )
    rows = [
        (
            c.kind.replace("_", " "),
            c.acting,
            f"{100 * c.success.value:.0f} %",
            f"{100 * c.alone.value:.0f} %",
            c.gained.percent(),
            c.peak.percent() if c.kind != NOMINAL else "",
            c.impulse.percent() if c.kind != NOMINAL else "",
            " / ".join("" if math.isnan(share) else f"{share:.2f}" for share in asdict(m.ideal).values()),
            f"{m.harmless.k} of {m.harmless.n}",
            f"{m.settled.k} of {m.settled.n}",
            "" if c.kind == NOMINAL else f"{c.median_delay_ms:.0f}" if math.isfinite(c.median_delay_ms) else "missed",
            ", ".join(f"{family} {n}" for family, n in m.named.most_common(3)),
        )
        for m in found
        for c in (m.comparison,)
    ]
    return Table(
        f"Reflexes against the policy alone, paired by seed. {args.episodes} episodes of each of "
        f"{', '.join(args.tasks)}, {args.policy}. Force is that on the arm from outside while the fault lasts. "
        "Brackets hold 95 % bootstrap intervals. The ideal reflex is told of the fault. It stays from the first "
        "physics substep of a contact to its end, and its senses are never at fault. Shares of what it gains are of "
        "success / peak / impulse, from the policy alone (0) to it (1). Within limits: contacts under the forces of "
        "ISO/TS 15066 for "
        f"the {args.region}, which is no claim of conformity.",
        headings,
        rows,
    )


def row(trace: ScoredEpisode) -> dict[str, Any]:
    """An episode as it is written down."""
    return {
        "task": trace.task,
        "fault": trace.kind,
        "acting": trace.acting,
        "seed": trace.seed,
        "success": trace.outcome.success,
        "peak_force": trace.outcome.external_force,
        "impulse": trace.outcome.impulse,
        "alarm_s": float(trace.alarm.sum() * trace.dt),
        "acted_s": trace.outcome.acted_s,
        "delay_ms": None if trace.delay is None else 1e3 * trace.delay,
        "ended": trace.outcome.ended_by_alarm,
        "contact": list(trace.outcome.contact),
        "cause": trace.outcome.cause,
        "part": trace.outcome.part,
    }
