"""One episode: the only place where environment, faults, wrappers and policy are put together and run."""

from __future__ import annotations

import copy
import math
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import Any, Generic, TypeVar

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

import asm_gym  # noqa: F401  (registers the environments in every worker)
from asm_gym.envs.robosuite_env import RobosuiteEnv
from asm_gym.episode import Episode, EpisodeLabel, save_episode
from asm_gym.evaluation.contact import contact_force
from asm_gym.evaluation.scored import IDEAL, NOMINAL, POLICY_ALONE, InterventionOutcome, ScoredEpisode, TraceDetail
from asm_gym.faults import Fault, Push
from asm_gym.faults.anywhere import faults_anywhere, sigmas
from asm_gym.faults.body import touches_body
from asm_gym.faults.interface import FaultyInterface
from asm_gym.faults.sensor import corrupts_senses
from asm_gym.faults.suite import KINDS, draw, harmless_variation, suite_fault
from asm_gym.monitors import Monitor, NeuralASM
from asm_gym.monitors.contact_band import ContactBand
from asm_gym.policies import Policy, Seeded, make_policy, rollout
from asm_gym.policies.scripted.base import Style
from asm_gym.rollouts.seeds import draw_onset, episode_seeds
from asm_gym.spec import control_period
from asm_gym.tasks import env_id
from asm_gym.wrappers import FaultInjection, NeuralASMSafety, StreamRecorder
from asm_gym.wrappers.oracle import OracleReflex

Settings = tuple[tuple[str, Any], ...]
"""Arguments by name, in an order of their own."""
PolicySource = str | Path | Policy | Callable[[gym.Env[Any, Any]], Policy]
"""What ``make_policy`` takes, whatever has ``predict``, or what makes one for an environment."""

Made = TypeVar("Made")

SPINAL = "+spinal"
"""Ends the name of a reflex under which the arm also stays as soon as it leaves the band of ``RolloutConfig``."""
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
        max_override_s: how long a reflex may act at a stretch before the episode is ended [s].
        env_kwargs: what ``gym.make`` is given besides.
        band: file of a calibrated ``ContactBand`` of the memory that watches, for reflexes that are ``"+spinal"``.
    """

    policy: PolicySource = "scripted"
    robot: str | None = None
    stream_freq: int | None = None
    max_override_s: float | None = None
    env_kwargs: Settings = ()
    band: Path | None = None

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
            takes, which may end in ``"+spinal"``.
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
        return "monitor" if self.acting in (POLICY_ALONE, IDEAL) else self.acting.removesuffix(SPINAL)

    def begins(self, env: gym.Env[Any, Any]) -> int:
        """When in ``env`` something goes wrong, or would [steps]."""
        if self.onset is not None or self.faults:
            return self.onset if self.onset is not None else min(f.onset for f in self.faults or ())
        return draw_onset(self.seed, horizon_of(env))

    def faults_in(self, env: gym.Env[Any, Any], config: RolloutConfig) -> tuple[Fault, ...]:
        """What goes wrong in ``env``, whose senses move as in episodes that are made as ``config`` says."""
        if self.faults is not None or self.kind == NOMINAL or self.kind in EXECUTIONS:
            return self.faults or ()
        inner: Any = env.unwrapped
        onset = self.begins(env)
        if not isinstance(inner, RobosuiteEnv):
            sigma = _LATEST_SIGMAS((self.env_id, config), lambda: _sigmas(self.env_id, config))
            return faults_anywhere(self.kind, FaultyInterface(env), sigma, self.severity, onset, self.seed)
        if self.kind == PASSING:
            drawn, steps = draw(inner, onset, self.seed), max(1, round(0.3 / control_period(env)))
            return (Push(body=drawn.link, newtons=20.0, direction=drawn.direction, duration=steps, onset=onset),)
        if self.kind in KINDS:
            return (suite_fault(self.kind, inner, self.severity, onset, self.seed),)
        return (harmless_variation(self.kind, inner, onset, self.seed),)

    def steps_in(self, env: gym.Env[Any, Any]) -> int | None:
        """Where the episode is left; None for its end."""
        return None if self.after_s is None else self.begins(env) + round(self.after_s / control_period(env))


def horizon_of(env: gym.Env[Any, Any]) -> int:
    """Control steps of an episode; 0 where nobody says."""
    limit = env.spec.max_episode_steps if env.spec else None
    return int(getattr(env.unwrapped, "horizon", limit) or 0)


def interface_of(env: gym.Env[Any, Any]) -> Any:
    """What faults in ``env`` act on: the environment, or an ``Interface`` to one that is not robosuite's."""
    inner = env.unwrapped
    return inner if isinstance(inner, RobosuiteEnv) else FaultyInterface(env)


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


