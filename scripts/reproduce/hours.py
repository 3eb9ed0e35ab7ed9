"""Alarms an hour of a shipped memory: set on healthy hours of the corpus, and counted in others.

The threshold is set on the experts' episodes of those tasks that the memory babbled in, but for those that told its
ceilings. It is examined under agents, and in tasks, that it never met. Only episodes that solved the task count as
healthy, hits and all: what the senses excuse is a knock or a stop, and counted apart.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

from asm_gym.detection.hourly import Blocks, hourly_threshold
from asm_gym.evaluation.corpus import Corpus
from asm_gym.evaluation.defaults import WINDOW_S
from asm_gym.evaluation.detection_tables import kept_rate
from asm_gym.evaluation.metrics import DetectionMetrics, hourly_alarms
from asm_gym.evaluation.recordings import NOMINAL_ROLES
from asm_gym.evaluation.scored_episode import ScoredEpisode
from asm_gym.evaluation.statistics import Rate, Share
from asm_gym.evaluation.tables import Table, percent
from asm_gym.monitors import NeuralASM
from asm_gym.rollouts.pretraining.exam import SEVERITIES, Alarms, Exam, Marks, examine, usual_force
from asm_gym.scripts.options import option
from asm_gym.scripts.reproduce import kit
from asm_gym.scripts.reproduce.kit import Findings, Record

PROMISES = (10.0, 5.0, 3.0, 1.0)
"""False alarms an hour."""
FOUND = SEVERITIES, ("mild",)
"""Severities of faults that are counted together; mild ones are hardly to be seen."""
EXPERT = "scripted"


@dataclass(frozen=True)
class Config(kit.Config):
    """Alarms an hour of a shipped memory, as promised and as they come."""

    seeds: int = option(1, least=1)
    """The corpus is one: there is nothing to repeat."""
    corpus: Path = option(Path("runs/corpus"), metavar="FOLDER")
    """What asm-gym corpus has recorded."""
    memory: str = option("panda", metavar="NAME")
    """A shipped memory, of the arm that the corpus was recorded with."""


class Setting(NamedTuple):
    """Where thresholds come from, and what they are by the alarms an hour that they promise."""

    name: str
    thresholds: dict[float, float]


def run(config: Config) -> Findings:
    """Calibrates and examines."""
    corpus, memory = Corpus.open(config.corpus), NeuralASM.pretrained(config.memory)
    known = tuple(memory.about["tasks"])
    shipped = Setting("as shipped", {r: memory.threshold_at(false_alarms_per_hour=r) for r in PROMISES})
    with kit.stage("calibrating on healthy hours"):
        nominal = corpus.episodes(*NOMINAL_ROLES, policies=(EXPERT,), tasks=known)
        healthy = [episode for episode in nominal if episode.success and not memory.knows(episode)]
        hours = sum(len(e) * e.spec.dt for e in healthy) / 3600
        memory.calibrate(healthy, false_alarms_per_hour=PROMISES[0])
    anew = {r: memory.threshold_at(false_alarms_per_hour=r) for r in PROMISES if r * hours >= 1.0}
    settings = [shipped, Setting(f"from {hours:.1f} hours of {len(healthy)} episodes, whatever the task", anew)]
    marks = examined(corpus, memory, known)
    return Findings(
        records(marks, settings),
        [
            kept(marks, [*settings, at_last(marks)]),
            *(each(marks, setting) for setting in settings if setting.thresholds),
            missed(marks, shipped),
        ],
    )


def examined(corpus: Corpus, memory: NeuralASM, known: Sequence[str]) -> list[Marks]:
    """What the memory makes of every policy and task that it has not met."""
    places = dict.fromkeys((e.policy, e.label.task) for e in corpus.entries)
    marks = []
    with kit.stage("examining") as tell:
        for n, (policy, task) in enumerate(places):
            tell(n, len(places))
            if policy == EXPERT and task in known:
                continue
            own = list(corpus.episodes(policies=(policy,), tasks=(task,)))
            usual = usual_force(list(corpus.episodes("nominal", policies=(EXPERT,), tasks=(task,))[:100]))
            marks.append(examine(memory, Exam(task, policy, known=False).name, own, WINDOW_S, usual))
    return marks


def at_last(marks: Sequence[Marks]) -> Setting:
    """What these hours themselves would set: how much is found where so many alarms come, whatever was promised."""
    solved = [t for m in marks for t in m.solved]
    blocks = Blocks.of([t.surprise for t in solved], solved[0].dt)
    rates = {r: hourly_threshold(blocks, r) for r in PROMISES if r * blocks.total >= 1.0}
    return Setting("from these very hours, which promises nothing", rates)


def together(marks: Sequence[Marks], threshold: float) -> tuple[Alarms, Rate, list[Share]]:
    """In all examinations at this threshold: events, alarms for nothing, and faults found of each of ``FOUND``."""
    there = [m.at(threshold) for m in marks]
    healthy = [t for m in there for t in m.solved]
    faulty = [t for m in there for t in m.metrics.faulty]
    shares = [found([t for t in faulty if t.severity in severities]) for severities in FOUND]
    return Alarms.of(healthy), hourly_alarms(healthy), shares


def found(faulty: Sequence[ScoredEpisode]) -> Share:
    """Of these faults, within the window."""
    return DetectionMetrics("", list(faulty), [], WINDOW_S).detected


def kept(marks: Sequence[Marks], settings: Sequence[Setting]) -> Table:
    """A row for each promise."""
    rows = []
    for setting in settings:
        for promised, threshold in setting.thresholds.items():
            events, alarms, shares = together(marks, threshold)
            cells = kept_rate(alarms, promised), f"{events.knock.value:.1f}", f"{events.stop.value:.1f}"
            each = (f"{percent(share)} of {share.n}" for share in shares)
            rows.append((setting.name, f"{promised:g}", f"{threshold:.3g}", *cells, *each))
    hours = sum(len(t) * t.dt for m in marks for t in m.solved) / 3600
    return Table(
        f"Alarms an hour in {hours:.2f} healthy hours of policies and tasks that the memory never met, by what was "
        "promised; 95 % Poisson intervals; one that comes back within a minute is counted once. Broken: the interval "
        f"lies above. Faults that an ideal observer could see, of each severity, found within {WINDOW_S:g} s.",
        (
            "threshold",
            "promised",
            "",
            "faults that are none",
            "knocks",
            "stops",
            *(f"{' and '.join(s)} found" for s in FOUND),
        ),
        rows,
    )


def each(marks: Sequence[Marks], setting: Setting) -> Table:
    """A row for each policy and task."""
    rows = []
    for m in marks:
        hours = sum(len(t) * t.dt for t in m.solved) / 3600
        rates = (kept_rate(hourly_alarms(m.at(q).solved), r) for r, q in setting.thresholds.items())
        rows.append((m.name, f"{len(m.solved)} of {len(m.solved) + len(m.failed)}", f"{hours:.2f}", *rates))
    promised = (f"promised {r:g}" for r in setting.thresholds)
    return Table(
        f"Faults an hour that are none, of each policy and task, at thresholds {setting.name}. A promise for all of "
        "them promises nothing of one.",
        ("", "solved", "hours", *promised),
        rows,
    )


def missed(marks: Sequence[Marks], setting: Setting) -> Table:
    """A row for each kind of fault, the hardest first."""
    faults = {r: [t for m in marks for t in m.at(q).metrics.faulty] for r, q in setting.thresholds.items()}
    kinds = dict.fromkeys(t.kind for own in faults.values() for t in own)
    shares = {kind: [found([t for t in own if t.kind == kind]) for own in faults.values()] for kind in kinds}
    rows = [
        (kind, str(own[0].n), *(percent(share) for share in own))
        for kind, own in sorted(shares.items(), key=lambda item: [share.value for share in item[1]])
    ]
    promised = (f"promised {r:g}" for r in setting.thresholds)
    return Table(
        f"Faults found of each kind, at thresholds {setting.name}, of all severities.", ("", "faults", *promised), rows
    )


def records(marks: Sequence[Marks], settings: Sequence[Setting]) -> list[Record]:
    """Every count."""
    return [
        {"threshold": s.name, "promised": r, "exam": m.name, "alarms": rate.k, "hours": rate.hours}
        for s in settings
        for r, q in s.thresholds.items()
        for m in marks
        for rate in [hourly_alarms(m.at(q).solved)]
    ]
