"""One episode to run, in words: which environment and seed, what goes wrong and when, and what acts."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import gymnasium as gym

from asm_gym.episode import EpisodeLabel
from asm_gym.evaluation.scored_episode import IDEAL, NOMINAL, POLICY_ALONE
from asm_gym.faults import Fault
from asm_gym.policies import Policy
from asm_gym.rollouts.seeds import draw_onset
from asm_gym.spec import control_period
from asm_gym.tasks import env_id

Settings = tuple[tuple[str, Any], ...]
"""Arguments by name, in an order of their own."""
PolicySource = str | Path | Policy | Callable[[gym.Env[Any, Any]], Policy]
"""What ``make_policy`` takes, whatever has ``predict``, or what makes one for an environment."""

PASSING = "passing_push"
"""20 N for 0.3 s: a kind beside those of the suite."""
EXECUTIONS = {"slower": 0.85, "faster": 1.15}
"""Harmless variations of the expert itself: its speed."""
AFTER_S = 2.0
"""How long a faulty episode is recorded after its onset [s]."""


@dataclass(frozen=True)
class RolloutConfig:
    """How the episodes of a run are made.

    Args:
        policy: what acts.
        robot: the arm; the task's own by default.
        stream_freq: rows of the stream a second [Hz]; one each control step by default.
        env_kwargs: what ``gym.make`` is given besides.
    """

    policy: PolicySource = "scripted"
    robot: str | None = None
    stream_freq: int | None = None
    env_kwargs: Settings = ()

    @property
    def settings(self) -> Settings:
        """What the environment is made with."""
        named = ("robot", self.robot), ("stream_freq", self.stream_freq)
        return (*((name, value) for name, value in named if value is not None), *self.env_kwargs)


@dataclass(frozen=True)
class Trial:
    """One episode to run.

    Args:
        env_id: such as ``asm_gym/Lift-v0``.
        seed: of the environment and of the policy: trials that differ only in ``acting`` are paired by it.
        kind: ``"nominal"``, ``"passing_push"``, a kind of fault or harmless variation of the suite, or, with
            ``faults``, what to call them.
        severity: of a fault of the suite.
        onset: when it begins [steps]; by default drawn from the seed, in the first half of the episode.
        faults: what goes wrong, in place of what ``kind`` names.
        acting: ``"policy alone"``, ``"ideal"`` for a reflex that is told what is wrong and when, or what ``on_alarm``
            takes.
        after_s: where to leave the episode, counted from the onset [s]; at its end by default.
    """

    env_id: str
    seed: int
    kind: str = NOMINAL
    severity: str = ""
    onset: int | None = None
    faults: tuple[Fault, ...] | None = None
    acting: str = POLICY_ALONE
    after_s: float | None = None

    @classmethod
    def of(cls, label: EpisodeLabel) -> Trial:
        """The trial that is recorded as ``label`` says."""
        after = AFTER_S if label.role == "faulty" else None
        kind = label.kind or NOMINAL
        return cls(env_id(label.task), label.seed, kind, label.severity, label.onset, after_s=after)

    @property
    def task(self) -> str:
        """The name in the id: ``"Lift"`` of ``asm_gym/Lift-v0``."""
        return self.env_id.rsplit("/", 1)[-1].rsplit("-v", 1)[0]

    @property
    def on_alarm(self) -> str:
        """What the safety wrapper is told."""
        return "monitor" if self.acting in (POLICY_ALONE, IDEAL) else self.acting

    def begins(self, env: gym.Env[Any, Any]) -> int:
        """When in ``env`` something goes wrong, or would [steps]."""
        if self.onset is not None or self.faults:
            return self.onset if self.onset is not None else min(f.onset for f in self.faults or ())
        return draw_onset(self.seed, horizon_of(env))

    def steps_in(self, env: gym.Env[Any, Any]) -> int | None:
        """Where the episode is left; None for its end."""
        return None if self.after_s is None else self.begins(env) + round(self.after_s / control_period(env))


def horizon_of(env: gym.Env[Any, Any]) -> int:
    """Control steps of an episode; 0 where nobody says."""
    limit = env.spec.max_episode_steps if env.spec else None
    return int(getattr(env.unwrapped, "horizon", limit) or 0)
