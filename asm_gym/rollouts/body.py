"""A memory of a body: learned from babbling, and examined on policies and tasks that it never met."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

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
from asm_gym.rollouts.training.exploration import SHORTEST, Gentle, peak_torques
from asm_gym.tasks import task as task_spec

CALIBRATED_ON = 3
"""One in so many lessons of a task is not learned from: the threshold is set on those."""
TWICE = 2.0
"""How many times what an undisturbed expert usually feels may be felt, before it counts as a hit."""
AROUND_S = 0.2
"""What is left out before and after a hit [s]."""
PASSES = 4
"""Of the temporal network over the lessons."""
SEVERITIES = "medium", "strong"
"""Of the faults in an examination; mild ones are hardly to be seen."""


class Lessons(NamedTuple):
    """Recordings of babbling, as far as they are healthy: to learn from, and others to calibrate on."""

    fit: list[Episode]
    calibration: list[Episode]


def healthy(recordings: Sequence[Episode]) -> Lessons:
    """What of each recording presses less than twice as hard as the undisturbed expert of its task usually does.

    Noise drives arms into tables and joints into their stops. That is no fault of the body, but a memory that takes it
    for usual would be blind to every collision.

    Raises:
        ValueError: a task has no undisturbed lesson that was solved, to measure by, or too little is left.
    """
    felt: dict[str, list[tuple[float, float]]] = {}
    for episode in recordings:
        if _lesson(episode)["noise"] == 0.0 and episode.success:
            most = float(np.nanmax(episode.contact_force)), float(peak_torques(episode).max())
            felt.setdefault(episode.labelled.task, []).append(most)
    missing = {e.labelled.task for e in recordings} - set(felt)
    if missing:
        raise ValueError(
            f"no undisturbed lesson of {', '.join(sorted(missing))} was solved and says what is usual there"
        )
    found = Lessons([], [])
    for episode in recordings:
        limit = Gentle(*(TWICE * np.median(felt[episode.labelled.task], axis=0)))
        learned = _lesson(episode)["number"] % CALIBRATED_ON < CALIBRATED_ON - 1
        (found.fit if learned else found.calibration).extend(gentle_pieces(episode, limit))
    if not all(found):
        raise ValueError(f"{len(recordings)} lessons leave too little that is healthy: record more")
    return found


def gentle_pieces(episode: Episode, limit: Gentle) -> list[Episode]:
    """The stretches of an episode in which nothing presses harder, those that are long enough to learn from."""
    rows = len(episode) // len(episode.contact_force)  # of the stream, in a step
    torques = peak_torques(episode).reshape(-1, rows).max(axis=1)
    hit = ~((episode.contact_force <= limit.force) & (torques <= limit.torque))
    around = round(AROUND_S / (rows * episode.spec.dt))
    near = np.convolve(hit, np.ones(2 * around + 1), "same") > 0.5
    edges = np.flatnonzero(np.diff(np.concatenate([[True], near, [True]]).astype(int)))
    return [
        replace(episode, stream=episode.stream[rows * a : rows * b], contact_force=episode.contact_force[a:b])
        for a, b in zip(edges[::2], edges[1::2], strict=True)
        if b - a >= SHORTEST
    ]


def _lesson(episode: Episode) -> dict[str, Any]:
    lesson: dict[str, Any] = episode.info["lesson"]
    return lesson


def learn_body(lessons: Lessons, rate: float, seed: int, progress: Progress) -> NeuralASM:
    """The memory, calibrated so that a share ``rate`` of healthy lessons that it has not learned from alarms.

    Nothing is measured against a context, which a policy that was never met would lead astray; so the temporal network,
    which makes it, is learned for a few passes alone.
    """
    memory = NeuralASM(lessons.fit[0].spec, epochs=PASSES, habituates=False, seed=seed)
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
