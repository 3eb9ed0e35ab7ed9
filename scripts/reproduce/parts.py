"""Which part of the memory finds what: each part alone, and memories taught in other ways, judged on one corpus.

A memory is fitted once for each way to teach it; its parts are then judged with the same weights. Precision is what
association expects of its errors in each row; ``one precision everywhere`` weighs every row alike.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import NamedTuple, Self

import numpy as np

from asm_gym.detection import EvidenceDetection, conformal_episodes
from asm_gym.episode import Episode
from asm_gym.evaluation import defaults
from asm_gym.evaluation.comparison import BenchmarkResult, MonitorResult
from asm_gym.evaluation.corpus import SKILLS, skill_labels
from asm_gym.evaluation.metrics import DetectionMetrics, false_alarms
from asm_gym.evaluation.recordings import Recordings, read
from asm_gym.evaluation.scoring import detectability_of, fitted, judged
from asm_gym.evaluation.tables import Table
from asm_gym.memory.association_learning import FEEDBACK, LEARNED
from asm_gym.memory.dynamics import TRACES
from asm_gym.memory.precision import unbounded
from asm_gym.monitors import CalibratedMonitor, NeuralASM
from asm_gym.monitors.base import Progress
from asm_gym.monitors.baselines.memory_parts import AssociationPart, TemporalPart
from asm_gym.monitors.memory_model import MemoryModel
from asm_gym.scripts.options import fixed, option
from asm_gym.scripts.reproduce import kit
from asm_gym.scripts.reproduce.kit import Findings, Record, shown

LINEAR = "linear"
"""A linear association, without hidden units."""
USUAL = f"{LEARNED} {TRACES}"
WAYS = (USUAL, *(f"{way} {TRACES}" for way in FEEDBACK if way != LEARNED), f"{LEARNED} settling", LINEAR)
"""How association is taught, and the dynamics; the memory as it ships is first."""


@dataclass(frozen=True)
class Config(kit.Config):
    """The parts of the memory, on a corpus."""

    corpus: Path = option(Path("runs/corpus"), metavar="FOLDER")
    """Folder of asm-gym corpus: learned from, calibrated on and judged by."""
    ways: tuple[str, ...] = option(WAYS, least=1, known=WAYS)
    """How association is taught, and the dynamics; or linear, for no hidden units."""
    tasks: tuple[str, ...] = option(SKILLS, least=1, known=SKILLS)
    """Skills of the corpus, which one memory learns together."""
    false_alarm_rate: float = option(defaults.REPORTED_RATE, quick=0.5, check=conformal_episodes)
    """Share of nominal episodes that may raise an alarm."""
    epochs: int = fixed(40, quick=1, least=1)
    """Passes of the temporal network over the episodes."""

    @property
    def recordings(self) -> Recordings:
        """Recordings of the skills in the corpus."""
        own = (label for label in skill_labels(self.corpus) if label.task in self.tasks)
        return read(self.corpus / "scripted", tuple(own))


class Learned(MemoryModel):
    """A memory that has learned already."""

    @classmethod
    def of(cls, memory: NeuralASM) -> Self:
        """Return one with the weights of a memory."""
        m = memory.model
        sizes = m.hidden_size, m.association_size
        return cls(m.spec, *sizes, m.schedule, m.feedback, m.dynamics).restore(m.learned_)

    def fit(self, episodes: Sequence[Episode], rng: np.random.Generator, progress: Progress) -> Self:
        return self

    def with_one_precision(self) -> Self:
        """Give every row the same precision."""
        found, size = self.learned_, len(self.spec.sensory)
        nothing = {"W_S": np.zeros_like(found["W_S"]), "b_S": np.zeros_like(found["b_S"])}
        return self.restore({**found, **nothing, "span_S": unbounded(size)})


def part_of(memory: Learned, part: type[AssociationPart | TemporalPart]) -> AssociationPart | TemporalPart:
    """Return a part of a memory that has learned."""
    made = part(memory.spec, memory.dynamics)
    made.memory = memory
    return made


class Job(NamedTuple):
    """A memory to be taught."""

    way: str
    seed: int


def monitors_of(job: Job, fit: Sequence[Episode], config: Config) -> Iterator[tuple[str, CalibratedMonitor]]:
    """Yield the name of each part and the part as a fitted monitor."""
    spec, feedback = fit[0].spec, job.way.partition(" ")[0]
    if job.way == LINEAR:
        yield "no hidden units", fitted(config.out, "association_linear+evidence", fit, job.seed)
        return
    dynamics = job.way.partition(" ")[2]
    how = {"feedback": feedback, "dynamics": dynamics, "epochs": config.epochs}
    memory = fitted(config.out, "neural_asm", fit, job.seed, how)
    assert isinstance(memory, NeuralASM)
    said = "".join(f", {name}" for name in (feedback, dynamics) if name not in (LEARNED, TRACES))
    yield f"all{said}", memory
    if feedback != LEARNED:
        return

    def alone(model: object) -> CalibratedMonitor:
        return CalibratedMonitor(model, EvidenceDetection(spec), seed=job.seed).fit(fit)  # type: ignore[arg-type]

    yield f"temporal network alone{said}", alone(part_of(Learned.of(memory), TemporalPart))
    if dynamics != TRACES:
        return
    yield "association alone", alone(part_of(Learned.of(memory), AssociationPart))
    yield "all, one precision everywhere", alone(Learned.of(memory).with_one_precision())
    yield (
        "association alone, one precision everywhere",
        alone(part_of(Learned.of(memory).with_one_precision(), AssociationPart)),
    )


def score(job: Job, config: Config) -> dict[str, MonitorResult]:
    """Judge each part of a memory."""
    roles = config.recordings.roles
    monitors = monitors_of(job, roles["fit"], config)
    return {name: judged(name, monitor, roles, config.false_alarm_rate) for name, monitor in monitors}


def run(config: Config) -> Findings:
    """Teach memories and judge their parts."""
    jobs = [Job(way, seed) for seed in config.repetitions for way in config.ways]
    found = kit.each("fitting and judging", partial(score, config=config), jobs, config)
    roles, left_out, twins = config.recordings
    seen = detectability_of(twins, roles.get("faulty", []), defaults.WINDOW_S)
    records: list[Record] = []
    for seed in config.repetitions:
        own = {name: m for job, made in zip(jobs, found, strict=True) if job.seed == seed for name, m in made.items()}
        result = BenchmarkResult(own, seen, config.false_alarm_rate, defaults.WINDOW_S, left_out)
        records += [{"part": m.name, "seed": seed, **measured(m)} for m in result.on_visible]
    return Findings(records, [table(records, config)])


def measured(m: DetectionMetrics) -> Record:
    """Return the AUROC, and the share of faults found at each false-alarm rate [%]."""
    found = {f"at {100 * r:g} %": share.value for r, share in m.found.items()}
    found |= {f"{r:g} an hour": share.value for r, share in m.found_hourly.items()}
    found |= {"nominal alarms": false_alarms(m.nominal).value}
    return {"auroc": m.auroc} | {name: 100 * share for name, share in found.items()}


def table(records: Sequence[Record], config: Config) -> Table:
    """Return a row for each part."""
    heads = [name for name in records[0] if name not in ("part", "seed")]
    parts = dict.fromkeys(str(r["part"]) for r in records)
    rows = [(p, *(shown(records, name, 3 if name == "auroc" else 0, part=p) for name in heads)) for p in parts]
    return Table(
        "AUROC over the same steps, and faults found [%], mean ± SD over seeds of the weights. Nominal alarms: at "
        f"{100 * config.false_alarm_rate:g} % [% of episodes].",
        ("", "AUROC", *heads[1:]),
        rows,
    )
