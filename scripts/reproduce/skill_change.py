"""A change of skill: does the memory of a body follow it, and does it take it for a fault?

The arm sorts a can, then a carton of milk, or the other way round. No lesson of the shipped memory held that change.
Its threshold is the one on its card. What runs is named by what it was told of episodes with one skill each; a random
forest is told the same of the same rows, and its moments add up too, so that it has what the rows say.

    right for good    from then on the name is right in every step
"""

from __future__ import annotations

import math
import sys
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray
from rich.console import Console
from sklearn.ensemble import RandomForestClassifier

from asm_gym.episodes import Episode
from asm_gym.evaluation.statistics import Share
from asm_gym.evaluation.tables import Table
from asm_gym.memory.readout import KEPT, SMALLEST
from asm_gym.monitors import NeuralASM
from asm_gym.rollouts.parallel import parallel_map
from asm_gym.rollouts.progress import stage
from asm_gym.scripts.command import at_least
from asm_gym.scripts.reproduce.common import Common, Findings, Record, demonstrations, reproduce
from asm_gym.scripts.reproduce.skill_recognition import AFTER_S, naming_figure, share_right
from asm_gym.scripts.reproduce.skill_switch import NAMES, Switch, record_switch

FOLLOWED_S = 2.0
"""An alarm so long after a change is put down to it [s]."""

TREES = 100

Right = NDArray[np.bool_]


@dataclass(frozen=True)
class Args(Common):
    """Episodes in which one skill follows another."""

    tasks: tuple[str, ...] = ("Lift", "Stack", "Door", "PickPlaceCan", "PickPlaceMilk")
    """Skills that are told apart."""
    told: int = 20
    """Episodes of each skill whose name is told."""
    nominal: int = 12
    """Other episodes of each skill."""
    switches: int = 30
    """Episodes with a change of skill."""

    def __post_init__(self) -> None:
        super().__post_init__()
        at_least(1, self, "told", "nominal", "switches")
        missing = set(NAMES.values()) - set(self.tasks)
        if missing:
            raise ValueError(f"tasks must hold those that are changed between, {', '.join(sorted(missing))} is missing")

    def scaled(self) -> Args:
        """With ``quick``, little of everything."""
        return replace(self, tasks=tuple(NAMES.values()), told=2, nominal=1, switches=1) if self.quick else self


class Named(NamedTuple):
    """In which steps one way of naming is right; (T,) for each episode, of a change those from it on."""

    nominal: list[Right]
    switched: list[Right]


def study(args: Args, console: Console, seconds: dict[str, float]) -> Findings:
    """Records, names, judges and sums up."""
    args = args.scaled()
    memory = NeuralASM.pretrained("panda")
    told = demonstrations(args, args.tasks, "fit", args.told, console, seconds)
    nominal = demonstrations(args, args.tasks, "nominal", args.nominal, console, seconds)
    with stage("changing skills", console, seconds) as progress:
        wanted = [args.out / "switches" / f"{args.seed + n}.npz" for n in range(args.switches)]
        paths = parallel_map(record_switch, wanted, args.workers, progress)
    switches = [Switch.read(path, memory.spec) for path in paths]
    with stage("naming", console, seconds):
        named = {"memory of the body": by_memory(memory, told, nominal, switches)}
        named["random forest on the rows"] = by_forest(told, nominal, switches, args.seed)
    with stage("judging", console, seconds):
        records = alarms(memory, nominal, switches)
    dt = nominal[0].spec.dt
    tables = [alarms_table(records), *named_tables(named, dt)]
    return Findings(records, tables, _drawn(named, dt), {"threshold": memory.threshold})


def by_memory(
    memory: NeuralASM, told: Sequence[Episode], nominal: Sequence[Episode], switches: Sequence[Switch]
) -> Named:
    """What a memory names that is told these skills; surprise and weights do not depend on it."""
    memory.name_skills(told)
    switched = [(memory.skills(s.episode.stream) == s.skills)[s.changed :] for s in switches]
    return Named([memory.skills(e.stream) == e.info["skill"] for e in nominal], switched)


def by_forest(told: Sequence[Episode], nominal: Sequence[Episode], switches: Sequence[Switch], seed: int) -> Named:
    """The same by a random forest, whose moments add up as those of the memory do."""
    names = np.repeat([str(e.info["skill"]) for e in told], [len(e) for e in told])
    forest = RandomForestClassifier(TREES, min_samples_leaf=5, class_weight="balanced", random_state=seed, n_jobs=1)
    forest.fit(np.concatenate([e.stream for e in told]), names)

    def skills(episode: Episode) -> NDArray[np.str_]:
        total, found = np.zeros(len(forest.classes_)), []
        for moment in np.log(forest.predict_proba(episode.stream) + SMALLEST):
            total = KEPT * total + moment
            found.append(forest.classes_[total.argmax()])
        return np.array(found)

    switched = [(skills(s.episode) == s.skills)[s.changed :] for s in switches]
    return Named([skills(e) == e.info["skill"] for e in nominal], switched)


def alarms(memory: NeuralASM, nominal: Sequence[Episode], switches: Sequence[Switch]) -> list[Record]:
    """When surprise passes the memory's own threshold: a record for each episode."""

    def over(episode: Episode) -> Right:
        return np.asarray(memory.score(episode).value > memory.threshold)

    records: list[Record] = [
        {"kind": e.info["skill"], "seed": n, "alarm": bool(over(e).any())} for n, e in enumerate(nominal)
    ]
    for number, s in enumerate(switches):
        found, until = over(s.episode), s.changed + round(FOLLOWED_S / s.episode.spec.dt)
        after = bool(found[s.changed : until].any())
        records.append({"kind": "change", "seed": number, "alarm": bool(found.any()), "after_change": after})
    return records


def alarms_table(records: Sequence[Record]) -> Table:
    """By kind of episode."""

    def row(name: str, outcomes: Sequence[bool]) -> tuple[str, ...]:
        share = Share.of(outcomes)
        low, high = share.interval
        return (name, f"{share.k} of {share.n}", f"{100 * low:.0f} to {100 * high:.0f}")

    changes = [r for r in records if r["kind"] == "change"]
    rows = [row(k, [r["alarm"] for r in records if r["kind"] == k]) for k in dict.fromkeys(r["kind"] for r in records)]
    rows.append(row(f"change, alarm in the {FOLLOWED_S:g} s after it", [r["after_change"] for r in changes]))
    return Table("Episodes with an alarm, at the threshold of the card.", ("", "alarms", "95 % interval [%]"), rows)


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
            [(name, *cells(found.nominal)) for name, found in named.items()],
        ),
        Table(
            "Right skill named so long after a change [% of episodes], and until it is right for good, median [s].",
            (*heads, "for good"),
            [row(name, found) for name, found in named.items()],
        ),
    ]


def for_good(right: Right, dt: float) -> float:
    """Seconds until it is right in every step that follows; infinite where it is wrong in the last."""
    wrong = np.flatnonzero(~right)
    first = int(wrong[-1]) + 1 if len(wrong) else 0
    return first * dt if first < len(right) else math.inf


def _drawn(named: dict[str, Named], dt: float) -> Figure:
    return naming_figure({f"{name}, after a change": found.switched for name, found in named.items()}, dt)


def main(argv: list[str] | None = None) -> int:
    """Asks, and returns the exit code."""
    return reproduce("skill_change", study, Args, __doc__, argv)


if __name__ == "__main__":
    sys.exit(main())