def _sigmas(env_id: str, config: RolloutConfig) -> NDArray[np.float64]:
    """Of each sense, from nominal episodes of seeds that no role has."""
    env = StreamRecorder(environment(env_id, config.settings))
    streams = []
    for seed in episode_seeds(0, 3, stage=99):
        play(Trial(env_id, seed), config, env)
        streams.append(env.finish().stream[:, env.stream_spec.sensory])
    return sigmas(FaultyInterface(env.env), streams)


def environment(env_id: str, settings: Settings = ()) -> gym.Env[Any, Any]:
    """This process's environment: making one costs as much as an episode, and a seeded reset forgets the last one.

    Args:
        settings: what ``gym.make`` is given besides.
    """
    given = copy.deepcopy(settings)  # the caller's own lists and dicts may change
    return _LATEST_ENVIRONMENT((env_id, given), lambda: gym.make(env_id, **dict(given)))


@lru_cache(maxsize=1)
def _memory(path: Path, written_ns: int) -> NeuralASM:
    """Loaded once a process, and again when the file has been written anew."""
    return NeuralASM.load(path)


@contextmanager
def staged(trial: Trial, config: RolloutConfig, env: gym.Env[Any, Any] | None = None) -> Iterator[gym.Env[Any, Any]]:
    """``env``, or this process's environment, in which the trial's faults happen; they are undone in the end."""
    base = environment(trial.env_id, config.settings) if env is None else env
    faults = trial.faults_in(base, config)
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


def guarded(
    env: gym.Env[Any, Any],
    monitor: Monitor,
    trial: Trial,
    max_override_s: float | None = None,
    band: ContactBand | None = None,
) -> gym.Env[Any, Any]:
    """``env`` under the safety wrapper, which acts as the trial says."""
    limited = max_override_s is not None and trial.acting not in (POLICY_ALONE, IDEAL)
    steps = max(1, round((max_override_s or 0.0) / control_period(env))) if limited else None
    return NeuralASMSafety(env, monitor, on_alarm=trial.on_alarm, max_override=steps, on_overrun="ignore", band=band)


def record(label: EpisodeLabel, config: RolloutConfig, folder: Path) -> Path:
    """Records the episode of ``label``, and writes it to its place under ``folder``."""
    trial = Trial.of(label)
    forces: list[float] = []
    with staged(trial, config) as env:
        recorder = StreamRecorder(env)
        play(trial, config, recorder, lambda info: forces.append(info.get("contact_force", math.nan)))
    base = environment(trial.env_id, config.settings)
    faults = trial.faults_in(base, config) if label.role == "faulty" else ()
    affected = [fault.labels(interface_of(base)) for fault in faults]
    recorded = recorder.finish()
    kept = Episode(  # what monitors look at: actions stand in the stream, and nobody learns to act from these
        stream=recorded.stream,
        spec=recorded.spec,
        success=recorded.success,
        seed=label.seed,
        faults=recorded.faults,
        contact_force=np.asarray([] if np.isnan(forces).all() else forces, np.float32),
        label=replace(label, affected_channels=frozenset().union(*affected)),
        info={"skill": label.task, **goal_in(base, recorded)},
    )
    return save_episode(folder / label.path, kept)


def goal_in(env: gym.Env[Any, Any], recorded: Episode) -> dict[str, list[float]]:
    """``"goal"``: where the objects were seen before the first step [m]; nothing where that is not told apart."""
    inner = env.unwrapped
    if not isinstance(inner, RobosuiteEnv) or not len(recorded.observations):
        return {}
    objects = {c.name for c in inner.measured_spec.channels if c.group == "object" and c.size == 3}
    ends = np.cumsum(list(inner.observation_layout.values()))
    parts = zip(inner.observation_layout, np.split(recorded.observations[0], ends[:-1]), strict=True)
    return {"goal": [float(number) for name, part in parts if name in objects for number in part]}


