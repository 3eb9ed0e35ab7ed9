"""Examine a memory of a body on policies and tasks that it never met."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import NamedTuple, Protocol

import numpy as np

from asm_gym.data.crashes import CRASH, peak_force
from asm_gym.data.episode import Episode
from asm_gym.detection import AdaptiveThreshold
from asm_gym.detection.alarm_rule import KNOCK, STOP
from asm_gym.evaluation.comparison import detectability_of, visible_kinds
from asm_gym.evaluation.detection_tables import kept_rate, milliseconds
from asm_gym.evaluation.metrics import DetectionMetrics, false_alarms, hourly_alarms
from asm_gym.evaluation.scored_episode import NOMINAL, ScoredEpisode
from asm_gym.evaluation.scoring import traces_of
from asm_gym.evaluation.statistics import Share
from asm_gym.evaluation.tables import Table, count, percent, tabulate
from asm_gym.monitors import CalibratedMonitor
from asm_gym.rollouts.seeds import role_seeds
from asm_gym.rollouts.trial import Trial, faulty_trial, nominal_trials
from asm_gym.tasks import task as task_spec

PROMISES = (10.0, 5.0, 3.0, 1.0)  # false alarms per hour that a threshold promises
SEVERITIES = "medium", "strong"  # of the faults in an examination; mild ones are hardly detectable
MOST_IN_ALARM = 0.5  # of episodes, that an adaptive threshold may aim for
SCENES = 12  # faults happen in the first so many scenes


class Exam(NamedTuple):
    """A policy in a task, and whether babbling has shown both."""

    task: str
    policy: str
    known: bool

    @property
    def name(self) -> str:
        """Name for tables."""
        policy = "expert" if self.policy == "scripted" else self.policy
        return f"{self.task}, {policy}{'' if self.known else ' (left out)'}"

    def trials(self, episodes: int, kinds: Sequence[str], seed: int) -> list[Trial]:
        """Return nominal episodes, and in the first scenes a twin for each of ``kinds`` and severity."""
        seeds, task = role_seeds(seed, self.task, "nominal", episodes), task_spec(self.task)
        scenes = seeds[:SCENES]
        faults = [(kind, severity) for kind in kinds for severity in SEVERITIES]
        return nominal_trials(task.id, "nominal", seeds) + [
            faulty_trial(task.id, *fault, scenes[n % len(scenes)], task.horizon)
            for n, fault in enumerate(faults)
        ]


class Follows(Protocol):
    """A threshold that each episode moves."""

    @property
    def value(self) -> float:
        """Its present value."""

    def follow(self, largest: float) -> None:
        """Move after an episode of this greatest surprise."""


class Marks(NamedTuple):
    """The result of one exam."""

    name: str
    solved: list[ScoredEpisode]  # healthy
    failed: list[ScoredEpisode]
    metrics: (
        DetectionMetrics  # on visible faults, but for scenes in which the policy crashes by itself
    )

    def at(self, threshold: float) -> Marks:
        """Return the result at another threshold."""
        parts = self.solved, self.failed, self.metrics.faulty
        solved, failed, faulty = ([t.at(threshold) for t in traces] for traces in parts)
        return Marks(
            self.name,
            solved,
            failed,
            DetectionMetrics(self.name, faulty, solved, self.metrics.window_s),
        )

    def adapted(self, per_hour: float) -> Marks:
        """Return the result under a threshold that follows the policy; faults are judged by its last value."""
        if not self.solved:
            return self
        share = min(per_hour * hourly_alarms(self.solved).hours / len(self.solved), MOST_IN_ALARM)
        return self.under(AdaptiveThreshold(share).start(self.solved[0].threshold))

    def under(self, running: Follows) -> Marks:
        """Return the result under a threshold that healthy episodes move; faults are judged by its last value."""
        solved = []
        for trace in self.solved:
            solved.append(trace.at(running.value))
            running.follow(float(trace.surprise.max()))
        last = self.at(running.value)
        return last._replace(solved=solved, metrics=replace(last.metrics, nominal=solved))


def usual_force(recordings: Sequence[Episode]) -> float:
    """Return the median of the greatest forces of solved healthy episodes [N]; infinite where unknown."""
    peaks = [peak_force(e) for e in recordings if e.labelled.role == "nominal" and e.success]
    known = [peak for peak in peaks if np.isfinite(peak)]
    return float(np.median(known)) if known else np.inf


def examine(
    memory: CalibratedMonitor, name: str, recordings: Sequence[Episode], window: float, usual: float
) -> Marks:
    """Score the nominal and faulty recordings of an exam, detected within a ``window`` [s] of the onset.

    ``usual`` is the usual greatest force of the task's expert [N]; that of an agent that often crashes is no reference.
    """
    traces = traces_of(name, memory, recordings, memory.threshold)
    crashed = {e.labelled.seed for e in recordings if CRASH * usual < usual_force([e]) < np.inf}
    twins = [r for r in recordings if r.labelled.role == "nominal"]
    faulty = [
        r for r in recordings if r.labelled.role == "faulty" and r.labelled.seed not in crashed
    ]
    seen = visible_kinds(detectability_of(twins, faulty, window))
    visible = [
        t
        for t in traces
        if t.onset is not None and t.seed not in crashed and seen[t.kind, t.severity]
    ]
    nominal = [t for t in traces if t.kind == NOMINAL]
    solved, failed = ([t for t in nominal if t.outcome.success is want] for want in (True, False))
    return Marks(name, solved, failed, DetectionMetrics(name, visible, solved, window))


COLUMNS: dict[str, Callable[[Marks], str]] = {
    "": lambda m: m.name,
    "hours": lambda m: f"{hourly_alarms(m.solved).hours:.2f}",
    "faults/h": lambda m: hourly_alarms(m.solved).text,
    "knocks/h": lambda m: f"{hourly_alarms(m.solved, KNOCK).value:.0f}" if m.solved else "",
    "stops/h": lambda m: f"{hourly_alarms(m.solved, STOP).value:.0f}" if m.solved else "",
    "failed, alarm": lambda m: count(false_alarms(m.failed)) if m.failed else "",
    "AUROC": lambda m: f"{m.metrics.auroc:.3f}" if m.metrics.faulty else "",
    "found": lambda m: (
        f"{percent(m.metrics.detected)} of {m.metrics.detected.n}" if m.metrics.faulty else ""
    ),
    "median [ms]": lambda m: milliseconds(m.metrics.delays.median_ms) if m.metrics.faulty else "",
}


def card(marks: Sequence[Marks], memory: CalibratedMonitor, window: float) -> Table:
    """Return a row for each exam."""
    about = memory.about
    caption = (
        f"{about['name']}: learned from {about['lessons']} lessons of {', '.join(about['tasks'])}; threshold "
        f"{memory.threshold:.3g} for {about['false_alarms_per_hour']:g} false alarms per hour, from "
        f"{about['hours']:.2f} other hours. Alarms per hour of solved healthy episodes, with 95 % Poisson intervals; "
        "failed episodes with an alarm; visible faults of medium and strong severity, found within "
        f"{window:g} s. Adaptive: under a threshold that follows each policy, and for faults at its last value."
    )
    columns = dict(COLUMNS)
    for name in ("faults/h", "found"):
        columns[f"{name}, adaptive"] = partial(
            lambda own, m: own(m.adapted(about["false_alarms_per_hour"])), COLUMNS[name]
        )
    return tabulate(caption, columns, marks)


def together(marks: Sequence[Marks]) -> tuple[list[ScoredEpisode], list[ScoredEpisode]]:
    """Return the healthy and the faulty episodes of all exams."""
    return [t for m in marks for t in m.solved], [t for m in marks for t in m.metrics.faulty]


def promises_table(
    marks: Sequence[Marks], thresholds: Mapping[float, float], window: float
) -> Table:
    """Return a row for each promise: its threshold, alarms that came, and faults found within ``window`` [s]."""
    solved, faults = together(marks)
    severities = {f"{' and '.join(SEVERITIES)} found": SEVERITIES, "mild found": ("mild",)}
    shown = {
        n: which for n, which in severities.items() if any(t.severity in which for t in faults)
    }
    rows = []
    for promised, threshold in thresholds.items():
        healthy, faulty = together([m.at(threshold) for m in marks])
        excused = (f"{hourly_alarms(healthy, event).value:.1f}" for event in (KNOCK, STOP))
        own = ([t for t in faulty if t.severity in which] for which in shown.values())
        found = (
            f"{percent(DetectionMetrics('', ts, [], window).detected)} of {len(ts)}" for ts in own
        )
        rows.append(
            (
                f"{promised:g}",
                f"{threshold:.3g}",
                kept_rate(hourly_alarms(healthy), promised),
                *excused,
                *found,
            )
        )
    caption = (
        f"By promise: alarms per hour in the {hourly_alarms(solved).hours:.2f} healthy hours of these exams, with 95 % "
        "Poisson intervals; alarms within a minute count once. Broken: the interval lies above the promise. Found: "
        f"faults that an ideal observer could see, within {window:g} s."
    )
    return Table(
        caption, ("promised", "threshold", "false alarms", "knocks", "stops", *shown), rows
    )


def summary(marks: Sequence[Marks]) -> str:
    """Return one line: alarms, and faults found, in all exams together."""
    solved, _ = together(marks)
    fault, knock, stop = (hourly_alarms(solved, event) for event in ("", KNOCK, STOP))
    found = Share(
        sum(m.metrics.detected.k for m in marks), sum(m.metrics.detected.n for m in marks)
    )
    return (
        f"In all: {fault.text} faults, {knock.text} knocks, {stop.text} stops an hour in {fault.hours:.2f} healthy "
        f"hours, {count(found)} faults found."
    )
