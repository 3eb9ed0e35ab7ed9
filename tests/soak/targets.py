"""What is called: all that is public in monitors, wrappers, faults and policies, and most elsewhere."""

from __future__ import annotations

import inspect
import itertools
from collections.abc import Callable
from functools import cached_property
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np

import asm_gym
from asm_gym import checkpoint, episode, tasks
from asm_gym.data import datasets, logs
from asm_gym.detection import adaptive, conformal, detector
from asm_gym.envs import backend
from asm_gym.envs.robosuite_env import RobosuiteEnv
from asm_gym.evaluation import statistics
from asm_gym.faults import FAULTS, make_fault
from asm_gym.monitors import NeuralASM, load_monitor, make_monitor, monitor_class, pretrained_for, register_monitor
from asm_gym.policies import NeuralASMPolicy, make_policy, rollout
from asm_gym.policies.scripted.base import Style
from asm_gym.rollouts import ParallelConfig, RolloutConfig, Trial, collect, parallel_map
from asm_gym.rollouts.seeds import draw_onset, episode_seeds
from asm_gym.spec import Channel, StreamSpec, control_period
from asm_gym.wrappers import (
    CompletedObservation,
    FaultInjection,
    FlatInfo,
    NeuralASMSafety,
    SafetyLog,
    SixValues,
    StreamFeatures,
    StreamRecorder,
    SurpriseOverlay,
    VectorNeuralASMSafety,
)
from tests.fakes import SPEC, CueMonitor, FadingMonitor, FakeEnv
from tests.streams import sine_episodes, sine_spec


class Good:
    """Arguments that are as they should be, made once."""

    spec = sine_spec(3, 1)
    numbers = itertools.count()

    @cached_property
    def episodes(self) -> list[episode.Episode]:
        return sine_episodes(24, spec=self.spec)

    @cached_property
    def asm(self) -> NeuralASM:
        asm = NeuralASM(self.spec, hidden_size=8, association_size=16, epochs=1)
        return asm.fit(self.episodes[:14]).calibrate(self.episodes[14:], 0.1)

    @cached_property
    def memory_file(self) -> Path:
        self.asm.save("good.asm")
        return Path("good.asm").resolve()

    @cached_property
    def episode_file(self) -> Path:
        return episode.save_episode(Path("good.npz").resolve(), self.episodes[0])

    @cached_property
    def log_file(self) -> Path:
        header = ",".join(self.spec.labels)
        np.savetxt("good.csv", self.episodes[0].stream, delimiter=",", header=header, comments="")
        return Path("good.csv").resolve()

    @cached_property
    def arrays_file(self) -> Path:
        np.savez("arrays.npz", a=np.zeros(3))
        return Path("arrays.npz").resolve()

    @cached_property
    def agent_file(self) -> Path:
        return next(Path(asm_gym.__file__).parent.glob("policies/agents/lift_sac.npz")).resolve()

    @cached_property
    def fake_asm(self) -> NeuralASM:
        """A memory of what ``FakeEnv`` senses, which can act."""
        env = FakeEnv(own_stream=False)
        spec = StreamSpec.from_spaces(env.observation_space, env.action_space, control_period(env))
        fit = sine_episodes(24, spec=spec)
        asm = NeuralASM(spec, hidden_size=8, association_size=16, epochs=1)
        return asm.fit(fit[:14]).calibrate(fit[14:], 0.1).learn_to_act(fit[:14], 16)

    @cached_property
    def shipped(self) -> NeuralASM:
        return NeuralASM.pretrained("panda")

    @cached_property
    def recorder(self) -> StreamRecorder:
        """It has recorded an episode."""
        recorder = StreamRecorder(FakeEnv(5))
        rollout(recorder, make_policy("hold", recorder), seed=0)
        return recorder

    @cached_property
    def dataset(self) -> Path:
        return datasets.write_dataset(Path("data").resolve(), "a/b-v0", self.recorder.episodes, self.recorder, {})

    def own_monitor(self) -> type[NeuralASM]:
        """Under a name that nobody has taken."""
        return type("Mine", (NeuralASM,), {"kind": f"mine {next(self.numbers)}"})

    def untrained(self) -> NeuralASM:
        return NeuralASM(self.spec, hidden_size=4, association_size=4, epochs=1)


def guarded(**more: Any) -> Any:
    env = NeuralASMSafety(FakeEnv(), **({"monitor": CueMonitor()} | more))
    env.reset(seed=0)
    return env


class Made(BaseException):
    """A simulator would be made now."""


def checked_environment(**arguments: Any) -> None:
    """As far as an environment looks at its arguments before a simulator is made, which takes seconds."""

    def make() -> Any:
        raise Made

    kept, backend.import_robosuite = backend.import_robosuite, make
    try:
        RobosuiteEnv(**arguments)
    except Made:
        pass
    finally:
        backend.import_robosuite = kept


