"""A memory of a body, examined on policies and tasks that it never met."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import NamedTuple

import numpy as np

from asm_gym.crashes import CRASH
from asm_gym.detection.events import KNOCK, STOP
from asm_gym.episode import Episode, EpisodeLabel
from asm_gym.evaluation.comparison import visible_kinds
from asm_gym.evaluation.detection_tables import milliseconds
from asm_gym.evaluation.metrics import DetectionMetrics, false_alarms, hourly_alarms, hourly_events
from asm_gym.evaluation.scored_episode import NOMINAL, ScoredEpisode
from asm_gym.evaluation.statistics import Rate, Share
from asm_gym.evaluation.tables import Column, Table, count, percent, tabulate
from asm_gym.monitors import CalibratedMonitor
from asm_gym.rollouts.scoring import detectability_of, traces_of
from asm_gym.rollouts.seeds import draw_onset, role_seeds
from asm_gym.tasks import task as task_spec

SEVERITIES = "medium", "strong"
"""Of the faults in an examination; mild ones are hardly to be seen."""

PUSH = "push", "medium"
"""Kind and severity of a push of 20 N."""
SCENES = 12
"""In which faults happen; of more healthy episodes the first."""
PROMPT_S = 0.1
"""How soon a push should be noticed [s]."""


class Exam(NamedTuple):
    """A policy in a task, and whether babbling has shown either."""

    task: str
    policy: str
    known: bool

    @property
    def name(self) -> str:
        """For people."""
        who = "expert" if self.policy == "scripted" else "/".join(Path(self.policy).with_suffix("").parts[-2:])
        return f"{self.task}, {who}" + ("" if self.known else " (left out)")

    def labels(self, episodes: int, kinds: Sequence[str], seed: int, pushes: int = 0) -> list[EpisodeLabel]:
        """Nominal episodes; and a twin of the first for each of ``kinds`` and severity, the second for the next.

        Then pushes of 20 N, in the last of the scenes, of which there are ``SCENES`` at most.
        """
        every = role_seeds(seed, self.task, "nominal", episodes)
        seeds = every[:SCENES]
        horizon = task_spec(self.task).horizon
        nominal = [EpisodeLabel(self.task, "nominal", seed=s) for s in every]
        faults = [(kind, severity) for kind in kinds for severity in SEVERITIES]
        pairs = [(fault, seeds[n % len(seeds)]) for n, fault in enumerate(faults)]
        pairs += [(PUSH, s) for s in seeds[::-1][:pushes] if (PUSH, s) not in pairs]
        return nominal + [EpisodeLabel(self.task, "faulty", *fault, s, draw_onset(s, horizon)) for fault, s in pairs]


class Marks(NamedTuple):
    """What a memory made of one exam.

    Attributes:
        name: of the exam.
        solved: traces of healthy episodes in which the task was solved, however hard something pressed.
        failed: of those in which it was not.
        pushes: those of pushes of 20 N.
        metrics: on the other faults that an ideal observer could see. Of all faults those are left out in whose scenes
            the policy crashes by itself.
    """

    name: str
    solved: list[ScoredEpisode]
    failed: list[ScoredEpisode]
    pushes: list[ScoredEpisode]
    metrics: DetectionMetrics

    def at(self, threshold: float) -> Marks:
        """What it would have made of it at another threshold."""

        def judged(traces: Sequence[ScoredEpisode]) -> list[ScoredEpisode]:
            return [t.at(threshold) for t in traces]

        solved, failed, pushes = map(judged, (self.solved, self.failed, self.pushes))
        metrics = DetectionMetrics(self.name, judged(self.metrics.faulty), solved, self.metrics.window_s)
        return Marks(self.name, solved, failed, pushes, metrics)


def usual_force(recordings: Sequence[Episode]) -> float:
    """What healthy episodes that succeed usually feel at most [N]; infinite where none does, or none says it."""
    nominal = [e for e in recordings if e.labelled.role == "nominal" and e.success]
    most = [float(np.nanmax(e.contact_force)) for e in nominal if np.isfinite(e.contact_force).any()]
    return float(np.median(most)) if most else np.inf


def examine(memory: CalibratedMonitor, name: str, recordings: Sequence[Episode], window: float, usual: float) -> Marks:
    """What ``memory`` makes of the recordings of an exam.

    Args:
        name: of the exam.
        window: within which faults are to be found [s].
        usual: what the task's expert usually feels at most [N]: an agent that crashes in half of its episodes does not
            say what is usual.
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
    """Of healthy episodes, an hour each: faults that are none, knocks, stops, and all of them."""

    fault: Rate
    knock: Rate
    stop: Rate

    @classmethod
    def of(cls, traces: Sequence[ScoredEpisode]) -> Alarms:
        """At the threshold of the traces."""
        return cls(hourly_alarms(traces), *(hourly_events(traces, event) for event in (KNOCK, STOP)))

    @property
    def every(self) -> Rate:
        """The sum."""
        return Rate(sum(rate.k for rate in self), self.fault.hours)

    @property
    def text(self) -> str:
        """For people."""
        return f"{self.fault.text} faults, {self.knock.text} knocks, {self.stop.text} stops an hour"


