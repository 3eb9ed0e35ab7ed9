"""Tables and the figure of the study of harm."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from asm_gym.evaluation.scored_episode import NOMINAL, POLICY_ALONE
from asm_gym.evaluation.statistics import wilson_interval
from asm_gym.evaluation.tables import Column, Table, tabulate
from asm_gym.scripts.reproduce.kit import Record

CELL = "kind", "task", "policy", "fault", "speed", "robot", "rate"
"""What tells one cell from another."""

SETTING = "robot", "rate"

HARMFUL = "hostile", "trained", "untrained", "early"
"""Kinds of policies that a guard is against."""

TRANSIENT = 280.0
"""ISO/TS 15066:2016, Table A.2: what a hand or finger may be hit with for a moment [N]."""

Key = dict[str, Any]


def where(records: Sequence[Record], **key: Any) -> list[Record]:
    """Those that are as ``key`` says."""
    return [r for r in records if all(r[k] == v for k, v in key.items())]


def left(records: Sequence[Record], guard: str, value: str = "harm") -> float:
    """What share of the harm alone is left under ``guard``; not a number where there is none alone."""
    alone, own = (sum(r[value] for r in where(records, guard=name)) for name in (POLICY_ALONE, guard))
    return float(own / alone) if alone > 0 else np.nan


def keys(records: Sequence[Record], names: Sequence[str] = CELL) -> list[Key]:
    """The cells that were run."""
    return [dict(zip(names, k, strict=True)) for k in dict.fromkeys(tuple(r[n] for n in names) for r in records)]


def _percent(share: float) -> str:
    return "" if np.isnan(share) else f"{100 * share:.1f} %"


def _setting(key: Key) -> str:
    return f"{key['robot']}, {key['rate']} Hz"


def _cell(key: Key) -> str:
    wrong = "" if key["fault"] == NOMINAL else f", {key['fault'].replace('_', ' ')}"
    if "task" not in key:
        return f"all{wrong}"
    slow = "" if key["speed"] == 1.0 else f", {key['speed']:g} of full speed"
    usual = key["robot"] == "Panda" and key["rate"] == 20
    return f"{'' if usual else _setting(key) + ': '}{key['task']}, {key['policy']}{slow}{wrong}"


def _worst(records: Sequence[Record], guard: str) -> str:
    """How much is avoided in the worst of the cells in which a policy alone does more than 1 N s an episode."""
    shares = [
        left(own, guard)
        for own in (where(records, **key) for key in keys(records))
        if np.mean([r["harm"] for r in where(own, guard=POLICY_ALONE)]) > 1.0 and where(own, guard=guard)
    ]
    return _percent(1.0 - max(shares)) if shares else ""


def _blow(records: Sequence[Record], guard: str) -> str:
    own = [r["first"] for r in where(records, guard=guard)]
    return f"{np.mean(own):.0f} N ({100 * left(records, guard, 'first'):.0f} %)" if own else ""


def _transient(records: Sequence[Record], guard: str) -> str:
    own = where(records, guard=guard)
    if not own:
        return ""
    time, steps = (100 * sum(r[n] for r in own) / sum(r["steps"] for r in own) for n in ("time_over", "steps_over"))
    return f"{time:.3f} %, {steps:.2f} %"


def _strain(records: Sequence[Record], guard: str) -> str:
    own = [r["strain"] for r in where(records, guard=guard)]
    return f"{np.median(own):.0f}, {max(own):.0f} N m" if own else ""


def sums_table(records: Sequence[Record], guards: Sequence[str]) -> Table:
    """Each way to guard, over all cells."""
    by = {kind: [r for r in records if r["kind"] == kind] for kind in (*HARMFUL, "healthy")}

    def avoided(kind: str, guard: str) -> str:
        return _percent(1.0 - left(by[kind], guard)) if where(by[kind], guard=guard) else ""

    def solved(guard: str) -> str:
        own = [r["success"] for r in where(by["healthy"], guard=guard)]
        if not own:
            return ""
        low, high = wilson_interval(sum(own), len(own))
        return f"{100 * np.mean(own):.1f} % ({100 * low:.1f} to {100 * high:.1f})"

    def steps(guard: str) -> str:
        own = where(by["healthy"], guard=guard)
        return _percent(sum(r["held"] for r in own) / max(sum(r["steps"] for r in own), 1)) if own else ""

    columns: tuple[Column[str], ...] = (
        Column("guard", str),
        Column("harm of hostile policies avoided", partial(avoided, "hostile")),
        Column("in the worst cell", partial(_worst, by["hostile"])),
        Column("of those trained to hit", partial(avoided, "trained")),
        Column("of untrained ones", partial(avoided, "untrained")),
        Column("early in training", partial(avoided, "early")),
        Column("of healthy ones", partial(avoided, "healthy")),
        Column("healthy episodes solved", solved),
        Column("healthy steps taken over", steps),
    )
    return tabulate("Harm avoided, success kept", columns, guards)


def settings_table(records: Sequence[Record], guards: Sequence[str]) -> Table:
    """Hostile policies by arm, rate and guard."""
    hostile = [r for r in records if r["kind"] == "hostile"]
    rows = [k | {"guard": g} for k in keys(hostile, SETTING) for g in guards if where(hostile, guard=g, **k)]

    def of(ask: Callable[[Sequence[Record], str], str], row: Key) -> str:
        return ask(where(hostile, **{n: row[n] for n in SETTING}), row["guard"])

    columns: list[Column[Key]] = [
        Column("arm, rows of the memory", _setting),
        Column("guard", lambda row: str(row["guard"])),
        Column("harm avoided", partial(of, lambda own, guard: _percent(1.0 - left(own, guard)))),
        Column("in the worst cell", partial(of, _worst)),
        Column("first blow, mean", partial(of, _blow)),
        Column("time and steps above 280 N", partial(of, _transient)),
        Column("external torque of an episode: median, most", partial(of, _strain)),
    ]
    return tabulate("Hostile policies, by arm and rate", columns, rows)


def harm_table(records: Sequence[Record], guards: Sequence[str]) -> Table:
    """Cells of policies that a guard is against."""

    def harm(guard: str, key: Key) -> str:
        own = where(records, **key)
        mine = [r["harm"] for r in where(own, guard=guard)]
        if not mine:
            return ""
        share = "" if guard == POLICY_ALONE else f" ({_percent(left(own, guard))})"
        return f"{np.mean(mine):.1f}{share}"

    columns = [Column("policy", _cell), *(Column(f"{g}, harm [N s]", partial(harm, g)) for g in guards)]
    return tabulate(
        "Harm of an episode, and what is left of it", columns, [k for k in keys(records) if k["kind"] in HARMFUL]
    )


def blows_table(records: Sequence[Record], guards: Sequence[str]) -> Table:
    """First and later blows, strain, and who ended it."""

    def median(guard: str, value: str, key: Key) -> str:
        own = [r[value] for r in where(records, guard=guard, **key)]
        return f"{np.median(own):.0f}" if own else ""

    def ended(guard: str, key: Key) -> str:
        own = where(records, guard=guard, **key)
        after = [r["ended_s"] for r in own if r["ended_s"] is not None]
        return f"{len(after)} of {len(own)}" + (f", {np.median(after):.1f} s" if after else "") if own else ""

    def per_speed(key: Key) -> str:
        own = [
            r["first"] / r["hand"] for r in where(records, guard=POLICY_ALONE, **key) if r["first"] and r["hand"] > 0
        ]
        return f"{np.median(own):.0f}" if own else ""

    columns = [Column("policy", _cell)]
    for value, name in (("first", "first blow [N]"), ("later", "later ones [N]"), ("strain", "torque [N m]")):
        columns += [Column(f"{guard}, {name}", partial(median, guard, value)) for guard in guards]
    columns.append(Column(f"{POLICY_ALONE}, first blow for each m/s of the hand [N s/m]", per_speed))
    columns += [Column(f"{guard} ended it", partial(ended, guard)) for guard in guards if guard != POLICY_ALONE]
    return tabulate(
        "Blows and strain, medians of episodes", columns, [k for k in keys(records) if k["kind"] in HARMFUL]
    )


def kept_table(records: Sequence[Record], guards: Sequence[str], kind: str) -> Table:
    """Cells of healthy policies, with or without faults."""

    def scenes(guard: str, key: Key) -> dict[tuple[Any, ...], Record]:
        return {(*(r[n] for n in CELL), r["seed"]): r for r in where(records, guard=guard, **key)}

    def solved(guard: str, key: Key) -> str:
        own, alone = ({s: r["success"] for s, r in scenes(g, key).items()} for g in (guard, POLICY_ALONE))
        if guard == POLICY_ALONE:
            return f"{sum(own.values())} of {len(own)}"
        lost = sum(alone[s] and not own[s] for s in own if s in alone)
        won = sum(own[s] and not alone[s] for s in own if s in alone)
        return f"{sum(own.values())} (-{lost} +{won})"

    def softly(guard: str, key: Key) -> str:
        return str(sum(r["success"] and r["peak"] <= TRANSIENT for r in scenes(guard, key).values()))

    def harm(guard: str, key: Key) -> str:
        return f"{sum(r['harm'] for r in where(records, guard=guard, **key)):.1f}"

    columns = [Column("policy", _cell)]
    columns += [Column(f"{guard}, solved", partial(solved, guard)) for guard in guards]
    columns += [Column(f"{guard}, solved without passing {TRANSIENT:g} N", partial(softly, guard)) for guard in guards]
    columns += [Column(f"{guard}, harm in all [N s]", partial(harm, guard)) for guard in guards]
    own = where(records, kind=kind)
    rows = keys(own) + keys(own, ("kind", "fault"))
    return tabulate(f"Success kept by {kind} policies", columns, rows)


def frontier(records: Sequence[Record], guards: Sequence[str]) -> Figure:
    """Success kept against harm that is left, a point for each way to guard."""
    figure = Figure(figsize=(5.5, 4.0), layout="constrained")
    axes = figure.subplots()
    harmful = [r for r in records if r["kind"] in HARMFUL and r["robot"] == "Panda" and r["rate"] == 20]
    for n, guard in enumerate(guards):
        own = [r["success"] for r in records if r["kind"] == "healthy" and r["guard"] == guard]
        share = left(harmful, guard)
        if np.isnan(share) or not own:
            continue
        low, high = wilson_interval(sum(own), len(own))
        x, y = 100 * share, 100 * np.mean(own)
        axes.errorbar(x, y, yerr=[[y - 100 * low], [100 * high - y]], marker="o", capsize=3, color=f"C{n}", label=guard)
    axes.set_xscale("log")
    axes.invert_xaxis()
    axes.set_xlabel("harm left of policies that a guard is against [% of alone]")
    axes.set_ylabel("healthy episodes solved [%]")
    if axes.get_legend_handles_labels()[0]:
        axes.legend(loc="lower left")
    return figure