def watch(trial: Trial, config: RolloutConfig, memory: Path) -> ScoredEpisode:
    """The trace of one trial, in this process's environment.

    Args:
        memory: where the calibrated memory was saved; ``config.stream_freq`` is the rate that it watches at.
    """
    monitor = _memory(memory, memory.stat().st_mtime_ns)
    infos: list[dict[str, Any]] = []
    band = band_of(config, monitor) if trial.acting.endswith(SPINAL) else None
    with staged(trial, config) as env:
        success = play(trial, config, guarded(env, monitor, trial, config.max_override_s, band), infos.append)
        began, dt = trial.begins(env), control_period(env)
    asm = [info["asm"] for info in infos]
    rows = len(asm[0]["surprises"])  # of each control step
    fault = np.repeat([bool(info.get("fault")) for info in infos], rows)
    attribution = np.repeat([list(a["attribution"].values()) for a in asm], rows, axis=0)  # the step's greatest

    def felt(name: str, since: int, until: int | None = None) -> list[float]:
        return [info.get(name, math.nan) for info in infos[since:until]]

    lasted = max((t + 1 for t, info in enumerate(infos) if info.get("fault")), default=None)

    named = next((a["cause"] for a in asm[began:] if a["cause"]["family"]), asm[0]["cause"])
    trace = ScoredEpisode(
        kind=trial.kind,
        severity=trial.severity,
        task=trial.task,
        acting=trial.acting,
        seed=trial.seed,
        dt=monitor.spec.dt,
        threshold=monitor.threshold,
        surprise=np.concatenate([a["surprises"] for a in asm]),
        onset=int(np.argmax(fault)) if fault.any() else None,
        outcome=InterventionOutcome(
            success,
            ended_by_alarm=bool(asm[-1]["gave_up"] or (trial.acting == "terminate" and asm[-1]["alarm"])),
            contact_force=float(np.max(felt("contact_force", 0))),
            external_force=float(np.nanmax(felt("external_force", began, lasted), initial=0.0)),
            impulse=float(np.nansum(felt("external_impulse", began, lasted))),
            acted_s=sum(a["intervened"] for a in asm) * dt,
            contact=contact_force(np.array(felt("external_force", began)), dt),
            cause=named["family"],
            part=named["part"],
        ),
        detail=TraceDetail(attribution, monitor.spec.labels, fault),
    )
    return trace.attributed(attribution, monitor.spec.labels)


def watch_pair(trial: Trial, config: RolloutConfig, memory: Path) -> list[ScoredEpisode]:
    """The traces of one trial with the policy alone, and as it says."""
    return watch_each(replace(trial, acting=POLICY_ALONE), (POLICY_ALONE, trial.acting), config, memory)


def band_of(config: RolloutConfig, monitor: NeuralASM) -> ContactBand:
    """The band beneath a reflex. Raises ValueError where none was named."""
    if config.band is None:
        raise ValueError(f"a reflex that ends in {SPINAL} needs the file of a band: RolloutConfig(band=...)")
    return ContactBand.load(config.band, monitor)


def watch_each(
    trial: Trial,
    actings: Sequence[str],
    config: RolloutConfig,
    memory: Path,
    undisturbed: Callable[[], ScoredEpisode] | None = None,
) -> list[ScoredEpisode]:
    """The traces of one trial with each of ``actings``, of which those that must be the same run once.

    The ideal reflex's is that of the policy alone, where nothing touches the body and no sense is at fault. Where
    nothing but senses is at fault, it is the one in which nothing goes wrong.

    Args:
        undisturbed: makes the trace of the policy alone in this trial when nothing goes wrong, where that is known.
    """
    if undisturbed is not None and trial.kind == NOMINAL:
        alone = undisturbed()
    else:
        alone = watch(replace(trial, acting=POLICY_ALONE), config, memory)
    of_senses = undisturbed is not None and concerns_senses_alone(trial, config)

    def found(acting: str) -> ScoredEpisode:
        if acting == IDEAL and of_senses and undisturbed is not None:
            return replace(undisturbed(), kind=trial.kind, severity=trial.severity, acting=IDEAL)
        told = acting == IDEAL and concerns_ideal(trial, config)
        if acting == POLICY_ALONE or (acting == IDEAL and not told):
            return replace(alone, acting=acting)
        return watch(replace(trial, acting=acting), config, memory)

    return [found(acting) for acting in actings]


def concerns_ideal(trial: Trial, config: RolloutConfig) -> bool:
    """Whether an ideal reflex has anything to do about what goes wrong."""
    faults = trial.faults_in(environment(trial.env_id, config.settings), config)
    return any(touches_body(fault) or corrupts_senses(fault) for fault in faults)


def concerns_senses_alone(trial: Trial, config: RolloutConfig) -> bool:
    """Whether something goes wrong, and none of it but with the senses."""
    faults = trial.faults_in(environment(trial.env_id, config.settings), config)
    return bool(faults) and all(corrupts_senses(fault) for fault in faults)
