"""What ``asm-gym reproduce transfer`` watches: policies and tasks, and the recording of their episodes."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import gymnasium as gym

from asm_gym.episode import EpisodeLabel
from asm_gym.faults.suite import kinds_of, possible
from asm_gym.policies import Policy
from asm_gym.rollouts.pretraining.babbling import Babbler, Lesson
from asm_gym.rollouts.pretraining.model_card import SEVERITIES
from asm_gym.rollouts.record import record
from asm_gym.rollouts.seeds import draw_onset, role_seeds
from asm_gym.rollouts.staging import environment
from asm_gym.rollouts.trial import RolloutConfig
from asm_gym.tasks import task as task_spec

KNOWN, POLICIES, TASKS = "experts it knows", "policies never met", "tasks never met"
SMOOTH = 0.2, 0.9
"""Standard deviation [action units] and correlation from step to step of the noise on the expert's commands."""


class Watched(NamedTuple):
    """A policy in a task.

    Attributes:
        task: its name.
        policy: a name or a file; the expert's at another speed or with noise where those say so.
        speed: relative to the expert's own.
        noise: standard deviation of smooth noise on the commands [action units].
        group: what of it the memory of the body has met.
    """

    task: str
    policy: str = "scripted"
    speed: float = 1.0
    noise: float = 0.0
    group: str = KNOWN

    @property
    def name(self) -> str:
        """For people."""
        who = "expert" if self.policy == "scripted" else " ".join(Path(self.policy).with_suffix("").parts[-2:])
        how = f" at {self.speed:g} of its speed" if self.speed != 1.0 else ""
        return f"{self.task}, {who}{how}" + (" with smooth noise" if self.noise else "")

    @property
    def folder(self) -> str:
        """Of its recordings."""
        return self.name.replace(", ", "-").replace(" ", "_")

    def act(self, env: gym.Env[Any, Any], seed: int) -> Policy:
        """The expert, as it is to be."""
        lesson = Lesson(self.task, 0, seed, noise=self.noise, smoothness=SMOOTH[1], speed=self.speed)
        return Babbler(env, lesson)

    def labels(
        self, nominal: int, own: int, faults: Sequence[str], faulty: int, calibration: int | None = None
    ) -> list[EpisodeLabel]:
        """Healthy episodes, twins of the first of them with faults, and others to specialise on.

        Args:
            nominal: healthy episodes to watch.
            own: to learn from.
            calibration: to calibrate on, by default as many; fewer to learn from are the first of more.
            faults: kinds, or halves of the suite.
            faulty: episodes of each kind and severity.
        """
        task = self.task
        roles = {"nominal": nominal, "fit": own, "calibration": own if calibration is None else calibration}
        found = [EpisodeLabel(task, r, seed=s) for r, n in roles.items() for s in role_seeds(0, task, r, n)]
        if not faulty:
            return found
        inner: Any = environment(task_spec(task).id).unwrapped
        return found + [
            EpisodeLabel(task, "faulty", kind, severity, s, draw_onset(s, task_spec(task).horizon))
            for kind in kinds_of(faults)
            if possible(kind, inner)
            for severity in SEVERITIES
            for s in role_seeds(0, task, "nominal", faulty)
        ]


WATCHED = (
    *(Watched(task) for task in ("Lift", "Stack", "Door")),
    *(Watched(t, f"{t.lower()}_sac", group=POLICIES) for t in ("Lift", "Stack", "Door")),
    *(Watched(t, speed=speed, group=POLICIES) for speed in (0.5, 1.5) for t in ("Lift", "Stack")),
    *(Watched(t, noise=SMOOTH[0], group=POLICIES) for t in ("Lift", "Stack")),
    *(Watched(t, group=TASKS) for t in ("PickPlaceMilk", "NutAssemblyRound")),
)


def record_watched(job: tuple[Watched, EpisodeLabel], folder: Path) -> Path:
    """Records one episode of a policy that is watched."""
    watched, label = job
    own = watched.speed != 1.0 or watched.noise > 0.0
    policy = partial(watched.act, seed=label.seed) if own else watched.policy
    return record(label, RolloutConfig(policy), folder / watched.folder)
