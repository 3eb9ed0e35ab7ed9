"""A memory of a body, examined on policies and tasks that it never met."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import NamedTuple

import numpy as np

from asm_gym.episode import Episode, EpisodeLabel
from asm_gym.evaluation.comparison import visible_kinds
from asm_gym.evaluation.metrics import DetectionMetrics, false_alarms, hourly_alarms
from asm_gym.evaluation.scored import NOMINAL, ScoredEpisode
from asm_gym.evaluation.statistics import Share
from asm_gym.evaluation.tables import Column, Table, count, milliseconds, percent, tabulate
from asm_gym.monitors import CalibratedMonitor
from asm_gym.rollouts.run_folder import CRASH
from asm_gym.rollouts.scoring import detectability_of, traces_of
from asm_gym.rollouts.seeds import draw_onset, role_seeds
from asm_gym.tasks import task as task_spec

SEVERITIES = "medium", "strong"
"""Of the faults in an examination; mild ones are hardly to be seen."""

PUSH = "push", "medium"
"""Kind and severity of a push of 20 N."""
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

        Then pushes of 20 N, in the last of the scenes.
        """
        seeds = role_seeds(seed, self.task, "nominal", episodes)
        horizon = task_spec(self.task).horizon
        nominal = [EpisodeLabel(self.task, "nominal", seed=s) for s in seeds]
        faults = [(kind, severity) for kind in kinds for severity in SEVERITIES]
        pairs = [(fault, seeds[n % episodes]) for n, fault in enumerate(faults)]
        pairs += [(PUSH, s) for s in seeds[::-1][:pushes] if (PUSH, s) not in pairs]
        return nominal + [EpisodeLabel(self.task, "faulty", *fault, s, draw_onset(s, horizon)) for fault, s in pairs]


class Marks(NamedTuple):
    """What a memory made of one exam.

    Attributes:
        name: of the exam.
        solved: traces of healthy episodes in which the task was solved.
        crashed: of those in which it was, but something pressed twice as hard as is usual under the task's expert.
        failed: of those in which it was not.
        pushes: those of pushes of 20 N.
        metrics: on the other faults that an ideal observer could see. Of all faults those are left out in whose scenes
            the policy crashes by itself.
    """

    name: str
    solved: list[ScoredEpisode]
    crashed: list[ScoredEpisode]
    failed: list[ScoredEpisode]
    pushes: list[ScoredEpisode]
    metrics: DetectionMetrics

    def at(self, threshold: float) -> Marks:
        """What it would have made of it at another threshold."""

        def judged(traces: Sequence[ScoredEpisode]) -> list[ScoredEpisode]:
            return [t.at(threshold) for t in traces]

        solved, crashed, failed, pushes = map(judged, (self.solved, self.crashed, self.failed, self.pushes))
        metrics = DetectionMetrics(self.name, judged(self.metrics.faulty), solved, self.metrics.window_s)
        return Marks(self.name, solved, crashed, failed, pushes, metrics)


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
    done, failed = ([t for t in nominal if t.outcome.success is want] for want in (True, False))
    solved, crashed = ([t for t in done if (t.seed in hit) is want] for want in (False, True))
    return Marks(name, solved, crashed, failed, pushes, DetectionMetrics(name, faults, solved, window))


COLUMNS: Sequence[Column[Marks]] = (
    Column("", lambda m: m.name),
    Column("healthy, alarm", lambda m: count(false_alarms(m.solved))),
    Column("per hour", lambda m: hourly_alarms(m.solved).text),
    Column("crashed, alarm", lambda m: count(false_alarms(m.crashed)) if m.crashed else ""),
    Column("failed, alarm", lambda m: count(false_alarms(m.failed)) if m.failed else ""),
    Column("AUROC", lambda m: f"{m.metrics.auroc:.3f}" if m.metrics.faulty else ""),
    Column("found", lambda m: f"{percent(m.metrics.detected)} of {m.metrics.detected.n}" if m.metrics.faulty else ""),
    Column("median [ms]", lambda m: milliseconds(m.metrics.delays, "median_ms") if m.metrics.faulty else ""),
)


def card(marks: Sequence[Marks], memory: CalibratedMonitor, window: float) -> Table:
    """A row for each exam."""
    about = memory.about
    learned = f"learned from {about['lessons']} lessons of {', '.join(about['tasks'])} ({about['rows']} rows)"
    limit = f"threshold {memory.threshold:.3g} from {about['calibrated_on']} others at {about['false_alarm_rate']:g}"
    return tabulate(
        f"{about['name']}: {learned}, {limit}. Episodes with an alarm, apart those that solved the task, those that "
        "solved it but pressed twice as hard as its expert usually does at most, and those that failed; alarms an hour "
        "of the first, with a 95 % Poisson interval, one that comes back within a minute counted once; faults of "
        f"medium and strong severity that an ideal observer could see, found within {window:g} s.",
        COLUMNS,
        marks,
    )


def summary(marks: Sequence[Marks]) -> str:
    """Alarms, and faults and pushes found, in all exams together."""
    solved = Share.of([bool(t.false_alarms) for m in marks for t in m.solved])
    found = Share(sum(m.metrics.detected.k for m in marks), sum(m.metrics.detected.n for m in marks))
    delays = [t.delay for m in marks for t in m.pushes]
    prompt = Share.of([delay is not None and delay <= PROMPT_S + 1e-9 for delay in delays])
    return (
        f"{count(solved)} healthy episodes alarm, {count(found)} faults found, {count(prompt)} pushes of 20 N "
        f"noticed within {1e3 * PROMPT_S:.0f} ms"
    )


def at_rates(marks: Sequence[Marks], memory: CalibratedMonitor, rates: Sequence[float]) -> str:
    """``summary`` at the memory's threshold, and at that of each of ``rates`` that it can promise."""
    said = [f"In all: {summary(marks)}."]
    for rate in rates:
        with suppress(ValueError):  # it was calibrated on too few
            threshold = memory.threshold_at(rate)
            there = summary([m.at(threshold) for m in marks])
            said.append(f"At the threshold for {rate:g}, {threshold:.3g}: {there}.")
    return " ".join(said)
