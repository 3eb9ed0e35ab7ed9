"""Telling causes apart: a read-out of where surprise is and of what explains it, asked for kinds it never saw.

Learns from the faulty episodes of an evaluation, in the rows in which a memory is in alarm. Writes the read-out that
learned from all kinds beside the table, as ``causes.json``; ``asm_gym/monitors/causes.json`` is such a file.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import numpy as np
import tyro
from matplotlib.figure import Figure
from numpy.typing import NDArray
from rich.console import Console

from asm_gym.episodes import Episode, load_episode
from asm_gym.evaluation.tables import Table
from asm_gym.monitors import NeuralASM
from asm_gym.monitors.diagnosis import CLASSES, FAMILIES, WINDOW, Diagnosis, Readout
from asm_gym.rollouts.folder import files_in
from asm_gym.rollouts.progress import stage
from asm_gym.scripts.reproduce.common import Common, Findings, Record, reproduce
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

ROWS, HARMLESS_ROWS = 14, 4
"""Rows learned from of a faulty and of a harmless episode, at most: the first in alarm, the most surprising."""

SHRINKAGE, STEPS, RATE = 1e-3, 5000, 2.0


@dataclass(frozen=True)
class Args(Common):
    """Families of causes that are told apart, of kinds of faults that were left out."""

    run: Annotated[Path, tyro.conf.arg(metavar="FOLDER")] = Path("runs/evaluate")
    """Folder of an evaluation, whose faulty episodes are learned from."""
    memory: Path = Path("runs/react/memory.asm")
    """A calibrated memory of these tasks, such as asm-gym react leaves."""
    tasks: tuple[str, ...] = ("Lift", "Stack", "Door")
    """Names of tasks."""


class Examples(NamedTuple):
    """N rows in alarm."""

    evidence: NDArray[np.float64]  # (N, F)
    classes: NDArray[np.intp]  # (N,)
    kinds: NDArray[np.str_]  # (N,)
    episodes: NDArray[np.intp]  # (N,)

    def of(self, chosen: NDArray[np.bool_]) -> Examples:
        """Some of them."""
        return Examples(self.evidence[chosen], self.classes[chosen], self.kinds[chosen], self.episodes[chosen])

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
    found: list[tuple[NDArray[np.float64], int, str, int]] = []
    for n, (episode, surprise) in enumerate(zip(episodes, memory.score_episodes(episodes), strict=True)):
        label = episode.labelled
        faulty = label.role == "faulty"
        onset = max(label.onset or 0, WINDOW) if faulty else WINDOW
        level = memory.threshold if faulty else 0.5 * memory.threshold
        rows = [int(t) for t in np.flatnonzero(surprise.value > level) if t >= onset]
        rows = rows[:ROWS] if faulty else sorted(rows, key=lambda t: -surprise.value[t])[:HARMLESS_ROWS]
        kind = label.kind if faulty else "harmless"
        lifted = diagnosis.completion.lift(episode.stream)
        for t in rows:
            window, where = slice(max(0, t - WINDOW), t + 1), surprise.attribution[t]
            if not diagnosis.is_stuck(episode.stream[window], where):
                found.append((diagnosis.evidence(lifted[window], where)[0], class_of(kind), kind, n))
    evidence, classes, kinds, numbers = (np.array(part) for part in zip(*found, strict=True))
    return Examples(evidence, classes.astype(np.intp), kinds, numbers.astype(np.intp))


def families(readout: Readout, evidence: NDArray[np.float64]) -> NDArray[np.float64]:
    """(N, families) probabilities."""
    return np.asarray(readout(evidence) @ np.eye(len(FAMILIES))[FAMILY])


def learned(known: Examples) -> Readout:
    """By the delta rule."""
    return Readout.fit(known.evidence, known.classes, known.weight, SHRINKAGE, STEPS, RATE)


def study(args: Args, console: Console, seconds: dict[str, float]) -> Findings:
    """Leaves out every kind in turn, asks for it, and learns from all in the end."""
    paths = files_in(args.run, args.tasks, "faulty", "harmless")
    if not paths:
        raise ValueError(f"{args.run} has no faulty recordings of {', '.join(args.tasks)}: run asm-gym evaluate first")
    memory = NeuralASM.load(args.memory)
    own = memory.diagnosis_
    if own is None:
        raise ValueError(f"{args.memory} was saved before there was completion: fit it anew")
    with stage("weighing", console, seconds):
        known = examples(memory, own, [load_episode(path) for path in paths])
    kinds = [kind for kind in dict.fromkeys(known.kinds.tolist()) if kind != "harmless"]
    kinds = kinds[:: max(1, len(kinds) // 4)] if args.quick else kinds
    records: list[Record] = []
    with stage("leaving kinds out", console, seconds) as progress:
        for n, kind in enumerate(kinds):
            asked = known.of(known.kinds == kind)
            p = families(learned(known.of(known.kinds != kind)), asked.evidence)
            sure, named = p.max(axis=1), p.argmax(axis=1)
            right, unsure = named == FAMILY[asked.classes], (sure < SURE) | (named == FAMILIES.index("unknown"))
            records += [
                {"seed": args.seed, "kind": kind, "right": bool(r and not u), "unknown": bool(u), "p": float(q)}
                for r, u, q in zip(right, unsure, sure, strict=True)
            ]
            progress(n + 1, len(kinds))
    shipped = learned(known)
    saved = {name: np.round(getattr(shipped, name), 5).tolist() for name in ("mean", "spread", "weights", "bias")}
    (args.out / "causes.json").write_text(json.dumps(saved), encoding="utf-8")
    return Findings(records, [table(records, kinds)], figure(records), {})


def table(records: Sequence[Record], kinds: Sequence[str]) -> Table:
    """A row for each kind that was left out."""
    rows = []
    for kind in kinds:
        mine = [r for r in records if r["kind"] == kind]
        family = FAMILIES[FAMILY[class_of(kind)]]
        right, unknown = (float(np.mean([r[what] for r in mine])) for what in ("right", "unknown"))
        rows.append((kind.replace("_", " "), family, f"{len(mine)}", f"{right:.2f}", f"{unknown:.2f}"))
    return Table(
        "Rows in alarm of kinds of faults that the read-out never saw: the share of which it names the family, and the "
        "share it calls unknown",
        ("Kind left out", "Family", "Rows", "Right", "Unknown"),
        rows,
    )


def figure(records: Sequence[Record]) -> Figure:
    """How often it is right, by how sure it is."""
    drawn = Figure(figsize=(4, 4), layout="constrained")
    axes: Any = drawn.add_subplot()
    edges = np.linspace(SURE, 1.0, 6)
    sure = np.array([r["p"] for r in records if not r["unknown"]])
    right = np.array([r["right"] for r in records if not r["unknown"]])
    places = np.clip(np.digitize(sure, edges) - 1, 0, len(edges) - 2)
    means = [
        (sure[places == k].mean(), right[places == k].mean()) for k in range(len(edges) - 1) if (places == k).any()
    ]
    axes.plot([SURE, 1], [SURE, 1], color="grey", linewidth=1)
    axes.plot(*np.array(means).reshape(-1, 2).T, marker="o")
    axes.set(xlabel="probability it gives", ylabel="share it has right")
    return drawn


def main(argv: list[str] | None = None) -> int:
    """Runs the study, and returns the exit code."""
    return reproduce("diagnosis", study, Args, __doc__, argv)


if __name__ == "__main__":
    sys.exit(main())
