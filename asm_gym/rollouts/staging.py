"""Put environment, faults and policy of a trial together, and run or record it: the only place that does."""

from __future__ import annotations

import copy
import math
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

import asm_gym  # noqa: F401  (registers the environments in every worker)
from asm_gym.envs.robosuite_env import RobosuiteEnv
from asm_gym.episode import Episode, save_episode
from asm_gym.evaluation.scored_episode import NOMINAL
from asm_gym.faults import Fault, Push
from asm_gym.faults.anywhere import FaultyInterface, faults_anywhere, sigmas
from asm_gym.faults.suite import KINDS, draw, harmless_variation, suite_fault
from asm_gym.policies import Policy, Seeded, make_policy, rollout
from asm_gym.policies.scripted.base import Style
from asm_gym.rollouts.parallel import Progress
from asm_gym.rollouts.run_folder import make_missing
from asm_gym.rollouts.seeds import episode_seeds
from asm_gym.rollouts.trial import EXECUTIONS, PASSING, PolicySource, RolloutConfig, Settings, Trial
from asm_gym.spec import control_period
from asm_gym.wrappers import StreamRecorder
from asm_gym.wrappers.faults import FaultInjection

_CACHE: dict[str, tuple[Any, Any]] = {}
"""What this process made last, by name: what it was made of, and the result."""


def environment(env_id: str, settings: Settings = ()) -> gym.Env[Any, Any]:
    """Return this process's environment: making one costs as much as an episode, and a seeded reset restores it."""
    given = copy.deepcopy(settings)  # the caller's own lists and dicts may change
    made: gym.Env[Any, Any] = _latest("environment", (env_id, given), lambda: gym.make(env_id, **dict(given)))
    return made


def _latest(name: str, key: Any, make: Callable[[], Any]) -> Any:
    """Return what was made last if its key, which need not be hashable, was equal; else make it."""
    if name not in _CACHE or not _equal(_CACHE[name][0], key):
        _CACHE.pop(name, None)  # two environments at a time would take twice the memory
        _CACHE[name] = key, make()
    return _CACHE[name][1]


def _equal(a: Any, b: Any) -> bool:
    try:
        return bool(a == b)
    except ValueError:  # of arrays
        return False


def faults_in(trial: Trial, env: gym.Env[Any, Any], config: RolloutConfig) -> tuple[Fault, ...]:
    """Return what goes wrong in ``env``.

    Outside of robosuite, magnitudes are relative to how far senses move in three nominal episodes as of ``config``.
    """
    if trial.faults is not None or trial.kind == NOMINAL or trial.kind in EXECUTIONS:
        return trial.faults or ()
    inner: Any = env.unwrapped
    onset = trial.begins(env)
    if not isinstance(inner, RobosuiteEnv):
        sigma = _latest("sigmas", (trial.env_id, config), lambda: _sigmas(trial.env_id, config))
        return faults_anywhere(trial.kind, FaultyInterface(env), sigma, trial.severity, onset, trial.seed)
    if trial.kind == PASSING:
        drawn, steps = draw(inner, onset, trial.seed), max(1, round(0.3 / control_period(env)))
        return (Push(body=drawn.link, newtons=20.0, direction=drawn.direction, duration=steps, onset=onset),)
    if trial.kind in KINDS:
        return (suite_fault(trial.kind, inner, trial.severity, onset, trial.seed),)
    return (harmless_variation(trial.kind, inner, onset, trial.seed),)


def _sigmas(env_id: str, config: RolloutConfig) -> NDArray[np.float64]:
    """Return the spread of each sense in nominal episodes of seeds that no role has."""
    env = StreamRecorder(environment(env_id, config.settings))
    streams = []
    for seed in episode_seeds(0, 3, stage=99):
        play(Trial(env_id, seed), config, env)
        streams.append(env.finish().stream[:, env.stream_spec.sensory])
    return sigmas(FaultyInterface(env.env), streams)


@contextmanager
def staged(trial: Trial, config: RolloutConfig, env: gym.Env[Any, Any] | None = None) -> Iterator[gym.Env[Any, Any]]:
    """Yield ``env``, or this process's environment, with the trial's faults; they are undone in the end."""
    base = environment(trial.env_id, config.settings) if env is None else env
    faults = faults_in(trial, base, config)
    if not faults:
        yield base
        return
    faulty = FaultInjection(base, faults)
    try:
        yield faulty
    finally:
        faulty.undo_faults()  # the next trial has wrappers of its own around the same environment


def play(
    trial: Trial,
    config: RolloutConfig,
    env: gym.Env[Any, Any],
    on_step: Callable[[dict[str, Any]], None] | None = None,
) -> bool:
    """Run the policy in a staged and wrapped ``env``; return whether the task was solved at some step."""
    kwargs: dict[str, Any] = {}
    if trial.kind in EXECUTIONS and config.policy == "scripted":
        kwargs["style"] = Style(speed=EXECUTIONS[trial.kind])
    policy = policy_for(config.policy, env, trial.seed, **kwargs)
    return rollout(env, policy, trial.seed, on_step, trial.steps_in(env))


def policy_for(source: PolicySource, env: gym.Env[Any, Any], seed: int, **kwargs: Any) -> Policy:
    """Return the policy for one episode; one with ``set_random_seed``, as stable-baselines3's have, is seeded anew."""
    if isinstance(source, str | Path):
        return make_policy(str(source), env, seed=seed, **kwargs)
    policy = source if isinstance(source, Policy) and not isinstance(source, type) else source(env)
    if isinstance(policy, Seeded):
        policy.set_random_seed(seed)
    return policy


def record_stream(trial: Trial, config: RolloutConfig) -> Episode:
    """Return the stream, contact forces and label of a trial: what monitors need, without what agents learn from."""
    forces: list[float] = []
    with staged(trial, config) as env:
        recorder = StreamRecorder(env)
        play(trial, config, recorder, lambda info: forces.append(info.get("contact_force", math.nan)))
    base = environment(trial.env_id, config.settings)
    inner: Any = base.unwrapped if isinstance(base.unwrapped, RobosuiteEnv) else FaultyInterface(base)
    faults = faults_in(trial, base, config) if trial.role == "faulty" else ()
    affected: frozenset[str] = frozenset().union(*(fault.labels(inner) for fault in faults))
    recorded = recorder.finish()
    return Episode(
        stream=recorded.stream,
        spec=recorded.spec,
        success=recorded.success,
        seed=trial.seed,
        faults=recorded.faults,
        contact_force=np.asarray([] if np.isnan(forces).all() else forces, np.float32),
        label=replace(trial.label, affected_channels=affected),
        info={"skill": trial.task},
    )


def record(trial: Trial, config: RolloutConfig, folder: Path) -> Path:
    """Record a trial, and write it to its place under ``folder``."""
    return save_episode(folder / trial.label.path, record_stream(trial, config))


def record_missing(
    trials: Sequence[Trial],
    config: RolloutConfig,
    folder: Path,
    workers: int | str = 2,
    progress: Progress | None = None,
) -> list[Path]:
    """Record the trials that are not in ``folder`` yet; return the files of all."""
    make = partial(record, config=config, folder=folder.resolve())
    return make_missing(make, trials, lambda trial: folder / trial.label.path, workers, progress)
