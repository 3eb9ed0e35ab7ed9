"""Records one labelled episode: nominal, faulty, or under a harmless variation."""

from __future__ import annotations

import zlib
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from asm_gym.episodes import Episode, EpisodeLabel, save_episode
from asm_gym.faults.suite import harmless_variation, suite_fault
from asm_gym.policies import make_policy, rollout
from asm_gym.policies.scripted.base import Style
from asm_gym.rollouts.parallel import environment
from asm_gym.stream import control_period
from asm_gym.wrappers import FaultInjection, StreamRecorder

EXECUTIONS = {"slower": 0.85, "faster": 1.15}
"""Harmless variations of the expert itself: its speed."""


@dataclass(frozen=True)
class Course:
    """How the episodes of a run are made.

    Args:
        robot: the arm.
        policy: what acts.
        after_s: how long a faulty episode goes on after its onset [s].
        stream_freq: rows of the stream a second [Hz]; None for one each control step.
    """

    robot: str = "Panda"
    policy: str = "scripted"
    after_s: float = 2.0
    stream_freq: int | None = None

    def settings(self) -> tuple[tuple[str, Any], ...]:
        """What the environment is made with."""
        return ("robot", self.robot), ("stream_freq", self.stream_freq)


def episode_seeds(seed: int, task: str, role: str, episodes: int) -> list[int]:
    """One seed an episode; those of different tasks and roles have nothing in common."""
    entropy = np.random.SeedSequence([seed, zlib.crc32(f"{task}/{role}".encode())])
    return [int(s) for s in entropy.generate_state(episodes, np.uint32) // 2]


def draw_onset(seed: int, horizon: int) -> int:
    """When a fault begins in the episode of ``seed``: after its first 10 steps, in its first half."""
    return int(np.random.default_rng([seed, 1]).integers(10, max(11, horizon // 2)))


def record(label: EpisodeLabel, course: Course, folder: Path) -> Path:
    """Records the episode of ``label``, and writes it to its place under ``folder``."""
    base = environment(f"asm_gym/{label.task}-v0", course.settings())
    inner: Any = base.unwrapped
    onset, style, faults, steps = label.onset or 0, Style(), [], None
    if label.role == "faulty":
        faults = [suite_fault(label.kind, inner, label.severity, onset, label.seed)]
        steps = onset + round(course.after_s / control_period(inner))
    elif label.kind in EXECUTIONS:
        style = Style(speed=EXECUTIONS[label.kind])
    elif label.role == "harmless":
        faults = [harmless_variation(label.kind, inner, onset, label.seed)]
    env = StreamRecorder(FaultInjection(base, faults))
    forces: list[float] = []
    kwargs: dict[str, Any] = {"style": style} if course.policy == "scripted" else {}
    policy = make_policy(course.policy, env, seed=label.seed, **kwargs)
    try:
        rollout(env, policy, label.seed, lambda info: forces.append(info["contact_force"]), steps)
    finally:
        env.get_wrapper_attr("undo_faults")()
    guilty = faults[0].labels(inner) if label.role == "faulty" else frozenset()
    recorded = env.finish()
    kept = Episode(  # what monitors look at: actions stand in the stream, and nobody learns to act from these
        stream=recorded.stream,
        spec=recorded.spec,
        success=recorded.success,
        seed=label.seed,
        faults=recorded.faults,
        contact_force=np.asarray(forces, np.float32),
        label=replace(label, affected_channels=frozenset(guilty)),
        info={"skill": label.task},
    )
    return save_episode(folder / label.path, kept)
