"""A memory of a body: learned from babbling, and examined on policies and tasks that it never met."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from asm_gym.episodes import Episode, EpisodeLabel
from asm_gym.evaluation.comparison import visible_kinds
from asm_gym.evaluation.metrics import DetectionMetrics
from asm_gym.evaluation.trace import NOMINAL, Trace
from asm_gym.faults.suite import KINDS
from asm_gym.monitors import CalibratedMonitor, NeuralASM
from asm_gym.monitors.base import Progress
from asm_gym.rollouts.benchmark import detectability_of, traces_of
from asm_gym.rollouts.folder import labelled
from asm_gym.rollouts.seeds import draw_onset, role_seeds
from asm_gym.rollouts.training.exploration import SHORTEST, Gentle, peak_torques, until_contact
from asm_gym.tasks import task as task_spec

CALIBRATED_ON = 3
"""One in so many lessons of a task is not learned from: the threshold is set on those."""
SEVERITIES = "medium", "strong"
"""Of the faults in an examination; mild ones are hardly to be seen."""


class Lessons(NamedTuple):
    """Recordings of babbling, as far as they are healthy."""

    fit: list[Episode]
    calibration: list[Episode]


def healthy(recordings: Sequence[Episode]) -> Lessons:
    """Each recording up to where it presses harder than any undisturbed expert of its task.

    Noise drives arms into tables and joints into their stops. That is no fault of the body, but a memory that takes it
    for usual would be blind to every collision.

    Raises:
        ValueError: a task has no undisturbed lesson to measure by, or too little is left.
    """
    limits: dict[str, Gentle] = {}
    for episode in recordings:
        if _lesson(episode)["noise"] == 0.0:
            task, known = episode.labelled.task, Gentle(0.0, 0.0)
            felt = float(np.nanmax(episode.contact_force)), float(peak_torques(episode).max())
            limits[task] = Gentle(*np.maximum(limits.get(task, known), felt))
    missing = {e.labelled.task for e in recordings} - set(limits)
    if missing:
        raise ValueError(f"no undisturbed lesson of {', '.join(sorted(missing))} says what is usual there")
    found = Lessons([], [])
    for episode in recordings:
        kept = until_contact(episode, episode.contact_force, limits[episode.labelled.task])
        if len(kept) >= SHORTEST * len(episode) // max(1, len(episode.contact_force)):
            last = _lesson(episode)["number"] % CALIBRATED_ON == CALIBRATED_ON - 1
            (found.calibration if last else found.fit).append(kept)
    if not (found.fit and found.calibration):
        raise ValueError(f"{len(recordings)} lessons leave too little that is healthy: record more")
    return found


def _lesson(episode: Episode) -> dict[str, float]:
    lesson: dict[str, float] = episode.info["lesson"]
    return lesson


def learn_body(lessons: Lessons, rate: float, seed: int, progress: Progress) -> NeuralASM:
    """The memory, calibrated so that a share ``rate`` of the lessons it has not learned from alarms."""
    memory = NeuralASM(lessons.fit[0].spec, seed=seed)
    return memory.fit(lessons.fit, progress).calibrate(lessons.calibration, rate)


class Exam(NamedTuple):
    """A policy in a task, and whether babbling has shown either."""

    task: str
    policy: str
    known: bool

    @property
    def name(self) -> str:
        """For people."""
        who = "expert" if self.policy == "scripted" else self.policy
        return f"{self.task}, {who}" + ("" if self.known else " (left out)")

    def labels(self, episodes: int, faults: int, seed: int) -> list[EpisodeLabel]:
        """Nominal episodes, and twins of the first of them with a fault of each kind and severity.

        Args:
            faults: of each kind and severity.
        """
        seeds = role_seeds(seed, self.task, "nominal", episodes)
        horizon = task_spec(self.task).horizon
        nominal = [EpisodeLabel(self.task, "nominal", seed=s) for s in seeds]
        return nominal + [
            EpisodeLabel(self.task, "faulty", kind, severity, s, draw_onset(s, horizon))
            for kind in KINDS
            for severity in SEVERITIES
            for s in seeds[:faults]
        ]


class Marks(NamedTuple):
    """What a memory made of one exam.

    Attributes:
        name: of the exam.
        solved: traces of healthy episodes in which the task was solved.
        failed: traces of healthy episodes in which it was not.
        metrics: on the faults that an ideal observer could see.
    """

    name: str
    solved: list[Trace]
    failed: list[Trace]
    metrics: DetectionMetrics


def examine(
    memory: CalibratedMonitor, exam: Exam, folder: Path, labels: Sequence[EpisodeLabel], window: float
) -> Marks:
    """What ``memory`` makes of the recordings of these labels; faults are to be found within ``window`` [s]."""
    recordings = labelled(folder, labels)
    traces = traces_of(exam.name, memory, recordings, memory.threshold)
    nominal = [t for t in traces if t.kind == NOMINAL]
    twins = [r for r in recordings if r.labelled.role == "nominal"]
    faulty = [r for r in recordings if r.labelled.role == "faulty"]
    seen = visible_kinds(detectability_of(twins, faulty, window))
    faults = [t for t in traces if t.onset is not None and seen[t.kind, t.severity]]
    solved, failed = ([t for t in nominal if t.outcome.success is want] for want in (True, False))
    return Marks(exam.name, solved, failed, DetectionMetrics(exam.name, faults, nominal, window))
