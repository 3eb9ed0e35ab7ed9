"""Put environment, faults and policy of a trial together, and run or record it: the only place that does."""

from __future__ import annotations

import math
import sys
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from functools import lru_cache, partial
from pathlib import Path
from typing import Any, NamedTuple, cast

import gymnasium as gym
import numpy as np
from gymnasium.envs.registration import EnvSpec
from numpy.typing import NDArray

from asm_gym.control_period import control_period
from asm_gym.data.episode import CONTROLLER, Episode, save_episode
from asm_gym.envs.arms import PHYSICS_FREQ
from asm_gym.envs.robosuite_env import RobosuiteEnv
from asm_gym.evaluation.contact_harm import harm_of
from asm_gym.evaluation.scored_episode import (
    NOMINAL,
    POLICY_ALONE,
    InterventionOutcome,
    ScoredEpisode,
)
from asm_gym.faults import Fault, Push
from asm_gym.faults.foreign_faults import FaultyInterface, faults_anywhere, sigmas
from asm_gym.faults.suite import draw, suite_fault
from asm_gym.guard.options import OnAlarmName
from asm_gym.monitors import NeuralASM
from asm_gym.policies import Policy, make_policy, rollout
from asm_gym.rollouts.parallel import Progress, parallel_map
from asm_gym.rollouts.run_folder import make_missing
from asm_gym.rollouts.seeds import episode_seeds
from asm_gym.rollouts.trial import PASSING, PolicySource, RolloutConfig, Settings, Trial
from asm_gym.tasks import env_spec
from asm_gym.validation import check_number, typed
from asm_gym.wrappers import NeuralASMSafety, StreamRecorder
from asm_gym.wrappers.capabilities import missing_meaning
from asm_gym.wrappers.faults import FaultInjection

OWN_IDS = (
    "asm_gym/"  # begins the ids of environments that hold by themselves or say what actions mean
)
UNUSED_STAGE = 99  # stage of the random draws whose seeds no recorded episode has


class Cached(NamedTuple):
    """A result that this process made last, and the text of its arguments."""

    arguments: str
    result: Any


_CACHE: dict[str, Cached] = {}  # by name


def _cached(name: str, arguments: object, make: Callable[[], Any]) -> Any:
    """Return the last result of this name if it was made of the same arguments; else make it."""
    with np.printoptions(threshold=sys.maxsize, floatmode="unique"):
        text = repr(arguments)  # the caller's own lists, dicts and arrays may change
    if name not in _CACHE or _CACHE[name].arguments != text:
        _CACHE.pop(name, None)  # two environments at a time would take twice the memory
        _CACHE[name] = Cached(text, make())
    return _CACHE[name].result


def environment(env_id: str, settings: Settings = ()) -> gym.Env[Any, Any]:
    """Return this process's environment: making one costs as much as an episode, and a seeded reset restores it."""
    return _cached("environment", (env_id, settings), lambda: gym.make(env_id, **dict(settings)))


def faults_in(trial: Trial, env: gym.Env[Any, Any], config: RolloutConfig) -> tuple[Fault, ...]:
    """Return the faults of a trial in ``env``; none for a nominal one.

    Outside of robosuite, magnitudes are relative to how far the senses move in nominal episodes with ``config``.
    """
    if trial.faults is not None:
        return trial.faults
    if trial.kind == NOMINAL:
        return ()
    arm: Any = env.unwrapped
    onset = trial.onset_in(env)
    if not isinstance(arm, RobosuiteEnv):
        arguments = (trial.env_id, config)
        spreads = _cached("spreads", arguments, lambda: _nominal_spreads(trial.env_id, config))
        interface = FaultyInterface(env)
        return faults_anywhere(trial.kind, interface, spreads, trial.severity, onset, trial.seed)
    if trial.kind == PASSING:
        return (_passing_push(arm, onset, trial.seed, control_period(env)),)
    return (suite_fault(trial.kind, arm, trial.severity, onset, trial.seed),)


def _passing_push(arm: RobosuiteEnv, onset: int, seed: int, dt: float) -> Push:
    """Return the push of kind ``PASSING``, in an environment with a control period of ``dt`` [s]."""
    drawn = draw(arm, onset, seed)
    return Push(
        body=drawn.link,
        newtons=20.0,
        direction=drawn.direction,
        duration=max(1, round(0.3 / dt)),
        onset=onset,
    )


def _nominal_spreads(env_id: str, config: RolloutConfig) -> NDArray[np.float64]:
    """Return the spread of each sense in three nominal episodes that are not recorded otherwise."""
    env = StreamRecorder(environment(env_id, config.settings))
    streams = []
    for seed in episode_seeds(0, 3, UNUSED_STAGE):
        play(Trial(env_id, seed), config, env)
        streams.append(env.finish().stream[:, env.stream_spec.sensory])
    return sigmas(FaultyInterface(env.env), streams)


