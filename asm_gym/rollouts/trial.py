"""One episode to run: environment, seed, what goes wrong and when, how to respond; and the trials of an evaluation."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from typing import Any

import gymnasium as gym

from asm_gym.control_period import control_period
from asm_gym.data.episode import EpisodeLabel
from asm_gym.envs.robosuite_env import RobosuiteEnv
from asm_gym.evaluation.scored_episode import NOMINAL, POLICY_ALONE
from asm_gym.faults import Fault, foreign_faults
from asm_gym.faults.foreign_faults import FaultyInterface
from asm_gym.faults.suite import KINDS, kinds_of, possible
from asm_gym.policies import Policy, make_policy
from asm_gym.rollouts.seeds import draw_onset, role_seeds

Settings = tuple[tuple[str, Any], ...]  # arguments by name, in a fixed order
PolicySource = str | Path | Policy | Callable[[gym.Env[Any, Any]], Policy]
"""What ``make_policy`` takes, any object with ``predict``, or a factory for an environment."""

PASSING = "passing_push"  # 20 N for 0.3 s: a kind beside those of the suite
AFTER_S = 2.0  # how long a faulty episode is recorded after its onset [s]


@dataclass(frozen=True)
class RolloutConfig:
    """How the episodes of a run are made."""

    policy: PolicySource = "scripted"
    robot: str | None = None  # by default the arm of the task
    stream_freq: int | None = None  # rows a second [Hz]; by default one a control step
    env_kwargs: Settings = ()  # further arguments of ``gym.make``

    @property
    def settings(self) -> Settings:
        """Arguments of ``gym.make``."""
        named: dict[str, Any] = {"robot": self.robot, "stream_freq": self.stream_freq}
        given = tuple((name, value) for name, value in named.items() if value is not None)
        return given + self.env_kwargs


@dataclass(frozen=True)
class Trial:
    """One episode to run."""

    env_id: str
    seed: int  # of the environment and of the policy: trials that share it are twins
    # ``NOMINAL``, ``PASSING``, or a kind of the suite; with ``faults`` it only names them
    kind: str = NOMINAL
    severity: str = ""
    # [steps]; by default drawn from the seed, in the first half of the episode
    onset: int | None = None
    faults: tuple[Fault, ...] | None = None
    acting: str = POLICY_ALONE  # or the response to an alarm, a value of ``on_alarm``
    # how long the episode goes on after the onset [s]; by default to its end
    after_s: float | None = None
    role: str = "nominal"  # or ``"fit"``, ``"calibration"``, ``"faulty"``, ``"babble"``

    @property
    def task(self) -> str:
        """The task of the environment."""
        return task_in(self.env_id)

    @property
    def label(self) -> EpisodeLabel:
        """The label of its recording."""
        kind = ""
        if self.role == "faulty":
            kind = self.kind
        return EpisodeLabel(
            task=self.task,
            role=self.role,
            kind=kind,
            severity=self.severity,
            seed=self.seed,
            onset=self.onset,
        )

    @property
    def on_alarm(self) -> str:
        """The response of the safety wrapper."""
        if self.acting == POLICY_ALONE:
            return "monitor"
        return self.acting

    def onset_in(self, env: gym.Env[Any, Any]) -> int:
        """Return the first control step with the fault, in ``env``."""
        if self.onset is not None:
            return self.onset
        if self.faults:
            return min(fault.onset for fault in self.faults)
        return draw_onset(self.seed, horizon_of(env))

    def steps_in(self, env: gym.Env[Any, Any]) -> int | None:
        """Return how many control steps are run in ``env``; None for all of the episode."""
        if self.after_s is None:
            return None
        return self.onset_in(env) + round(self.after_s / control_period(env))


def task_in(env_id: str) -> str:
    """Return the name in an id: ``"Lift"`` of ``asm_gym/Lift-v0``."""
    return env_id.rsplit("/", 1)[-1].rsplit("-v", 1)[0]


def nominal_trials(env_id: str, role: str, seeds: list[int]) -> list[Trial]:
    """Return an episode without a fault for each seed."""
    return [Trial(env_id, seed, role=role) for seed in seeds]


def faulty_trial(env_id: str, kind: str, severity: str, seed: int, horizon: int) -> Trial:
    """Return the twin of a nominal episode with a fault of the suite, up to ``AFTER_S`` after its onset."""
    onset = draw_onset(seed, horizon)
    return Trial(env_id, seed, kind, severity, onset, after_s=AFTER_S, role="faulty")


def horizon_of(env: gym.Env[Any, Any]) -> int:
    """Return the control steps of an episode; 0 where unknown."""
    steps = None
    if env.spec:
        steps = env.spec.max_episode_steps
    return int(getattr(env.unwrapped, "horizon", steps) or 0)


def kinds_in(env: gym.Env[Any, Any], faults: Sequence[str]) -> list[str]:
    """Return those of the kinds ``faults`` that are possible in ``env``; of all kinds if it is empty."""
    inner = env.unwrapped
    if not isinstance(inner, RobosuiteEnv):
        FaultyInterface(env)  # raises TypeError for spaces that no fault can act on
        return list(faults or foreign_faults.KINDS)
    kinds = kinds_of(faults or tuple(KINDS))
    return [kind for kind in kinds if possible(kind, inner)]


def evaluation_trials(
    env_id: str,
    name: str,
    config: RolloutConfig,
    episodes: Mapping[str, int],
    faults: Sequence[str],
    severities: Sequence[str],
    seed: int,
) -> list[Trial]:
    """Return nominal episodes of a task by role, and faulty twins of some; raise ValueError for an unfit policy."""
    with closing(gym.make(env_id, **dict(config.settings))) as env:
        make_policy(str(config.policy), env, seed=0)  # raises ValueError if it does not fit
        kinds = kinds_in(env, faults)
        horizon = horizon_of(env)
    roles = ("fit", "calibration", "nominal")
    seeds = {role: role_seeds(seed, name, role, episodes[role]) for role in roles}
    trials = [trial for role in roles for trial in nominal_trials(env_id, role, seeds[role])]
    twins = seeds["nominal"][: episodes["faulty"]]
    for kind, severity, twin in product(kinds, severities, twins):
        trials.append(faulty_trial(env_id, kind, severity, twin, horizon))
    return trials
