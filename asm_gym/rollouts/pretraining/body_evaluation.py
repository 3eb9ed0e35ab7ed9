"""Evaluate a memory of a body on policies and tasks that it never met."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from itertools import cycle, product
from typing import NamedTuple

import numpy as np

from asm_gym.data.crashes import CRASH, peak_force
from asm_gym.data.episode import Episode
from asm_gym.detection import AdaptiveThreshold
from asm_gym.detection.alarm_rule import KNOCK, STOP
from asm_gym.evaluation.comparison import detectability_of, visible_kinds
from asm_gym.evaluation.defaults import WINDOW_S
from asm_gym.evaluation.detection_tables import kept_rate, milliseconds
from asm_gym.evaluation.metrics import DetectionMetrics, false_alarms, hourly_alarms
from asm_gym.evaluation.scored_episode import ScoredEpisode
from asm_gym.evaluation.scoring import traces_of
from asm_gym.evaluation.statistics import Share
from asm_gym.evaluation.tables import Table, count, percent, tabulate
from asm_gym.monitors import CalibratedMonitor
from asm_gym.rollouts.seeds import role_seeds
from asm_gym.rollouts.trial import Trial, faulty_trial, nominal_trials
from asm_gym.tasks import task as task_spec

PROMISES = (10.0, 5.0, 3.0, 1.0)  # false alarms per hour that a threshold promises
EVALUATED_SEVERITIES = ("medium", "strong")  # of faults; mild ones are hardly detectable
MOST_IN_ALARM = 0.5  # of episodes, that an adaptive threshold may aim for
SCENES = 12  # faults happen in the first so many scenes


class EvaluationCase(NamedTuple):
    """A policy in a task, and whether babbling has shown both."""

    task: str
    policy: str
    known: bool

    @property
    def name(self) -> str:
        """Name for tables."""
        policy = self.policy
        if policy == "scripted":
            policy = "expert"
        if self.known:
            return f"{self.task}, {policy}"
        return f"{self.task}, {policy} (left out)"

    def trials(self, episodes: int, kinds: Sequence[str], seed: int) -> list[Trial]:
        """Return nominal episodes, and in the first scenes a twin for each of ``kinds`` and severity."""
        task = task_spec(self.task)
        seeds = role_seeds(seed, self.task, "nominal", episodes)
        trials = nominal_trials(task.id, "nominal", seeds)
        faults = product(kinds, EVALUATED_SEVERITIES)
        for (kind, severity), scene in zip(faults, cycle(seeds[:SCENES]), strict=False):
            trials.append(faulty_trial(task.id, kind, severity, scene, task.horizon))
        return trials


class Scores(NamedTuple):
    """The result of one case."""

    name: str
    solved: list[ScoredEpisode]  # healthy
    failed: list[ScoredEpisode]
    # on visible faults, but for scenes in which the policy crashes by itself
    metrics: DetectionMetrics

    def at(self, threshold: float) -> Scores:
        """Return the result at another threshold."""
        solved = [trace.at(threshold) for trace in self.solved]
        failed = [trace.at(threshold) for trace in self.failed]
        faulty = [trace.at(threshold) for trace in self.metrics.faulty]
        metrics = DetectionMetrics(self.name, faulty, solved, self.metrics.window_s)
        return Scores(self.name, solved, failed, metrics)

    def adapted(self, per_hour: float) -> Scores:
        """Return the result under an adaptive threshold that aims for so many alarms per hour.

        Healthy episodes move it; faults are judged by its last value.
        """
        if not self.solved:
            return self
        hours_of_episode = hourly_alarms(self.solved).hours / len(self.solved)
        share_in_alarm = min(per_hour * hours_of_episode, MOST_IN_ALARM)
        running = AdaptiveThreshold(share_in_alarm).start(self.solved[0].threshold)
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
    if not known:
        return np.inf
    return float(np.median(known))


def seeds_with_crash(recordings: Sequence[Episode], expert_force: float) -> set[int]:
    """Return the seeds of solved nominal episodes with a far greater force than the expert's usual one [N]."""
    seeds = set()
    for episode in recordings:
        force = usual_force([episode])
        if np.isfinite(force) and force > CRASH * expert_force:
            seeds.add(episode.labelled.seed)
    return seeds


def evaluate_case(
    memory: CalibratedMonitor, name: str, recordings: Sequence[Episode], expert_force: float
) -> Scores:
    """Score the nominal and faulty recordings of a case.

    Args:
        memory: with a threshold.
        name: of the case.
        recordings: of one policy in one task.
        expert_force: usual greatest force of the task's expert [N]; an agent that often crashes is no reference.
    """
    crashed = seeds_with_crash(recordings, expert_force)
    nominal = [e for e in recordings if e.labelled.role == "nominal"]
    faulty = [e for e in recordings if e.labelled.role == "faulty"]
    faulty = [e for e in faulty if e.labelled.seed not in crashed]
    is_visible = visible_kinds(detectability_of(nominal, faulty, WINDOW_S))

    traces = traces_of(name, memory, recordings, memory.threshold)
    healthy = [trace for trace in traces if trace.onset is None]
    solved = [trace for trace in healthy if trace.outcome.success]
    failed = [trace for trace in healthy if not trace.outcome.success]
    faults = [t for t in traces if t.onset is not None and t.seed not in crashed]
    visible = [trace for trace in faults if is_visible[trace.kind, trace.severity]]
    return Scores(name, solved, failed, DetectionMetrics(name, visible, solved, WINDOW_S))