checked_environment.__signature__ = inspect.signature(RobosuiteEnv)  # type: ignore[attr-defined]

Target = tuple[Callable[..., Any], Callable[[], dict[str, Any]]]


def public(good: Good) -> dict[str, Target]:
    """Public constructors and functions, with arguments that they take."""
    row = np.zeros((1, good.spec.size))
    found: dict[str, Target] = {
        "NeuralASM": (NeuralASM, lambda: {"spec": good.spec, "hidden_size": 4, "association_size": 4}),
        "NeuralASM.fit": (lambda episodes: good.untrained().fit(episodes), lambda: {"episodes": good.episodes[:8]}),
        "NeuralASM.calibrate": (
            lambda episodes, false_alarm_rate: good.asm.calibrate(episodes, false_alarm_rate),
            lambda: {"episodes": good.episodes[14:], "false_alarm_rate": 0.1},
        ),
        "NeuralASM.initial_state": (good.asm.initial_state, lambda: {"batch": 1}),
        "NeuralASM.observe": (good.asm.observe, lambda: {"state": good.asm.initial_state(1), "stream": row}),
        "NeuralASM.reset_evidence": (good.asm.reset_evidence, lambda: {"state": good.asm.initial_state(1)}),
        "NeuralASM.threshold_at": (good.asm.threshold_at, lambda: {"false_alarm_rate": 0.2}),
        "NeuralASM.with_threshold": (good.asm.with_threshold, lambda: {"value": 2.0}),
        "NeuralASM.with_detection": (good.asm.with_detection, lambda: {"detection": "evidence"}),
        "NeuralASM.score": (good.asm.score, lambda: {"episode": good.episodes[0]}),
        "NeuralASM.adapt": (
            lambda before, stream, surprise, rate: good.asm.adapt(before, stream, surprise, rate),
            lambda: {
                "before": good.asm.initial_state(1),
                "stream": row,
                "surprise": good.asm.observe(good.asm.initial_state(1), row)[1],
                "rate": 0.01,
            },
        ),
        "NeuralASM.save": (good.asm.save, lambda: {"path": "saved.asm"}),
        "NeuralASM.load": (NeuralASM.load, lambda: {"path": good.memory_file}),
        "NeuralASM.pretrained": (NeuralASM.pretrained, lambda: {"name": "panda"}),
        "make_monitor": (make_monitor, lambda: {"name": "kalman", "spec": good.spec}),
        "monitor_class": (monitor_class, lambda: {"name": "kalman"}),
        "pretrained_for": (pretrained_for, lambda: {"spec": good.shipped.spec, "controller": "OSC_POSE"}),
        "register_monitor": (
            register_monitor,
            lambda: (lambda model: {"name": model.kind, "model": model})(good.own_monitor()),
        ),
        "load_monitor": (load_monitor, lambda: {"path": good.memory_file}),
        "Episode.from_stream": (
            episode.Episode.from_stream,
            lambda: {"x": good.episodes[0].stream, "spec": good.spec},
        ),
        "Episode.from_table": (
            episode.Episode.from_table,
            lambda: {"frame": {"a": [1.0, 2.0], "b": [0.0, 1.0]}, "channels": None, "rate": 20.0, "action": ["b"]},
        ),
        "EpisodeLabel": (episode.EpisodeLabel, lambda: {"task": "Lift", "role": "nominal"}),
        "save_episode": (episode.save_episode, lambda: {"path": "saved.npz", "episode": good.episodes[0]}),
        "load_episode": (episode.load_episode, lambda: {"path": good.episode_file}),
        "read_dataset": (datasets.read_dataset, lambda: {"path": good.dataset}),
        "write_dataset": (
            datasets.write_dataset,
            lambda: {
                "root": Path("data"),
                "dataset_id": "a/b-v0",
                "episodes": good.recorder.episodes,
                "env": good.recorder,
                "details": {},
            },
        ),
        "read_logs": (
            lambda path, layout: list(logs.read_logs(path, layout)),
            lambda: {"path": good.log_file, "layout": logs.LogLayout(spec=good.spec)},
        ),
        "Channel": (Channel, lambda: {"name": "a", "size": 2}),
        "StreamSpec": (StreamSpec, lambda: {"channels": (Channel("a", 2),), "dt": 0.05}),
        "StreamSpec.from_json": (StreamSpec.from_json, lambda: {"text": SPEC.to_json()}),
        "StreamSpec.from_spaces": (
            StreamSpec.from_spaces,
            lambda: {"observation": FakeEnv().observation_space, "action": FakeEnv().action_space, "dt": 0.05},
        ),
        "write_checkpoint": (
            checkpoint.write_checkpoint,
            lambda: {"path": "c.asm", "kind": "test", "header": {}, "arrays": {"a": np.zeros(3)}},
        ),
        "read_checkpoint": (checkpoint.read_checkpoint, lambda: {"path": good.memory_file, "kind": "neural_asm"}),
        "kind_of": (checkpoint.kind_of, lambda: {"path": good.memory_file}),
        "read_arrays": (checkpoint.read_arrays, lambda: {"path": good.arrays_file}),
        "task": (tasks.task, lambda: {"name": "Lift"}),
        "make_policy": (make_policy, lambda: {"name": "hold", "env": FakeEnv()}),
        "rollout": (rollout, lambda: {"env": FakeEnv(3), "policy": make_policy("hold", FakeEnv(3)), "seed": 0}),
        "Style": (Style, dict),
        "RolloutConfig": (RolloutConfig, dict),
        "Trial": (Trial, lambda: {"env_id": "asm_gym/Lift-v0", "seed": 0}),
        "ParallelConfig": (ParallelConfig, dict),
        "parallel_map": (parallel_map, lambda: {"task": str, "items": [1, 2], "parallel": 1}),
        "episode_seeds": (episode_seeds, lambda: {"seed": 0, "episodes": 3}),
        "draw_onset": (draw_onset, lambda: {"seed": 0, "horizon": 40}),
        "collect": (
            lambda env_id, policy, episodes, seed, workers: collect(env_id, policy, episodes, seed, workers),
            lambda: {"env_id": "Pendulum-v1", "policy": Still, "episodes": 1, "seed": 0, "workers": 1},
        ),
        "RobosuiteEnv": (checked_environment, dict),
        "NeuralASMSafety": (NeuralASMSafety, lambda: {"env": FakeEnv(), "monitor": CueMonitor()}),
        "NeuralASMSafety.step": (lambda action: guarded().step(action), lambda: {"action": np.zeros(3)}),
        "NeuralASMSafety.reset": (
            lambda seed, options: guarded().reset(seed=seed, options=options),
            lambda: {"seed": 0, "options": None},
        ),
        "VectorNeuralASMSafety": (
            VectorNeuralASMSafety,
            lambda: {"env": gym.vector.SyncVectorEnv([FakeEnv]), "monitor": FadingMonitor()},
        ),
        "FaultInjection": (FaultInjection, lambda: {"env": FakeEnv(), "faults": []}),
        "StreamRecorder": (StreamRecorder, lambda: {"env": FakeEnv()}),
        "SurpriseOverlay": (SurpriseOverlay, lambda: {"env": guarded()}),
        "StreamFeatures": (
            StreamFeatures,
            lambda: {"env": FakeEnv(), "channel": Channel("felt", 1), "features": lambda observation, info: [0.0]},
        ),
        "FlatInfo": (FlatInfo, lambda: {"env": guarded()}),
        "SafetyLog": (SafetyLog, lambda: {"env": guarded(), "writer": Nowhere()}),
        "SixValues": (SixValues, lambda: {"env": guarded()}),
        "NeuralASMPolicy": (NeuralASMPolicy, lambda: {"memory": good.fake_asm, "env": FakeEnv(own_stream=False)}),
        "CompletedObservation": (
            CompletedObservation,
            lambda: {"env": FakeEnv(own_stream=False), "monitor": good.fake_asm},
        ),
        "make_fault": (make_fault, lambda: {"name": "push"}),
        "AdaptiveThreshold": (adaptive.AdaptiveThreshold, dict),
        "conformal_episodes": (conformal.conformal_episodes, lambda: {"rate": 0.1}),
        "conformal_threshold": (conformal.conformal_threshold, lambda: {"maxima": np.arange(20.0), "rate": 0.1}),
        "EvidenceDetection": (detector.EvidenceDetection, lambda: {"spec": good.spec}),
        "wilson_interval": (statistics.wilson_interval, lambda: {"k": 1, "n": 3}),
        "binomial_interval": (statistics.binomial_interval, lambda: {"n": 3, "p": 0.5}),
        "auroc": (statistics.auroc, lambda: {"scores_pos": [1.0, 2.0], "scores_neg": [0.0]}),
    }
    return found | {f"fault {name}": (kind, dict) for name, kind in FAULTS.items()}


class Nowhere:
    """Where numbers are written."""

    def add_scalar(self, tag: str, scalar_value: float, global_step: int) -> None: ...


class Still:
    """A policy that asks for nothing."""

    def __init__(self, env: Any) -> None:
        self.action = np.zeros(env.action_space.shape, np.float32)

    def predict(
        self, observation: Any, state: Any = None, episode_start: Any = None, deterministic: bool = True
    ) -> Any:
        return self.action, state