@contextmanager
def staged(trial: Trial, config: RolloutConfig) -> Iterator[gym.Env[Any, Any]]:
    """Yield this process's environment with the trial's faults; they are undone in the end."""
    base = environment(trial.env_id, config.settings)
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
    policy = policy_for(config.policy, env, trial.seed)
    return rollout(env, policy, trial.seed, on_step, trial.steps_in(env))


def policy_for(source: PolicySource, env: gym.Env[Any, Any], seed: int) -> Policy:
    """Return the policy for one episode; seed it if it has ``set_random_seed``, as stable-baselines3's have."""
    if isinstance(source, str | Path):
        return make_policy(str(source), env, seed=seed)
    policy: Any = source
    # A factory: a function, or a class, which has ``predict`` as its instances do.
    if isinstance(source, type) or not isinstance(source, Policy):
        policy = source(env)
    if hasattr(policy, "set_random_seed"):
        policy.set_random_seed(seed)
    return policy


def record_stream(trial: Trial, config: RolloutConfig) -> Episode:
    """Return the stream, contact forces and label of a trial: what monitors need, without what agents learn from."""
    forces: list[float] = []

    def note_force(info: dict[str, Any]) -> None:
        forces.append(info.get("contact_force", math.nan))

    with staged(trial, config) as env:
        recorder = StreamRecorder(env)
        play(trial, config, recorder, note_force)
    if np.isnan(forces).all():  # the environment does not measure them
        forces.clear()
    recorded = recorder.finish()
    return Episode(
        stream=recorded.stream,
        spec=recorded.spec,
        success=recorded.success,
        seed=trial.seed,
        faults=recorded.faults,
        contact_force=np.asarray(forces, np.float32),
        label=replace(trial.label, affected_channels=_affected_channels(trial, config)),
        info={"skill": trial.task, CONTROLLER: recorded.info[CONTROLLER]},
    )


def _affected_channels(trial: Trial, config: RolloutConfig) -> frozenset[str]:
    """Return the channels in which the faults of a trial show first."""
    if trial.role != "faulty":
        return frozenset()
    env = environment(trial.env_id, config.settings)
    interface: Any = env.unwrapped
    if not isinstance(interface, RobosuiteEnv):
        interface = FaultyInterface(env)
    labels = [fault.labels(interface) for fault in faults_in(trial, env, config)]
    return frozenset().union(*labels)


def record_missing(
    trials: Sequence[Trial],
    config: RolloutConfig,
    folder: Path,
    workers: int = 2,
    progress: Progress | None = None,
) -> list[Path]:
    """Record the trials that are not in ``folder`` yet; return the files of all."""
    folder = folder.resolve()

    def file_of(trial: Trial) -> Path:
        return folder / trial.label.path

    def record(trial: Trial) -> Path:
        return save_episode(file_of(trial), record_stream(trial, config))

    return make_missing(record, trials, file_of, workers, progress)


@typed
def collect(
    env_id: str,
    policy: PolicySource = "scripted",
    episodes: int = 100,
    seed: int = 0,
    workers: int = 2,
    *,
    stage: int = 0,
    progress: Progress | None = None,
    **env_kwargs: Any,
) -> list[Episode]:
    """Record episodes of a policy and return them, in an order that does not depend on ``workers``.

    Without ``info["stream"]``, observation and action form the stream.

    Args:
        env_id: any Gymnasium id with numeric spaces, such as ``asm_gym/Lift-v0``, ``Pusher-v5`` or ``module:id``.
        policy: a name or a path, as for ``asm_gym.policies.make_policy``; any object with stable-baselines3's
            ``predict``; or a function that makes one for an environment, called for every episode. The episodes of one
            process share an object, so it must reset itself when ``episode_start`` is set; a random one must have
            ``set_random_seed``.
        episodes: number of episodes.
        seed: of all random draws; the same seed gives the same episodes.
        workers: number of processes; 1 means this process.
        stage: different stages give different episodes for the same ``seed``.
        progress: called as ``progress(done, total)``.
        env_kwargs: further arguments of ``gym.make``.

    Raises:
        ValueError: fewer than one episode or worker; arguments that the environment or the policy refuses.
        TypeError: spaces that are not numeric, or a policy that cannot be sent to another process.

    Example:
        >>> from asm_gym import collect
        >>> episodes = collect("asm_gym/SyntheticArm-v0", "sway", episodes=2, seed=0, workers=1)
        >>> len(episodes), episodes[0].stream.shape == (len(episodes[0]), episodes[0].spec.size)
        (2, True)
    """
    check_number("episodes", episodes, low=1, whole=True)
    config = RolloutConfig(policy, env_kwargs=tuple(sorted(env_kwargs.items())))
    unknown = unknown_actions(env_id, config)
    if unknown:
        warnings.warn(unknown, stacklevel=3)
    task = partial(record_episode, spec=env_spec(env_id), config=config)
    return parallel_map(task, episode_seeds(seed, episodes, stage), workers, progress)


