"""What local learning of association costs: its hidden units taught in four ways, and left out.

Reads the recordings of ``asm-gym evaluate``. Association stands alone, without the context that the temporal network
gives, so that nothing but the way that errors come back differs: see ``memory.feedback``.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from typing import NamedTuple, Self

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from asm_gym.detection import EvidenceDetection, ModelOutput, conformal_episodes
from asm_gym.detection.base import Arrays
from asm_gym.episode import Episode
from asm_gym.evaluation import defaults
from asm_gym.evaluation.comparison import BenchmarkResult, MonitorResult
from asm_gym.evaluation.figures import figure
from asm_gym.evaluation.resampling import interval
from asm_gym.evaluation.standing import lead_table
from asm_gym.evaluation.tables import monitors_table
from asm_gym.faults.suite import KINDS, kinds_of
from asm_gym.memory.association import Association, learn_association, normalised_errors, spans
from asm_gym.memory.feedback import FEEDBACK
from asm_gym.monitors import CalibratedMonitor, make_monitor
from asm_gym.monitors.base import Progress, Told
from asm_gym.monitors.baselines.base import Lagged, associated, no_context, nothing_before
from asm_gym.monitors.stream_model import StreamModel
from asm_gym.rollouts.run_folder import recorded
from asm_gym.rollouts.scoring import judged
from asm_gym.scaling import StreamScaler, rows_apart
from asm_gym.scripts.options import option
from asm_gym.scripts.reproduce import kit
from asm_gym.scripts.reproduce.kit import Findings, Record
from asm_gym.scripts.reproduce.recordings import RunConfig, in_turn
from asm_gym.spec import StreamSpec

UNITS = 240
"""Of association, shared out among the groups, as in the memory."""

LINEAR = "linear"
"""No hidden units at all."""
WAYS = (*FEEDBACK, LINEAR)


@dataclass(frozen=True)
class Config(RunConfig):
    """Association whose errors come back in different ways."""

    seeds: int = option(1, least=1)
    """How often it repeats itself."""
    ways: tuple[str, ...] = option(WAYS, least=1, known=WAYS)
    """How errors come back to the hidden units."""
    kinds: tuple[str, ...] = ()
    """Kinds of fault, development or test, of those that the run has recorded; all by default."""
    episodes: int = option(1000, quick=12, least=1)
    """How many episodes are learned from at most, of all tasks together."""
    false_alarm_rate: float = option(defaults.REPORTED_RATE, check=conformal_episodes)
    """Share of nominal episodes that may raise an alarm."""

    def __post_init__(self) -> None:
        super().__post_init__()
        kinds_of(self.kinds)


class FedAssociation(StreamModel):
    """Association alone, its hidden units taught in a way of their own."""

    kind = "fed_association"

    def __init__(self, spec: StreamSpec, way: str) -> None:
        super().__init__(spec)
        self.way, self.lag = way, rows_apart(spec.dt)
        self.shortest = 1 + self.lag

    def fit(self, episodes: Sequence[Episode], rng: np.random.Generator, progress: Progress) -> Self:
        streams = [e.stream for e in episodes]
        senses = StreamScaler.fit(self.spec, streams, self.lag)
        rows = [senses.read_episode(s).inputs[self.lag :] for s in streams]
        a = np.concatenate(rows)
        delta, each = np.ascontiguousarray(a[:, senses.changes]), UNITS // (int(senses.groups.max()) + 1)
        layout = senses.groups, senses.changes, max(1, each)
        lengths = [len(r) for r in rows]
        found = learn_association(a, delta, *layout, rng, feedback=FEEDBACK[self.way](), lengths=lengths)
        standard = {"mean": senses.mean, "spread": senses.spread, "change": senses.change}
        return self.restore({**standard, **found._asdict()})

    def restore(self, learned: Arrays, skills: tuple[str, ...] = ()) -> Self:
        self.senses_ = StreamScaler(self.spec, learned["mean"], learned["spread"], learned["change"], self.lag)
        self.association_ = Association(**{n: learned[n] for n in Association._fields})
        self.spans_ = spans(self.association_.U)
        return super().restore(learned, skills)

    def start(self, batch: int, told: Sequence[Told] = ()) -> Lagged:
        return nothing_before(batch, self.lag, self.spec.size)

    def predict(self, state: Lagged, rows: NDArray[np.float64]) -> tuple[Lagged, ModelOutput]:
        state, r, known = associated(self.senses_, state, rows)
        error, _ = normalised_errors(r.inputs, r.changes, known, *self.association_, self.spans_)
        return state, ModelOutput(error, no_context(rows))


class Job(NamedTuple):
    """One way of feedback, to be learned and asked."""

    way: str
    seed: int

    @property
    def monitor(self) -> str:
        """Its name in tables."""
        return f"{self.way}, seed {self.seed}"


def monitor_of(job: Job, spec: StreamSpec) -> CalibratedMonitor:
    """What is to be fitted."""
    if job.way == LINEAR:
        return make_monitor("association_linear+evidence", spec, seed=job.seed)
    return CalibratedMonitor(FedAssociation(spec, job.way), EvidenceDetection(spec), seed=job.seed)


def roles_of(config: Config) -> dict[str, Sequence[Episode]]:
    """The recordings by role, those of the kinds that are asked for."""
    roles = config.roles
    asked = kinds_of(config.kinds or tuple(KINDS))
    return {**roles, "faulty": [e for e in roles.get("faulty", []) if e.labelled.kind in asked], "harmless": []}


def score(job: Job, config: Config) -> MonitorResult:
    """What association that was taught in one way makes of the recordings."""
    roles = roles_of(config)
    learned = in_turn(roles["fit"], job.seed)[: config.episodes]
    return judged(job.monitor, monitor_of(job, learned[0].spec).fit(learned), roles, config.false_alarm_rate)


def run(config: Config) -> Findings:
    """Teaches association in every way, and asks it."""
    jobs = [Job(way, seed) for seed in config.repetitions for way in config.ways]
    found = kit.each("fitting and judging", partial(score, config=config), jobs, config)
    left_out = recorded(config.run, config.tasks).left_out
    seen = config.detectable(roles_of(config)["faulty"])
    by_name = {job.monitor: result for job, result in zip(jobs, found, strict=True)}
    result = BenchmarkResult(by_name, seen, config.false_alarm_rate, config.window, left_out)
    records: list[Record] = [
        {**job._asdict(), "auroc": m.auroc, "found": m.found[config.false_alarm_rate].value}
        for job, m in zip(jobs, result.on_visible, strict=True)
    ]
    facts = {"tasks": config.tasks, "kinds": sorted({kind for kind, _ in result.visible})}
    return Findings(records, [monitors_table(result), lead_table(result)], bars(result), facts)


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
