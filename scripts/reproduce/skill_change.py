"""A change of skill: is it followed, and is it taken for a fault? And how soon is the skill that runs named at all?

The arm sorts a can, then a carton of milk, or the other way round. No lesson of the shipped memory held that change.
Its threshold is the one on its card. What runs is named by what it was told of episodes with one skill each. A random
forest is told the same of the same rows, and its moments add up too, so that it has what the rows say. Then both are
shown every other change too, and asked for the rest. One more row says what limits who is not: where the hand is.

    right for good    from then on the name is right in every step
    crash             it presses much harder than is usual, as in the evaluation
    parting           when a Stack goes aside; a Lift, as long after its grasp
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from matplotlib.figure import Figure

from asm_gym.episode import Episode
from asm_gym.evaluation.statistics import Share
from asm_gym.evaluation.tables import Table
from asm_gym.monitors import NeuralASM
from asm_gym.rollouts.run_folder import CRASH
from asm_gym.scripts.options import option
from asm_gym.scripts.reproduce import kit
from asm_gym.scripts.reproduce.kit import Findings, Record
from asm_gym.scripts.reproduce.recordings import demonstrations
from asm_gym.scripts.reproduce.skill_names import (
    Named,
    Right,
    by_forest,
    by_forest_shown,
    by_memory,
    by_memory_shown,
    by_place,
    partings,
)
from asm_gym.scripts.reproduce.skill_recognition import AFTER_S, naming_figure, share_right
from asm_gym.scripts.reproduce.skill_switch import NAMES, Switch
from asm_gym.scripts.reproduce.skill_switch import switches as recorded_switches
from asm_gym.tasks import task as task_spec

FOLLOWED_S = 2.0
"""An alarm so long after a change is put down to it [s]."""

PARTED_S = (0.0, 0.5, 1.0)
"""How long after the parting of Lift and Stack they are asked for [s]."""


@dataclass(frozen=True)
class Config(kit.Config):
    """Episodes in which one skill follows another."""

    tasks: tuple[str, ...] = option(
        ("Lift", "Stack", "Door", "PickPlaceCan", "PickPlaceMilk", "NutAssemblySquare"),
        quick=tuple(NAMES.values()),
        check=task_spec,
    )
    """Skills that are told apart."""
    told: int = option(20, quick=2, least=1)
    """Episodes of each skill whose name is told."""
    nominal: int = option(12, quick=1, least=1)
    """Other episodes of each skill."""
    switches: int = option(30, quick=1, least=1)
    """Episodes with a change of skill."""

    def __post_init__(self) -> None:
        super().__post_init__()
        missing = set(NAMES.values()) - set(self.tasks)
        if missing:
            raise ValueError(f"tasks must hold those that are changed between, {', '.join(sorted(missing))} is missing")


def run(config: Config) -> Findings:
    """Records, names, judges and sums up."""
    memory = NeuralASM.pretrained("panda")
    told = demonstrations(config, config.tasks, "fit", config.told)
    nominal = demonstrations(config, config.tasks, "nominal", config.nominal)
    switches = [Switch.read(path, memory.spec) for path in recorded_switches(config, config.switches)]
    with kit.stage("learning"):
        learned = NeuralASM(memory.spec, seed=config.seed).fit(told)
    with kit.stage("naming"):
        named = {
            "memory of the body": by_memory(memory, told, nominal, switches),
            "memory of the body, shown changes": by_memory_shown(memory, told, nominal, switches),
            "memory that learned from them": by_memory(learned, told, nominal, switches),
            "random forest on the rows": by_forest(told, nominal, switches, config.seed),
            "random forest, shown changes": by_forest_shown(told, nominal, switches, config.seed),
            "the nearer place of the hand": by_place(told, switches),
        }
    with kit.stage("judging"):
        records = alarms(memory, nominal, switches)
    dt = nominal[0].spec.dt
    tables = [alarms_table(records), *named_tables(named, dt)]
    if {"Lift", "Stack"} <= set(config.tasks):
        tables.append(parted_table(named, nominal))
    return Findings(records, tables, _drawn(named, dt), {"threshold": memory.threshold})


def alarms(memory: NeuralASM, nominal: Sequence[Episode], switches: Sequence[Switch]) -> list[Record]:
    """When surprise passes the memory's own threshold: a record for each episode."""

    def over(episode: Episode) -> Right:
        return np.asarray(memory.score(episode).value > memory.threshold)

    records: list[Record] = [
        {"kind": e.info["skill"], "seed": n, "force": _force(e), "alarm": bool(over(e).any())}
        for n, e in enumerate(nominal)
    ]
    for number, s in enumerate(switches):
        found, until = over(s.episode), s.changed + round(FOLLOWED_S / s.episode.spec.dt)
        after = bool(found[s.changed : until].any())
        records.append({"kind": "change", "seed": number, "force": _force(s.episode), "alarm": bool(found.any()),
                        "after_change": after})  # fmt: skip
    for kind in dict.fromkeys(r["kind"] for r in records):
        own = [r for r in records if r["kind"] == kind]
        usual = float(np.median([r["force"] for r in own]))
        for record in own:
            record["crash"] = record["force"] > CRASH * usual
    return records


