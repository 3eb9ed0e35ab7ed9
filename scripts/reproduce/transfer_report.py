"""Tables and the figure of ``asm-gym reproduce transfer``, from its records."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from asm_gym.evaluation.figures import figure, look
from asm_gym.evaluation.statistics import Share
from asm_gym.evaluation.tables import Table, count
from asm_gym.scripts.reproduce.kit import Record


def chosen(records: Sequence[Record], **where: Any) -> list[Record]:
    """Those that are as ``where`` says; of a tuple, any of it."""
    return [r for r in records if all(r.get(k) in (v if isinstance(v, tuple) else (v,)) for k, v in where.items())]


def alarmed(records: Sequence[Record], **where: Any) -> Share:
    """Healthy episodes with an alarm."""
    return Share.of([r["alarms"] > 0 for r in chosen(records, **where) if "alarms" in r])


def per_hour(records: Sequence[Record], **where: Any) -> str:
    """Alarms in an hour of healthy episodes; empty where there are none."""
    healthy = [r for r in chosen(records, **where) if "alarms" in r]
    hours = sum(r["hours"] for r in healthy)
    return f"{sum(r['alarms'] for r in healthy) / hours:.0f}" if hours else ""


def detection(records: Sequence[Record], **where: Any) -> tuple[str, str]:
    """AUROC and faults found; empty where there are none."""
    faulty = [r for r in chosen(records, **where) if "found" in r]
    if not faulty:
        return "", ""
    ranked = [r["auroc"] for r in faulty if r["auroc"] is not None]
    return f"{np.mean(ranked):.3f}", f"{100 * np.mean([r['found'] for r in faulty]):.0f} % of {len(faulty)}"


def cell(share: Share) -> str:
    """``k of n``; empty where there is nothing."""
    return count(share) if share.n else ""


def memories(records: Sequence[Record]) -> list[str]:
    """Their names, in order."""
    return list(dict.fromkeys(r["memory"] for r in records))


def tables(records: Sequence[Record], senses: Sequence[Record], config: Any) -> list[Table]:
    """By memory, by policy, by what is found, and by what the stream lacks."""
    groups = list(dict.fromkeys(r["group"] for r in records))
    rate = f"thresholds for {100 * config.false_alarm_rate:g} % of healthy episodes"
    rows = [
        (
            name,
            *(cell(alarmed(records, memory=name, group=g, solved=True)) for g in groups),
            cell(alarmed(records, memory=name, solved=False)),
            per_hour(records, memory=name, group=tuple(groups[1:]), solved=True),
            *detection(records, memory=name),
        )
        for name in memories(records)
    ]
    heads = ("memory", *groups, "failed ones", "per hour", "AUROC", "found")
    made = [
        Table(
            f"Healthy episodes with an alarm, apart those that solved the task, by what the memory of the body met, "
            f"and those that failed; alarms in an hour of solved episodes of what it never met; AUROC against the same "
            f"steps of healthy episodes, and faults found within {config.window:g} s, of medium and strong severity "
            f"that an ideal observer could see; {rate}. The first memory is of the experts, all others learned from "
            f"babbling, the shipped one from more of it, at a rate of its own. +evidence: under our detection.",
            heads,
            rows,
        )
    ]
    ours = [name for name in memories(records) if "of " in name]
    rows = [
        (watched, *(cell(alarmed(records, memory=name, watched=watched, solved=True)) for name in ours))
        for watched in dict.fromkeys(r["watched"] for r in records)
    ]
    made.append(Table("Solved episodes with an alarm, by policy", ("watched", *ours), rows))
    rows = [
        (
            name.removeprefix("without "),
            cell(alarmed(senses, memory=name, solved=True)),
            *detection(senses, memory=name),
        )
        for name in memories(senses)
    ]
    text = (
        "The memory of the body on streams that lack senses, at the threshold that was set with all of them: solved "
        "episodes of all policies with an alarm, AUROC and faults found, but for those that show only in what is gone."
    )
    made.append(Table(text, ("the stream lacks", "alarms", "AUROC", "found"), rows))
    return made


def drawn(records: Sequence[Record]) -> Figure:
    """Faults found against healthy episodes with an alarm, a point for each memory."""
    with figure(height=4.2, width=9) as fig:
        ax = fig.subplots()
        for i, name in enumerate(memories(records)):
            faulty = [r["found"] for r in chosen(records, memory=name) if "found" in r]
            share = alarmed(records, memory=name, solved=True)
            if not faulty or not share.n:
                continue
            colour, _, marker = look(i)
            ax.errorbar(
                100 * share.value,
                100 * float(np.mean(faulty)),
                xerr=100 * np.abs(np.array(share.interval)[:, None] - share.value),
                color=colour,
                marker=marker,
                linestyle="none",
                elinewidth=0.7,
                label=name,
            )
        ax.set(xlabel="solved healthy episodes with an alarm [%]", ylabel="faults found [%]", ylim=(0, 100))
        ax.set_xlim(left=0)
        fig.legend(loc="outside right upper", fontsize=8)
    return fig
