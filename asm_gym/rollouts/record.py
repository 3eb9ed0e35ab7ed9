"""Records an episode as its label says, and writes it to its place."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np

from asm_gym.envs.robosuite_env import RobosuiteEnv
from asm_gym.episode import Episode, EpisodeLabel, save_episode
from asm_gym.rollouts.staging import environment, faults_in, interface_of, play, staged
from asm_gym.rollouts.trial import RolloutConfig, Trial
from asm_gym.wrappers import StreamRecorder


def record(label: EpisodeLabel, config: RolloutConfig, folder: Path) -> Path:
    """Records the episode of ``label``, and writes it to its place under ``folder``."""
    trial = Trial.of(label)
    forces: list[float] = []
    with staged(trial, config) as env:
        recorder = StreamRecorder(env)
        play(trial, config, recorder, lambda info: forces.append(info.get("contact_force", math.nan)))
    base = environment(trial.env_id, config.settings)
    faults = faults_in(trial, base, config) if label.role == "faulty" else ()
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
