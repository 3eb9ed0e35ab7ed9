"""Puts environment, faults and policy of an episode together, and runs it: the only place that does."""

from __future__ import annotations

import copy
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Generic, TypeVar

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

import asm_gym  # noqa: F401  (registers the environments in every worker)
from asm_gym.envs.robosuite_env import RobosuiteEnv
from asm_gym.evaluation.scored_episode import IDEAL, NOMINAL
from asm_gym.faults import Fault, Push
from asm_gym.faults.anywhere import faults_anywhere, sigmas
from asm_gym.faults.body import touches_body
from asm_gym.faults.interface import FaultyInterface
from asm_gym.faults.sensor import corrupts_senses
from asm_gym.faults.suite import KINDS, draw, harmless_variation, suite_fault
from asm_gym.policies import Policy, Seeded, make_policy, rollout
from asm_gym.policies.scripted.base import Style
from asm_gym.rollouts.seeds import episode_seeds
from asm_gym.rollouts.trial import EXECUTIONS, PASSING, PolicySource, RolloutConfig, Settings, Trial
from asm_gym.spec import control_period
from asm_gym.wrappers import FaultInjection, StreamRecorder
from asm_gym.wrappers.oracle import OracleReflex

Made = TypeVar("Made")


class Latest(Generic[Made]):
    """What was made last, for as long as it is asked for by what equals what it was made of."""

    def __init__(self) -> None:
        self._made: tuple[Any, Made] | None = None

    def __call__(self, of: Any, make: Callable[[], Made]) -> Made:
        """The one of ``of``, which need not be hashable."""
        if self._made is None or not _equal(self._made[0], of):
            self._made = None  # two environments at a time would take twice the memory
            self._made = of, make()
        return self._made[1]


def _equal(a: Any, b: Any) -> bool:
    try:
        return bool(a == b)
    except ValueError:  # of arrays, whose equality is not one answer
        return False


_LATEST_ENVIRONMENT: Latest[gym.Env[Any, Any]] = Latest()
_LATEST_SIGMAS: Latest[NDArray[np.float64]] = Latest()


def environment(env_id: str, settings: Settings = ()) -> gym.Env[Any, Any]:
    """This process's environment: making one costs as much as an episode, and a seeded reset forgets the last one.

    Args:
        settings: what ``gym.make`` is given besides.
    """
    given = copy.deepcopy(settings)  # the caller's own lists and dicts may change
    return _LATEST_ENVIRONMENT((env_id, given), lambda: gym.make(env_id, **dict(given)))


def faults_in(trial: Trial, env: gym.Env[Any, Any], config: RolloutConfig) -> tuple[Fault, ...]:
    """What goes wrong in ``env``, whose senses move as in episodes that are made as ``config`` says.

    Outside of robosuite, how far senses move is measured: three nominal episodes are run for it, once a process.
    """
    if trial.faults is not None or trial.kind == NOMINAL or trial.kind in EXECUTIONS:
        return trial.faults or ()
    inner: Any = env.unwrapped
    onset = trial.begins(env)
    if not isinstance(inner, RobosuiteEnv):
        sigma = _LATEST_SIGMAS((trial.env_id, config), lambda: _sigmas(trial.env_id, config))
        return faults_anywhere(trial.kind, FaultyInterface(env), sigma, trial.severity, onset, trial.seed)
    if trial.kind == PASSING:
        drawn, steps = draw(inner, onset, trial.seed), max(1, round(0.3 / control_period(env)))
        return (Push(body=drawn.link, newtons=20.0, direction=drawn.direction, duration=steps, onset=onset),)
    if trial.kind in KINDS:
        return (suite_fault(trial.kind, inner, trial.severity, onset, trial.seed),)
    return (harmless_variation(trial.kind, inner, onset, trial.seed),)


def _sigmas(env_id: str, config: RolloutConfig) -> NDArray[np.float64]:
    """Of each sense, from nominal episodes of seeds that no role has."""
    env = StreamRecorder(environment(env_id, config.settings))
    streams = []
    for seed in episode_seeds(0, 3, stage=99):
        play(Trial(env_id, seed), config, env)
        streams.append(env.finish().stream[:, env.stream_spec.sensory])
    return sigmas(FaultyInterface(env.env), streams)


def interface_of(env: gym.Env[Any, Any]) -> Any:
    """What faults in ``env`` act on: the environment, or an ``Interface`` to one that is not robosuite's."""
    inner = env.unwrapped
    return inner if isinstance(inner, RobosuiteEnv) else FaultyInterface(env)


@contextmanager
def staged(trial: Trial, config: RolloutConfig, env: gym.Env[Any, Any] | None = None) -> Iterator[gym.Env[Any, Any]]:
    """``env``, or this process's environment, in which the trial's faults happen; they are undone in the end."""
    base = environment(trial.env_id, config.settings) if env is None else env
    faults = faults_in(trial, base, config)
    if trial.acting == IDEAL:
        faults = tuple(fault for fault in faults if not corrupts_senses(fault))
    if not faults:
        yield base
        return
    faulty = FaultInjection(base, faults)
    touching = [fault for fault in faults if touches_body(fault)] if trial.acting == IDEAL else []
    try:
        yield OracleReflex(faulty, touching) if touching else faulty
    finally:
        faulty.undo_faults()  # the next trial has wrappers of its own around the same environment


def play(
    trial: Trial,
    config: RolloutConfig,
    env: gym.Env[Any, Any],
    on_step: Callable[[dict[str, Any]], None] | None = None,
) -> bool:
    """Runs the policy in a staged and wrapped ``env``; whether the task was solved at some step.

    Args:
        on_step: is shown every step's ``info``.
    """
    kwargs: dict[str, Any] = {}
    if trial.kind in EXECUTIONS and config.policy == "scripted":
        kwargs["style"] = Style(speed=EXECUTIONS[trial.kind])
    policy = policy_for(config.policy, env, trial.seed, **kwargs)
    return rollout(env, policy, trial.seed, on_step, trial.steps_in(env))


def policy_for(source: PolicySource, env: gym.Env[Any, Any], seed: int, **kwargs: Any) -> Policy:
    """The policy for one episode; one with ``set_random_seed``, as stable-baselines3's have, is seeded anew."""
    if isinstance(source, str | Path):
        return make_policy(str(source), env, seed=seed, **kwargs)
    policy = source if isinstance(source, Policy) and not isinstance(source, type) else source(env)
    if isinstance(policy, Seeded):
        policy.set_random_seed(seed)
    return policy
