"""Telling causes apart: a read-out of where surprise is and of what explains it, asked for what it never saw.

Learns from the faulty episodes of an evaluation, in the rows in which a memory is in alarm, and is asked for episodes
of other seeds, and for kinds of faults that were left out. Writes the read-out that learned from all beside the table,
as ``causes.json``; ``asm_gym/monitors/causes.json`` is such a file.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from asm_gym.episode import Episode, load_episode
from asm_gym.evaluation.recordings import files_in
from asm_gym.evaluation.tables import Table
from asm_gym.monitors import NeuralASM
from asm_gym.monitors.diagnosis import CLASSES, FAMILIES, WINDOW, Diagnosis, Hypothesis, Readout, averaged
from asm_gym.scripts.options import option
from asm_gym.scripts.reproduce import kit
from asm_gym.scripts.reproduce.kit import Findings, Record
from asm_gym.scripts.reproduce.reliability import Reliability, reliability
from asm_gym.tasks import task as task_spec
from asm_gym.wrappers.responses import SURE

KINDS_OF = {
    "sensor": ("backlash", "encoder_", "frozen_encoder"),
    "force sensor": ("wrist_bias", "frozen_wrist"),
    "torque sensor": ("torque_scale",),
    "contact": ("push", "payload", "collision", "cable_pull", "held_by_person"),
    "joint": ("weak_joint", "stuck_joint", "joint_friction"),
    "gripper": ("gripper_opens", "weak_gripper"),
    "command": ("action_", "sign_flip", "adversary"),
    "object": ("slip", "snatch", "teleport", "heavy_object", "missing_object"),
}
"""Which kinds of faults each class has, by how their names begin; harmless variations are unknown. Backlash is a
joint's, and looks like its encoder's, which is what can be completed."""

SEEDS_OUT, KINDS_OUT = "seeds", "kinds"
"""What was left out."""

ROWS, HARMLESS_ROWS = 14, 4
"""Rows learned from of a faulty and of a harmless episode, at most: the first in alarm, the most surprising."""

SHRINKAGE, STEPS, RATE = 1e-3, 1500, 2.0

FOLDS = 3
"""So many times a part of the seeds is left out."""

BINS = (SURE, 0.6, 0.7, 0.8, 0.9, 0.95, 1.0)
"""Of the probabilities that are stated."""


@dataclass(frozen=True)
class Config(kit.Config):
    """Families of causes that are told apart, of kinds of faults that were left out."""

    seeds: int = option(1, least=1)
    """It learns once."""
    run: Path = option(Path("runs/evaluate"), metavar="FOLDER")
    """Folder of an evaluation, whose faulty episodes are learned from."""
    memory: Path | None = option(None)
    """A calibrated memory; by default the one that ships with the Panda."""
    tasks: tuple[str, ...] = option(("Lift", "Stack", "Door"), check=task_spec, metavar="TASK")
    """Names of tasks."""


class Examples(NamedTuple):
    """N rows in alarm, those of an episode side by side and in order."""

    evidence: NDArray[np.float64]  # (N, F)
    classes: NDArray[np.intp]  # (N,)
    kinds: NDArray[np.str_]  # (N,)
    episodes: NDArray[np.intp]  # (N,)
    folds: NDArray[np.intp]  # (N,) episodes of one seed are left out together
    located: NDArray[np.bool_]  # (N, C) whether what a class would name is where the fault is

    def of(self, chosen: NDArray[np.bool_]) -> Examples:
        """Some of them."""
        return Examples._make(part[chosen] for part in self)

    @property
    def weight(self) -> NDArray[np.float64]:
        """(N,) every family counts alike, in it every kind, and of each every episode."""
        weight, families = np.zeros(len(self.kinds)), FAMILY[self.classes]
        for kind in np.unique(self.kinds):
            own = self.kinds == kind
            for episode in np.unique(self.episodes[own]):
                rows = own & (self.episodes == episode)
                weight[rows] = 1 / len(np.unique(self.episodes[own])) / rows.sum()
        for family in np.unique(families):
            weight[families == family] /= weight[families == family].sum()
        return weight


FAMILY = np.array([FAMILIES.index(family) for family, _ in CLASSES.values()])
"""The family of each class, by number."""


def class_of(kind: str) -> int:
    """The class of a kind of fault, by number; that of the unknown for anything else."""
    names = list(CLASSES)
    return next((names.index(c) for c, begins in KINDS_OF.items() if kind.startswith(begins)), names.index("unknown"))


def examples(memory: NeuralASM, diagnosis: Diagnosis, episodes: Sequence[Episode]) -> Examples:
    """The rows in alarm, those aside whose sensor is known to be stuck."""
    found: list[tuple[NDArray[np.float64], int, str, int, int, list[bool]]] = []
    seeds: dict[str, set[int]] = {}
    for label in (episode.labelled for episode in episodes):
        seeds.setdefault(label.task, set()).add(label.seed)
    for n, (episode, surprise) in enumerate(zip(episodes, memory.score_episodes(episodes), strict=True)):
        label = episode.labelled
        faulty = label.role == "faulty"
        onset = max(label.onset or 0, WINDOW) if faulty else WINDOW
        level = memory.threshold if faulty else 0.5 * memory.threshold
        rows = [int(t) for t in np.flatnonzero(surprise.value > level) if t >= onset]
        rows = rows[:ROWS] if faulty else sorted(rows, key=lambda t: -surprise.value[t])[:HARMLESS_ROWS]
        kind, fold = label.kind if faulty else "harmless", sorted(seeds[label.task]).index(label.seed) % FOLDS
        lifted = diagnosis.completion.lift(episode.stream)
        for t in rows:
            window, where = slice(max(0, t - WINDOW), t + 1), surprise.attribution[t]
            if not diagnosis.is_stuck(episode.stream[window], where):
                evidence, best = diagnosis.evidence(lifted[window], where)
                named = [diagnosis.named(name, evidence, best) for name in CLASSES]
                here = [h is not None and located(h, kind, label.affected_channels, diagnosis) for h in named]
                found.append((evidence, class_of(kind), kind, n, fold, here))
    return Examples._make(np.array(part) for part in zip(*found, strict=True))


def located(named: Hypothesis, kind: str, affected: frozenset[str], diagnosis: Diagnosis) -> bool:
    """Whether a part that was named has a channel that the fault changes; what becomes of a command has none."""
    if named.part == "command":
        return list(CLASSES)[class_of(kind)] == "command"
    labels = diagnosis.completion.spec.labels
    return any(labels[column] in affected for column in named.columns)


def families(readout: Readout, evidence: NDArray[np.float64]) -> NDArray[np.float64]:
    """(N, families) probabilities."""
    return np.asarray(readout(evidence) @ np.eye(len(FAMILIES))[FAMILY])


def asked(readout: Readout, rows: Examples, left_out: str, seed: int) -> list[Record]:
    """What is believed after each row, by all diagnoses of its episode so far."""
    each, records = readout(rows.evidence), list[Record]()
    belief, n, episode = np.zeros(len(FAMILIES)), 0, -1
    for i, p in enumerate(families(readout, rows.evidence)):
        if rows.episodes[i] != episode:
            belief, n, episode = np.zeros(len(FAMILIES)), 0, int(rows.episodes[i])
        n += 1
        belief = averaged(belief, p, n)
        family = int(belief.argmax())
        unknown = bool(belief[family] < SURE or family == FAMILIES.index("unknown"))
        right = bool(family == FAMILY[rows.classes[i]]) and not unknown
        which = int(np.where(family == FAMILY, each[i], -1.0).argmax())
        said = {"right": right, "unknown": unknown, "part": right and bool(rows.located[i, which]), "episode": episode}
        kind = str(rows.kinds[i])
        records.append({"seed": seed, "left_out": left_out, "kind": kind, "p": float(belief[family]), **said})
    return records


def learned(known: Examples) -> Readout:
    """By the delta rule."""
    return Readout.fit(known.evidence, known.classes, known.weight, SHRINKAGE, STEPS, RATE)


def run(config: Config) -> Findings:
    """Leaves out every kind in turn, asks for it, and learns from all in the end."""
    paths = files_in(config.run, config.tasks, "faulty", "harmless")
    if not paths:
        raise ValueError(
            f"{config.run} has no faulty recordings of {', '.join(config.tasks)}: run asm-gym evaluate first"
        )
    memory = NeuralASM.pretrained("panda") if config.memory is None else NeuralASM.load(config.memory)
    own = memory.diagnosis_
    if own is None:
        raise ValueError(f"{config.memory} knows no completion: fit it anew")
    with kit.stage("weighing"):
        known = examples(memory, own, [load_episode(path) for path in paths])
    faulty = known.kinds != "harmless"
    kinds = list(dict.fromkeys(known.kinds[faulty].tolist()))
    records: list[Record] = []
    with kit.stage("leaving seeds out"):
        for fold in range(1 if config.quick else FOLDS):
            out = known.folds == fold
            records += asked(learned(known.of(~out)), known.of(out & faulty), SEEDS_OUT, config.seed)
    with kit.stage("leaving kinds out") as tell:
        left = kinds[:: max(1, len(kinds) // 4)] if config.quick else kinds
        for n, kind in enumerate(left):
            out = known.kinds == kind
            records += asked(learned(known.of(~out)), known.of(out), KINDS_OUT, config.seed)
            tell(n + 1, len(left))
    shipped = learned(known)
    saved = {name: np.round(getattr(shipped, name), 5).tolist() for name in ("mean", "spread", "weights", "bias")}
    (config.out / "causes.json").write_text(json.dumps(saved), encoding="utf-8")
    found = {out: reliable(records, out) for out in (SEEDS_OUT, KINDS_OUT)}
    return Findings(records, [table(records, kinds), promised(found)], figure(found))


def table(records: Sequence[Record], kinds: Sequence[str]) -> Table:
    """A row for each kind, and one for all."""

    def share(mine: Sequence[Record], *names: str) -> str:
        return f"{np.mean([any(r[name] for name in names) for r in mine]):.2f}" if mine else ""

    rows = []
    for kind in (*kinds, "all"):
        of = [r for r in records if kind in (r["kind"], "all")]
        seeds, left = ([r for r in of if r["left_out"] == out] for out in (SEEDS_OUT, KINDS_OUT))
        family = "" if kind == "all" else FAMILIES[FAMILY[class_of(kind)]]
        told = share(seeds, "right"), share(seeds, "part"), share(seeds, "unknown")
        rows.append((kind.replace("_", " "), family, f"{len(seeds)}", *told, share(left, "right", "unknown")))
    return Table(
        "Rows in alarm, by what is believed after all diagnoses of the episode so far: the share of which family, and "
        "family and part, are right, and that of unknown ones, in episodes of seeds that the read-out did not learn "
        "from; and, where it did not learn from the kind at all, the share that is right or unknown. Of all: each row "
        "counts alike.",
        ("Kind", "Family", "Rows", "Family right", "and part", "Unknown", "Kind left out: right or unknown"),
        rows,
    )


def reliable(records: Sequence[Record], left_out: str) -> Reliability:
    """What is stated where a family is named, and whether it is right."""
    named = [r for r in records if r["left_out"] == left_out and not r["unknown"]]
    p, right, episodes = ([r[name] for r in named] for name in ("p", "right", "episode"))
    return reliability(np.minimum(p, 1.0), np.array(right), np.array(episodes), BINS)


def promised(found: dict[str, Reliability]) -> Table:
    """A row for each bin of what is stated."""
    rows = []
    for k, (low, high) in enumerate(pairwise(BINS)):
        told = [
            (f"{r.rows[k]}", f"{r.episodes[k]}", f"{r.stated[k]:.2f}", r.right[k].percent()) for r in found.values()
        ]
        rows.append((f"{low:g} to {high:g}", *told[0], *told[1]))
    errors = [("", "", "", r.error.percent()) for r in found.values()]
    rows.append(("calibration error", *errors[0], *errors[1]))
    one = ("Rows", "Episodes", "Mean", "Right")
    return Table(
        "What a stated probability is worth. Rows in alarm in which a family is named, by the probability of it, in "
        "episodes of seeds, and then of kinds, that the read-out did not learn from. Brackets hold 95 % bootstrap "
        "intervals over episodes. The calibration error is the mean over rows of how far the share that is right and "
        "the mean stated are apart in their bin.",
        ("Stated", *one, *(f"Kind left out: {name.lower()}" for name in one)),
        rows,
    )


def figure(found: dict[str, Reliability]) -> Figure:
    """How often it is right about what it has not learned from, by how sure it is."""
    drawn = Figure(figsize=(4, 4), layout="constrained")
    axes: Any = drawn.add_subplot()
    axes.plot([SURE, 1], [SURE, 1], color="grey", linewidth=1)
    for left_out, r in found.items():
        value, low, high = np.array(r.right).T
        axes.errorbar(r.stated, value, [value - low, high - value], marker="o", label=f"{left_out} left out")
    axes.set(xlabel="probability it gives", ylabel="share it has right")
    axes.legend()
    return drawn
