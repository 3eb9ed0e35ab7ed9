"""Diagnose faults: a read-out of where surprise is and of what explains it, tested on what it never saw.

It learns from the faulty episodes of an evaluation, in the rows in which a memory is in alarm, and is tested on
episodes of other seeds, and on kinds of faults that were left out. The read-out learned from all is written beside the
table as ``causes.json``; the package ships such a file.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from asm_gym.episode import Episode, load_episode
from asm_gym.evaluation.recordings import files_in
from asm_gym.evaluation.tables import Table
from asm_gym.guard.diagnosis import SURE
from asm_gym.monitors import NeuralASM
from asm_gym.monitors.diagnosis import CLASSES, FAMILIES, WINDOW, Diagnosis, Readout, averaged
from asm_gym.scripts.options import option
from asm_gym.scripts.reproduce import kit
from asm_gym.scripts.reproduce.kit import Findings, Record, where
from asm_gym.tasks import task as task_spec

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
"""Beginnings of the names of the faults of each class; harmless variations are unknown. Backlash is a joint's, but
looks like its encoder's, which is what can be completed."""

SEEDS_OUT, KINDS_OUT = "seeds", "kinds"
ROWS, HARMLESS_ROWS = 14, 4
"""Most rows learned from a faulty episode (the first in alarm) and from a harmless one (the most surprising)."""

SHRINKAGE, STEPS, RATE = 1e-3, 1500, 2.0

FOLDS = 3
"""Parts of the seeds, each left out once."""


@dataclass(frozen=True)
class Config(kit.Config):
    """Families of causes, of kinds of faults that were left out."""

    seeds: int = option(1, least=1)
    """Not used: it learns once."""
    run: Path = option(Path("runs/evaluate"), metavar="FOLDER")
    """Folder of asm-gym evaluate, whose faulty episodes are learned from."""
    memory: Path | None = option(None)
    """A calibrated memory; the shipped one of the Panda by default."""
    tasks: tuple[str, ...] = option(("Lift", "Stack", "Door"), check=task_spec, metavar="TASK")
    """Names of tasks."""


class Examples(NamedTuple):
    """N rows in alarm; those of an episode follow one another."""

    evidence: NDArray[np.float64]  # (N, F)
    classes: NDArray[np.intp]  # (N,)
    kinds: NDArray[np.str_]  # (N,)
    episodes: NDArray[np.intp]  # (N,)
    folds: NDArray[np.intp]  # (N,) episodes of one seed are left out together

    def of(self, chosen: NDArray[np.bool_]) -> Examples:
        """Return some of the rows."""
        return Examples._make(part[chosen] for part in self)

    @property
    def weight(self) -> NDArray[np.float64]:
        """Weight of each row (N,): families count alike, kinds within a family, and episodes within a kind."""
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
"""Number of the family of each class."""


def class_of(kind: str) -> int:
    """Return the number of the class of a kind of fault; that of the unknown for any other name."""
    names = list(CLASSES)
    return next((names.index(c) for c, begins in KINDS_OF.items() if kind.startswith(begins)), names.index("unknown"))


def examples(memory: NeuralASM, diagnosis: Diagnosis, episodes: Sequence[Episode]) -> Examples:
    """Return the rows in alarm, without those in which a sensor is known to be stuck."""
    found: list[tuple[NDArray[np.float64], int, str, int, int]] = []
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
            window, blame = slice(max(0, t - WINDOW), t + 1), surprise.attribution[t]
            if not diagnosis.is_stuck(episode.stream[window], blame):
                evidence, _ = diagnosis.evidence(lifted[window], blame)
                found.append((evidence, class_of(kind), kind, n, fold))
    return Examples._make(np.array(part) for part in zip(*found, strict=True))


def families(readout: Readout, evidence: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the probability of each family (N, families)."""
    return np.asarray(readout(evidence) @ np.eye(len(FAMILIES))[FAMILY])


def asked(readout: Readout, rows: Examples, left_out: str, seed: int) -> list[Record]:
    """Return a record for each row: the belief after all diagnoses of its episode so far."""
    records = list[Record]()
    belief, n, episode = np.zeros(len(FAMILIES)), 0, -1
    for i, p in enumerate(families(readout, rows.evidence)):
        if rows.episodes[i] != episode:
            belief, n, episode = np.zeros(len(FAMILIES)), 0, int(rows.episodes[i])
        n += 1
        belief = averaged(belief, p, n)
        family = int(belief.argmax())
        unknown = bool(belief[family] < SURE or family == FAMILIES.index("unknown"))
        right = bool(family == FAMILY[rows.classes[i]]) and not unknown
        verdict = {"p": float(belief[family]), "right": right, "unknown": unknown}
        records.append({"seed": seed, "left_out": left_out, "kind": str(rows.kinds[i]), **verdict})
    return records


def learned(known: Examples) -> Readout:
    """Learn a read-out by the delta rule."""
    return Readout.fit(known.evidence, known.classes, known.weight, SHRINKAGE, STEPS, RATE)


def run(config: Config) -> Findings:
    """Leave out seeds and kinds in turn and test on them; learn from all in the end."""
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
    return Findings(records, [table(records, kinds)])


def table(records: Sequence[Record], kinds: Sequence[str]) -> Table:
    """Return a row for each kind, and one for all."""

    def share(mine: Sequence[Record], *names: str) -> str:
        return f"{np.mean([any(r[name] for name in names) for r in mine]):.2f}" if mine else ""

    rows = []
    for kind in (*kinds, "all"):
        of = [r for r in records if kind in (r["kind"], "all")]
        seeds, left = (where(of, left_out=out) for out in (SEEDS_OUT, KINDS_OUT))
        family = "" if kind == "all" else FAMILIES[FAMILY[class_of(kind)]]
        shares = share(seeds, "right"), share(seeds, "unknown"), share(left, "right", "unknown")
        rows.append((kind.replace("_", " "), family, f"{len(seeds)}", *shares))
    return Table(
        "Rows in alarm, by the belief after all diagnoses of the episode so far: share with the right family, and "
        "unknown, in episodes of seeds that the read-out did not learn from; and the share that is right or unknown "
        "where it did not learn from the kind at all.",
        ("Kind", "Family", "Rows", "Family right", "Unknown", "Kind left out: right or unknown"),
        rows,
    )
