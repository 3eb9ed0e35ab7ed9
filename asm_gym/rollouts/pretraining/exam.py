"""Examine a memory of a body on policies and tasks that it never met."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from asm_gym.data.crashes import CRASH, peak_force
from asm_gym.detection.events import KNOCK, STOP
from asm_gym.episode import Episode
from asm_gym.evaluation.detection_tables import milliseconds
from asm_gym.evaluation.ideal import detectability_of, visible_kinds
from asm_gym.evaluation.metrics import DetectionMetrics, false_alarms, hourly_alarms
from asm_gym.evaluation.scored_episode import NOMINAL, ScoredEpisode
from asm_gym.evaluation.scoring import traces_of
from asm_gym.evaluation.statistics import Rate, Share
from asm_gym.evaluation.tables import Column, Table, count, percent, tabulate
from asm_gym.monitors import CalibratedMonitor
from asm_gym.rollouts.seeds import role_seeds
from asm_gym.rollouts.trial import Trial, faulty_trial, nominal_trials
from asm_gym.tasks import task as task_spec

SEVERITIES = "medium", "strong"
"""Of the faults in an examination; mild ones are hardly detectable."""
PUSH = "push", "medium"
"""Kind and severity of a push of 20 N."""
SCENES = 12
"""Faults happen in the first so many scenes."""
PROMPT_S = 0.1
"""A push should be detected this soon [s]."""


class Exam(NamedTuple):
    """A policy in a task, and whether babbling has shown both."""

    task: str
    policy: str
    known: bool

    @property
    def name(self) -> str:
        """Name for tables."""
        policy = "expert" if self.policy == "scripted" else "/".join(Path(self.policy).with_suffix("").parts[-2:])
        return f"{self.task}, {policy}" + ("" if self.known else " (left out)")

    def trials(self, episodes: int, kinds: Sequence[str], seed: int, pushes: int = 0) -> list[Trial]:
        """Return nominal episodes, a twin for each of ``kinds`` and severity, and pushes of 20 N in the last scenes."""
        every = role_seeds(seed, self.task, "nominal", episodes)
        seeds, task = every[:SCENES], task_spec(self.task)
        faults = [(kind, severity) for kind in kinds for severity in SEVERITIES]
        pairs = [(fault, seeds[n % len(seeds)]) for n, fault in enumerate(faults)]
        pairs += [(PUSH, s) for s in seeds[::-1][:pushes] if (PUSH, s) not in pairs]
        nominal = nominal_trials(task.id, "nominal", every)
        return nominal + [faulty_trial(task.id, *fault, s, task.horizon) for fault, s in pairs]


class Marks(NamedTuple):
    """The result of one exam.

    Attributes:
        name: of the exam.
        solved, failed: scored healthy episodes, by whether the task was solved.
        pushes: scored pushes of 20 N.
        metrics: on the other visible faults, but for scenes in which the policy crashes by itself.
    """

    name: str
    solved: list[ScoredEpisode]
    failed: list[ScoredEpisode]
    pushes: list[ScoredEpisode]
    metrics: DetectionMetrics

    def at(self, threshold: float) -> Marks:
        """Return the result at another threshold."""
        parts = self.solved, self.failed, self.pushes, self.metrics.faulty
        solved, failed, pushes, faulty = ([t.at(threshold) for t in traces] for traces in parts)
        return Marks(
            self.name, solved, failed, pushes, DetectionMetrics(self.name, faulty, solved, self.metrics.window_s)
        )


def usual_force(recordings: Sequence[Episode]) -> float:
    """Return the median of the greatest forces of solved healthy episodes [N]; infinite where unknown."""
    peaks = [peak_force(e) for e in recordings if e.labelled.role == "nominal" and e.success]
    known = [peak for peak in peaks if np.isfinite(peak)]
    return float(np.median(known)) if known else np.inf


def examine(memory: CalibratedMonitor, name: str, recordings: Sequence[Episode], window: float, usual: float) -> Marks:
    """Score the recordings of an exam.

    Args:
        memory: calibrated.
        name: of the exam.
        recordings: nominal and faulty.
        window: an alarm within this time of the onset is a detection [s].
        usual: the usual greatest force of the task's expert [N]; an agent that often crashes does not tell it.
    """
    traces = traces_of(name, memory, recordings, memory.threshold)
    hit = {e.labelled.seed for e in recordings if CRASH * usual < usual_force([e]) < np.inf}
    twins = [r for r in recordings if r.labelled.role == "nominal"]
    faulty = [r for r in recordings if r.labelled.role == "faulty" and r.labelled.seed not in hit]
    seen = visible_kinds(detectability_of(twins, faulty, window))
    visible = [t for t in traces if t.onset is not None and t.seed not in hit and seen[t.kind, t.severity]]
    pushes, faults = ([t for t in visible if ((t.kind, t.severity) == PUSH) is want] for want in (True, False))
    nominal = [t for t in traces if t.kind == NOMINAL]
    solved, failed = ([t for t in nominal if t.outcome.success is want] for want in (True, False))
    return Marks(name, solved, failed, pushes, DetectionMetrics(name, faults, solved, window))


class Alarms(NamedTuple):
    """Alarms of healthy episodes per hour, by event."""

    fault: Rate
    knock: Rate
    stop: Rate

    @classmethod
    def of(cls, traces: Sequence[ScoredEpisode]) -> Alarms:
        """Count at the threshold of the episodes."""
        return cls(*(hourly_alarms(traces, event) for event in ("", KNOCK, STOP)))

    @property
    def text(self) -> str:
        """Format."""
        return f"{self.fault.text} faults, {self.knock.text} knocks, {self.stop.text} stops an hour"


COLUMNS: Sequence[Column[Marks]] = (
    Column("", lambda m: m.name),
    Column("hours", lambda m: f"{hourly_alarms(m.solved).hours:.2f}"),
    Column("faults/h", lambda m: Alarms.of(m.solved).fault.text),
    Column("knocks/h", lambda m: f"{Alarms.of(m.solved).knock.value:.0f}" if m.solved else ""),
    Column("stops/h", lambda m: f"{Alarms.of(m.solved).stop.value:.0f}" if m.solved else ""),
    Column("failed, alarm", lambda m: count(false_alarms(m.failed)) if m.failed else ""),
    Column("AUROC", lambda m: f"{m.metrics.auroc:.3f}" if m.metrics.faulty else ""),
    Column("found", lambda m: f"{percent(m.metrics.detected)} of {m.metrics.detected.n}" if m.metrics.faulty else ""),
    Column("median [ms]", lambda m: milliseconds(m.metrics.delays, "median_ms") if m.metrics.faulty else ""),
)


def card(marks: Sequence[Marks], memory: CalibratedMonitor, window: float) -> Table:
    """Return a row for each exam."""
    about = memory.about
    return tabulate(
        f"{about['name']}: learned from {about['lessons']} lessons of {', '.join(about['tasks'])}; threshold "
        f"{memory.threshold:.3g} for {about['false_alarms_per_hour']:g} false alarms per hour, from "
        f"{about['hours']:.2f} other hours. Alarms per hour of solved healthy episodes, with 95 % Poisson intervals; "
        "one that comes back within a minute is counted once. Failed episodes with an alarm. Visible faults of medium "
        f"and strong severity, found within {window:g} s.",
        COLUMNS,
        marks,
    )


def summary(marks: Sequence[Marks]) -> str:
    """Return one line: alarms, and faults and pushes found, in all exams together."""
    alarms = Alarms.of([t for m in marks for t in m.solved])
    found = Share(sum(m.metrics.detected.k for m in marks), sum(m.metrics.detected.n for m in marks))
    delays = [t.delay for m in marks for t in m.pushes]
    prompt = Share.of([delay is not None and delay <= PROMPT_S + 1e-9 for delay in delays])
    return (
        f"In all: {alarms.text} in {alarms.fault.hours:.2f} healthy hours, {count(found)} faults found, "
        f"{count(prompt)} pushes of 20 N detected within {1e3 * PROMPT_S:.0f} ms."
    )
