"""Who does what in the memory: its parts heard one by one, and taught in other ways, all judged on one corpus.

A memory is fitted once for each way to teach it, and its parts are heard from that. What association expects to go
wrong (its precision) and what is usual in a state (habituation) say how far a prediction can be trusted here and now.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import NamedTuple, Self

import numpy as np
from matplotlib.figure import Figure

from asm_gym.detection import EvidenceDetection, conformal_episodes
from asm_gym.episode import Episode
from asm_gym.evaluation import defaults
from asm_gym.evaluation.comparison import BenchmarkResult, Detectability, MonitorResult
from asm_gym.evaluation.corpus import SKILLS, skill_labels
from asm_gym.evaluation.defaults import FALSE_ALARM_RATE, REPORTED_RATE
from asm_gym.evaluation.detection_tables import lead_table, monitors_table
from asm_gym.evaluation.figures import figure
from asm_gym.evaluation.metrics import DetectionMetrics, detected, false_alarms, in_words
from asm_gym.evaluation.recordings import Recordings, read
from asm_gym.evaluation.resampling import interval
from asm_gym.evaluation.scoring import detectability_of, fitted, judged
from asm_gym.evaluation.statistics import Share
from asm_gym.evaluation.tables import Table, percent
from asm_gym.faults.suite import SEVERITIES
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
"""No hidden units at all, and nothing else either."""
USUAL = f"{LEARNED} {TRACES}"
WAYS = (USUAL, *(f"{way} {TRACES}" for way in FEEDBACK if way != LEARNED), f"{LEARNED} settling", LINEAR)
"""How association is taught, and which dynamics: the memory as it is first."""


@dataclass(frozen=True)
class Config(kit.Config):
    """The parts of the memory, on a corpus."""

    corpus: Path = option(Path("runs/corpus"), metavar="FOLDER")
    """What asm-gym corpus has recorded: learned from, calibrated on and judged by."""
    ways: tuple[str, ...] = option(WAYS, least=1, known=WAYS)
    """How association is taught, and the dynamics; or linear, for no hidden units."""
    tasks: tuple[str, ...] = option(SKILLS, least=1, known=SKILLS)
    """Skills of the corpus, which one memory learns together."""
    whole: bool = False
    """The memory alone, not its parts; and each kind of fault, the hardest first."""
    false_alarm_rate: float = option(defaults.REPORTED_RATE, quick=0.5, check=conformal_episodes)
    """Share of nominal episodes that may raise an alarm."""
    epochs: int = fixed(40, quick=1, least=1)
    """Passes of the temporal network over the episodes."""

    @property
    def recordings(self) -> Recordings:
        """Of the skills in the corpus; raises as ``Corpus.open``."""
        own = (label for label in skill_labels(self.corpus) if label.task in self.tasks)
        return read(self.corpus / "scripted", tuple(own))


KINDS_AT = REPORTED_RATE, FALSE_ALARM_RATE
"""False-alarm rates at which kinds, and faults that are surely seen, are counted."""


class Learned(MemoryModel):
    """A memory that has learned already, for its parts to be heard."""

    @classmethod
    def of(cls, memory: NeuralASM) -> Self:
        """The same weights."""
        m = memory.model
        sizes = m.hidden_size, m.association_size
        return cls(m.spec, *sizes, m.schedule, m.feedback, m.dynamics).restore(m.learned_)

    def fit(self, episodes: Sequence[Episode], rng: np.random.Generator, progress: Progress) -> Self:
        return self

    def with_one_precision(self) -> Self:
        """Where every error is as likely as it is on average."""
        found, size = self.learned_, len(self.spec.sensory)
        nothing = {"W_S": np.zeros_like(found["W_S"]), "b_S": np.zeros_like(found["b_S"])}
        return self.restore({**found, **nothing, "span_S": unbounded(size)})


def heard(part: type[AssociationPart | TemporalPart], memory: Learned) -> AssociationPart | TemporalPart:
    """A part of a memory that has learned."""
    made = part(memory.spec, memory.dynamics)
    made.memory = memory
    return made


class Job(NamedTuple):
    """A memory to be taught, whose parts are heard."""

    way: str
    seed: int


def monitors_of(job: Job, fit: Sequence[Episode], config: Config) -> Iterator[tuple[str, CalibratedMonitor]]:
    """The name of each part in tables, and the part, fitted."""
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
    if config.whole or feedback != LEARNED:
        return

    def alone(model: object) -> CalibratedMonitor:
        return CalibratedMonitor(model, EvidenceDetection(spec), seed=job.seed).fit(fit)  # type: ignore[arg-type]

    yield f"temporal network alone{said}", alone(heard(TemporalPart, Learned.of(memory)))
    if dynamics != TRACES:
        return
    yield "association alone", alone(heard(AssociationPart, Learned.of(memory)))
    yield "all, one precision everywhere", alone(Learned.of(memory).with_one_precision())
    yield (
        "association alone, one precision everywhere",
        alone(heard(AssociationPart, Learned.of(memory).with_one_precision())),
    )


def score(job: Job, config: Config) -> dict[str, MonitorResult]:
    """What each part makes of the recordings."""
    roles = config.recordings.roles
    monitors = monitors_of(job, roles["fit"], config)
    return {name: judged(name, monitor, roles, config.false_alarm_rate) for name, monitor in monitors}


def run(config: Config) -> Findings:
    """Teaches memories, and asks their parts."""
    jobs = [Job(way, seed) for seed in config.repetitions for way in config.ways]
    found = kit.each("fitting and judging", partial(score, config=config), jobs, config)
    roles, left_out, twins = config.recordings
    seen = detectability_of(twins, roles.get("faulty", []), defaults.WINDOW_S)
    how = config.false_alarm_rate, defaults.WINDOW_S, left_out
    records: list[Record] = []
    results = []
    for seed in config.repetitions:
        own = {name: m for job, made in zip(jobs, found, strict=True) if job.seed == seed for name, m in made.items()}
        results.append(BenchmarkResult(own, seen, *how))
        records += [{"part": m.name, "seed": seed, **measured(m, seen)} for m in results[-1].on_visible]
    made = [over(records, config), monitors_table(results[0]), lead_table(results[0])]
    if config.whole:
        made = [*made[:2], hardest(results)]
    return Findings(records, made, bars(results[0]), {"parts": list(results[0].monitors)})


def measured(m: DetectionMetrics, seen: Sequence[Detectability]) -> Record:
    """AUROC, and shares of the faults that were found [%]: of all, and of those that the ideal observer is sure of."""
    sure = {(d.task, d.kind, d.severity, d.seed) for d in seen if d.earliest is not None}
    told = [t for t in m.faulty if (t.task, t.kind, t.severity, t.seed) in sure]
    found = {f"at {100 * r:g} %": share.value for r, share in m.found.items()}
    hourly = {f"at {r:g} an hour": share.value for r, share in m.found_hourly.items()}
    surely = {
        f"of {len(told)} surely seen, at {100 * r:g} %": detected([t.at(q) for t in told], m.window_s).value
        for r, q in m.thresholds.items()
        if r in KINDS_AT
    }
    alarms = {"nominal alarms": false_alarms(m.nominal).value}
    return {"auroc": m.auroc} | {name: 100 * share for name, share in (found | hourly | surely | alarms).items()}


def over(records: Sequence[Record], config: Config) -> Table:
    """Mean and deviation over the seeds."""
    heads = [name for name in records[0] if name not in ("part", "seed")]
    parts = dict.fromkeys(str(r["part"]) for r in records)
    rows = [(p, *(shown(records, name, 3 if name == "auroc" else 0, part=p) for name in heads)) for p in parts]
    return Table(
        f"Each part: AUROC over the same steps, and faults found [%]; mean ± SD over these seeds of the weights: "
        f"{', '.join(map(str, config.repetitions))}. Surely seen: by the ideal observer. Nominal alarms: at "
        f"{100 * config.false_alarm_rate:g} % [% of episodes].",
        ("", "AUROC", *heads[1:]),
        rows,
    )


def hardest(results: Sequence[BenchmarkResult]) -> Table:
    """Each kind of fault, and what the first monitor finds of it with all seeds together; the hardest first."""
    own = [next(iter(result.on_visible)).kinds for result in results]
    kinds = list(dict.fromkeys(kind for kind, _ in own[0]))

    def found(kind: str, severity: str, rate: float) -> Share:
        shares = [k[kind, severity].found[rate] for k in own if (kind, severity) in k]
        return Share(sum(s.k for s in shares), sum(s.n for s in shares))

    rates = (r for r in KINDS_AT if r in results[0].on_visible[0].thresholds)
    columns = [(r, severity) for r in rates for severity in SEVERITIES]
    rows = [(kind, [found(kind, severity, r) for r, severity in columns]) for kind in kinds]
    rows.sort(key=lambda row: float(np.nanmean([share.value for share in row[1]])))
    return Table(
        "Faults found of each kind that the ideal observer can see, all seeds together, the hardest first.",
        ("", *(f"{severity}, at {100 * r:g} %" for r, severity in columns)),
        [(in_words((kind, "")), *map(percent, shares)) for kind, shares in rows],
    )


def bars(result: BenchmarkResult) -> Figure:
    """AUROC of each, with its interval."""
    with figure(height=3.0) as fig:
        ax = fig.subplots()
        names = [m.name for m in result.on_visible]
        each = [interval(m.auroc, m.draws.auroc) for m in result.on_visible]
        centre, low, high = np.array(each).T
        ax.errorbar(centre, names, xerr=[centre - low, high - centre], fmt="o", capsize=3)
        ax.invert_yaxis()
        ax.set(xlabel="AUROC, same steps")
        ax.grid(axis="x", color="#dddddd", linewidth=0.6)
    return fig