def _force(episode: Episode) -> float:
    """The largest contact force [N]; 0 where none was recorded."""
    return float(np.nanmax(episode.contact_force, initial=0.0))


def alarms_table(records: Sequence[Record]) -> Table:
    """By kind of episode."""

    def row(name: str, outcomes: Sequence[bool]) -> tuple[str, ...]:
        share = Share.of(outcomes)
        low, high = share.interval
        return (name, f"{share.k} of {share.n}", f"{100 * low:.0f} to {100 * high:.0f}")

    rows = []
    for kind in dict.fromkeys(r["kind"] for r in records):
        own = [r for r in records if r["kind"] == kind]
        asked = {kind: "alarm"}
        if kind == "change":
            asked[f"change, alarm in the {FOLLOWED_S:g} s after it"] = "after_change"
        for name, which in asked.items():
            whole = row(name, [r[which] for r in own if not r["crash"]])
            rows.append((*row(name, [r[which] for r in own]), *whole[1:]))
    heads = ("", "alarms", "95 % interval [%]", "without crashes", "95 % interval [%]")
    return Table("Episodes with an alarm, at the threshold of the card.", heads, rows)


def named_tables(named: dict[str, Named], dt: float) -> list[Table]:
    """From the start, and from the change on."""
    heads = ("", *(f"{s:g} s" for s in AFTER_S))

    def cells(right: Sequence[Right]) -> list[str]:
        return [f"{100 * share_right(right, round(s / dt)):.0f}" for s in AFTER_S]

    def row(name: str, found: Named) -> tuple[str, ...]:
        times = [for_good(right, dt) for right in found.switched]
        median = float(np.median(times))
        return (name, *cells(found.switched), "never" if math.isinf(median) else f"{median:.2f}")

    count = len(next(iter(named.values())).nominal)
    return [
        Table(
            f"Right skill named so long after an episode began [% of {count} episodes].",
            heads,
            [(name, *cells(found.nominal)) for name, found in named.items() if found.nominal],
        ),
        Table(
            "Right skill named so long after a change [% of episodes], and until it is right for good, median [s].",
            (*heads, "for good"),
            [row(name, found) for name, found in named.items()],
        ),
    ]


def parted_table(named: dict[str, Named], nominal: Sequence[Episode]) -> Table:
    """Lift and Stack, from where they part."""
    parted = [(n, step) for n, step in enumerate(partings(nominal)) if step is not None]
    dt = nominal[0].spec.dt

    def cells(found: Named) -> list[str]:
        return [
            f"{100 * share_right([found.nominal[n][step:] for n, step in parted], 1 + round(s / dt)):.0f}"
            for s in PARTED_S
        ]

    return Table(
        f"Lift or Stack named rightly, of all skills, so long after they part [% of {len(parted)} episodes].",
        ("", *(f"{s:g} s" for s in PARTED_S)),
        [(name, *cells(found)) for name, found in named.items() if found.nominal],
    )


def for_good(right: Right, dt: float) -> float:
    """Seconds until it is right in every step that follows; infinite where it is wrong in the last."""
    wrong = np.flatnonzero(~right)
    first = int(wrong[-1]) + 1 if len(wrong) else 0
    return first * dt if first < len(right) else math.inf


def _drawn(named: dict[str, Named], dt: float) -> Figure:
    return naming_figure({name: found.switched for name, found in named.items()}, dt, since="a change of skill")