COLUMNS: Sequence[Column[Marks]] = (
    Column("", lambda m: m.name),
    Column("hours", lambda m: f"{hourly_alarms(m.solved).hours:.2f}"),
    Column("fault", lambda m: Alarms.of(m.solved).fault.text),
    Column("knock", lambda m: f"{Alarms.of(m.solved).knock.value:.0f}" if m.solved else ""),
    Column("stop", lambda m: f"{Alarms.of(m.solved).stop.value:.0f}" if m.solved else ""),
    Column("all", lambda m: f"{Alarms.of(m.solved).every.value:.0f}" if m.solved else ""),
    Column("failed, alarm", lambda m: count(false_alarms(m.failed)) if m.failed else ""),
    Column("AUROC", lambda m: f"{m.metrics.auroc:.3f}" if m.metrics.faulty else ""),
    Column("found", lambda m: f"{percent(m.metrics.detected)} of {m.metrics.detected.n}" if m.metrics.faulty else ""),
    Column("median [ms]", lambda m: milliseconds(m.metrics.delays, "median_ms") if m.metrics.faulty else ""),
)


def card(marks: Sequence[Marks], memory: CalibratedMonitor, window: float) -> Table:
    """A row for each exam."""
    about = memory.about
    learned = f"learned from {about['lessons']} lessons of {', '.join(about['tasks'])} ({about['rows']} rows)"
    where = "an hour of each task" if about.get("each") else "an hour"
    limit = (
        f"threshold {memory.threshold:.3g} for {about['false_alarms_per_hour']:g} {where}, from "
        f"{about['calibrated_on']} others of {about['hours']:.2f} hours"
    )
    if "ceilings_on" in about:
        limit += (
            f"; how far each sense goes at its worst from {about['ceilings_on']} more of "
            f"{about['ceilings_hours']:.2f} hours"
        )
    return tabulate(
        f"{about['name']}: {learned}, {limit}. Alarms an hour of healthy episodes that solved the task: of faults that "
        "are none, with a 95 % Poisson interval, of knocks, of joints at their stops, and all; one that comes back "
        "within a minute is counted once. Episodes with such a fault, of those that failed. Faults of medium and "
        f"strong severity that an ideal observer could see, found within {window:g} s.",
        COLUMNS,
        marks,
    )


def summary(marks: Sequence[Marks]) -> str:
    """Alarms, and faults and pushes found, in all exams together."""
    alarms = Alarms.of([t for m in marks for t in m.solved])
    found = Share(sum(m.metrics.detected.k for m in marks), sum(m.metrics.detected.n for m in marks))
    delays = [t.delay for m in marks for t in m.pushes]
    prompt = Share.of([delay is not None and delay <= PROMPT_S + 1e-9 for delay in delays])
    return (
        f"{alarms.text} in {alarms.fault.hours:.2f} healthy hours, {count(found)} faults found, {count(prompt)} "
        f"pushes of 20 N noticed within {1e3 * PROMPT_S:.0f} ms"
    )


def at_rates(marks: Sequence[Marks], memory: CalibratedMonitor, rates: Sequence[float]) -> str:
    """``summary`` at the memory's threshold, and at that of each of ``rates`` an hour that it can promise."""
    said = [f"In all: {summary(marks)}."]
    for rate in rates:
        with suppress(ValueError):  # it was calibrated on too few
            threshold = memory.threshold_at(false_alarms_per_hour=rate)
            there = summary([m.at(threshold) for m in marks])
            said.append(f"At the threshold for {rate:g} an hour, {threshold:.3g}: {there}.")
    return " ".join(said)