def _where_faulty(cell_of: Callable[[DetectionMetrics], str]) -> Callable[[Scores], str]:
    """Return a cell of the metrics on faults; empty without any fault."""

    def cell(scores: Scores) -> str:
        if not scores.metrics.faulty:
            return ""
        return cell_of(scores.metrics)

    return cell


def _excused_per_hour(event: str) -> Callable[[Scores], str]:
    """Return a cell of how often an event excused surprise in healthy episodes."""

    def cell(scores: Scores) -> str:
        if not scores.solved:
            return ""
        return f"{hourly_alarms(scores.solved, event).value:.0f}"

    return cell


def _failed_with_alarm(scores: Scores) -> str:
    if not scores.failed:
        return ""
    return count(false_alarms(scores.failed))


def _found(metrics: DetectionMetrics) -> str:
    return f"{percent(metrics.detected)} of {metrics.detected.n}"


COLUMNS: dict[str, Callable[[Scores], str]] = {
    "": lambda scores: scores.name,
    "hours": lambda scores: f"{hourly_alarms(scores.solved).hours:.2f}",
    "faults/h": lambda scores: hourly_alarms(scores.solved).text,
    "knocks/h": _excused_per_hour(KNOCK),
    "stops/h": _excused_per_hour(STOP),
    "failed, alarm": _failed_with_alarm,
    "AUROC": _where_faulty(lambda metrics: f"{metrics.auroc:.3f}"),
    "found": _where_faulty(_found),
    "median [ms]": _where_faulty(lambda metrics: milliseconds(metrics.delays.median_ms)),
}


def scores_table(scores: Sequence[Scores], memory: CalibratedMonitor) -> Table:
    """Return a row for each case."""
    about = memory.about
    per_hour = about["false_alarms_per_hour"]
    caption = (
        f"{about['name']}: learned from {about['lessons']} lessons of {', '.join(about['tasks'])}; "
        f"threshold {memory.threshold:.3g} for {per_hour:g} false alarms per hour, from "
        f"{about['hours']:.2f} other hours. Alarms per hour of solved healthy episodes, with 95 % "
        "Poisson intervals; failed episodes with an alarm; visible faults of medium and strong "
        f"severity, found within {WINDOW_S:g} s. Adaptive: under a threshold that follows each "
        "policy, and for faults at its last value."
    )
    columns = dict(COLUMNS)
    for name in ("faults/h", "found"):
        columns[f"{name}, adaptive"] = partial(_adaptive_cell, COLUMNS[name], per_hour)
    return tabulate(caption, columns, scores)


def _adaptive_cell(cell: Callable[[Scores], str], per_hour: float, scores: Scores) -> str:
    return cell(scores.adapted(per_hour))


def all_episodes(
    scores: Sequence[Scores],
) -> tuple[list[ScoredEpisode], list[ScoredEpisode]]:
    """Return the healthy and the faulty episodes of all cases."""
    healthy = [trace for each in scores for trace in each.solved]
    faulty = [trace for each in scores for trace in each.metrics.faulty]
    return healthy, faulty


def promises_table(scores: Sequence[Scores], thresholds: Mapping[float, float]) -> Table:
    """Return a row for each promise, with its threshold, the false alarms, and the faults found.

    Args:
        scores: of all cases.
        thresholds: by the false alarms per hour that each promises.
    """
    healthy, faulty = all_episodes(scores)
    severities = {
        f"{' and '.join(EVALUATED_SEVERITIES)} found": EVALUATED_SEVERITIES,
        "mild found": ("mild",),
    }
    for heading, names in list(severities.items()):
        if not any(trace.severity in names for trace in faulty):
            del severities[heading]
    rows = []
    for promised, threshold in thresholds.items():
        solved, faults = all_episodes([each.at(threshold) for each in scores])
        alarms = kept_rate(hourly_alarms(solved), promised)
        knocks = hourly_alarms(solved, KNOCK).value
        stops = hourly_alarms(solved, STOP).value
        row = [f"{promised:g}", f"{threshold:.3g}", alarms, f"{knocks:.1f}", f"{stops:.1f}"]
        for names in severities.values():
            of_severity = [trace for trace in faults if trace.severity in names]
            row.append(_found(DetectionMetrics("", of_severity, [], WINDOW_S)))
        rows.append(tuple(row))
    hours = hourly_alarms(healthy).hours
    caption = (
        f"By promise: alarms per hour in the {hours:.2f} healthy hours of these exams, with 95 % "
        "Poisson intervals; alarms within a minute count once. Broken: the interval lies above the "
        f"promise. Found: faults that an ideal observer could see, within {WINDOW_S:g} s."
    )
    headings = ("promised", "threshold", "false alarms", "knocks", "stops", *severities)
    return Table(caption, headings, rows)


def summary(scores: Sequence[Scores]) -> str:
    """Return one line: alarms, and faults found, in all cases together."""
    healthy, _ = all_episodes(scores)
    fault = hourly_alarms(healthy)
    knock = hourly_alarms(healthy, KNOCK)
    stop = hourly_alarms(healthy, STOP)
    found = Share.total([each.metrics.detected for each in scores])
    return (
        f"In all: {fault.text} faults, {knock.text} knocks, {stop.text} stops an hour in "
        f"{fault.hours:.2f} healthy hours, {count(found)} faults found."
    )