def unknown_actions(env_id: str, config: RolloutConfig) -> str:
    """Return what to say of the actions of a foreign environment before episodes are spent; empty for nothing."""
    if env_id.startswith(OWN_IDS):
        return ""
    return missing_meaning(environment(env_id, config.settings))


def record_episode(seed: int, spec: EnvSpec, config: RolloutConfig) -> Episode:
    """Record the episode of ``seed``."""
    # another process lacks what the user registered in this one
    gym.registry.setdefault(spec.id, spec)
    trial = Trial(spec.id, seed)
    with staged(trial, config) as env:
        recorder = StreamRecorder(env)
        play(trial, config, recorder)
    return recorder.finish()


def collect_to(
    folder: Path,
    env_id: str,
    config: RolloutConfig,
    seeds: Sequence[int],
    workers: int = 2,
    progress: Progress | None = None,
) -> list[Path]:
    """Record the episodes that are not in ``folder`` yet; return the files of all."""
    folder = folder.resolve()
    spec = env_spec(env_id)

    def file_of(seed: int) -> Path:
        return folder / f"{seed}.npz"

    def record(seed: int) -> Path:
        return save_episode(file_of(seed), record_episode(seed, spec, config))

    return make_missing(record, seeds, file_of, workers, progress)


def check_config(env_id: str, config: RolloutConfig) -> None:
    """Make the environment and the policy once, so that what they refuse is raised before anything runs."""
    policy_for(config.policy, StreamRecorder(environment(env_id, config.settings)), seed=0)


# ------------------------------------------------------------------ under the guard


@contextmanager
def recorded_forces(env: gym.Env[Any, Any]) -> Iterator[list[float]]:
    """Collect the greatest contact force on the arm in each physics substep [N], of a robosuite environment."""
    arm = cast(RobosuiteEnv, env.unwrapped)
    forces: list[float] = []

    def note_force(substep: int) -> None:
        forces.append(float(arm.simulation.contact_forces[-1]))

    arm.substep_hooks.append(note_force)
    try:
        yield forces
    finally:
        arm.substep_hooks.remove(note_force)


@lru_cache(maxsize=1)
def _memory(path: Path, written_ns: int) -> NeuralASM:
    """Load a memory; the last one is cached until its file is ``written_ns`` anew."""
    return NeuralASM.load(path)


def watch(trial: Trial, config: RolloutConfig, memory: Path) -> ScoredEpisode:
    """Run one trial under the guard in this process's environment, and return its scores."""
    monitor = _memory(memory, memory.stat().st_mtime_ns)
    infos: list[dict[str, Any]] = []
    with staged(trial, config) as env, recorded_forces(env) as forces:
        guarded = NeuralASMSafety(env, monitor, on_alarm=cast(OnAlarmName, trial.on_alarm))
        success = play(trial, config, guarded, infos.append)
    reports = [info["asm"] for info in infos]  # one a control step
    rows_per_step = len(reports[0]["surprises"])
    is_faulty = [bool(info.get("fault")) for info in infos]
    fault = np.repeat(is_faulty, rows_per_step)  # (T,)
    onset = None
    if fault.any():
        onset = int(np.argmax(fault))
    time_to_success = math.nan
    solved_steps = [step for step, info in enumerate(infos) if info["success"]]
    if solved_steps:
        time_to_success = (solved_steps[0] + 1) * rows_per_step * monitor.spec.dt
    overridden = [bool(info["overridden"]) for info in infos]
    harm = harm_of(np.array(forces), PHYSICS_FREQ)
    outcome = InterventionOutcome(
        success=success,
        contact_force=harm.peak,
        overridden_steps=sum(overridden),
        time=time_to_success,
        harm=harm.harm,
        leaned_s=harm.over_s,
    )
    trace = ScoredEpisode(
        kind=trial.kind,
        severity=trial.severity,
        task=trial.task,
        acting=trial.acting,
        seed=trial.seed,
        dt=monitor.spec.dt,
        threshold=monitor.threshold,
        surprise=np.concatenate([report["surprises"] for report in reports]),
        onset=onset,
        outcome=outcome,
        fault=fault,
        overridden=np.repeat(overridden, rows_per_step),
    )
    # A control step reports the shares of its most surprising row.
    shares = [list(report["attribution"].values()) for report in reports]
    attribution = np.repeat(shares, rows_per_step, axis=0)  # (T, D)
    return trace.attributed(attribution, monitor.spec.labels)


def watch_pair(trial: Trial, config: RolloutConfig, memory: Path) -> list[ScoredEpisode]:
    """Run one trial twice: with the policy alone, and with the trial's response."""
    alone = replace(trial, acting=POLICY_ALONE)
    return [watch(each, config, memory) for each in (alone, trial)]
