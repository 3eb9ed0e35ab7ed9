"""One training run for the comparison: an untrained actor, demonstrations beside, alone or under the safety wrapper.

Alone, the wrapper watches and does nothing. Under ``terminate`` an alarm costs ``cost`` and ends the episode for good:
no value follows it. Under ``hold`` nothing is taken off the reward, and the replay buffer keeps the action that was
executed: what it holds is then true of the environment without the wrapper, where the agent is to act in the end.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import torch
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.monitor import Monitor as EpisodeMonitor

from asm_gym.episode import Episode, load_episode
from asm_gym.monitors import NeuralASM
from asm_gym.rollouts.seeds import episode_seeds
from asm_gym.rollouts.training.cloning import Anchor, Cloner, fill_buffer, steps_of
from asm_gym.rollouts.training.learners import export, make_novice
from asm_gym.rollouts.training.outcome import TrainingOutcome, count
from asm_gym.rollouts.training.run import ObservationScale, success_rate
from asm_gym.rollouts.training.violations import TorqueWatch
from asm_gym.wrappers import NeuralASMSafety
from asm_gym.wrappers.cost import CostlyReward

ALONE = "alone"
CONDITIONS: dict[str, dict[str, Any]] = {
    ALONE: {"on_alarm": "monitor"},
    "terminate": {"on_alarm": "terminate"},
    "hold": {"on_alarm": "hold"},
}
"""How the wrapper is set, by the name of the condition."""
AT_LIMIT = 0.99
"""Share of a joint's torque limit from which its motor counts as standing at it."""
ANCHOR, ANCHOR_RATE = 2, 1e-3
"""Updates towards the demonstrations for each of the critic's, and their learning rate."""


@dataclass(frozen=True)
class Setting:
    """What all runs of a comparison share; the names are those of ``asm-gym reproduce safe_training``'s options."""

    env_id: str
    steps: int
    evaluate_every: int
    evaluation_episodes: int
    final_episodes: int
    force_limit: float
    cost: float
    span: int = 500


class ViolationCallback(BaseCallback):
    """Notes every step's violations, and judges the agent now and then without the wrapper."""

    def __init__(self, setting: Setting, standard: ObservationScale, judged: gym.Env[Any, Any], seed: int) -> None:
        super().__init__()
        self._setting, self._standard, self._judged, self._seed = setting, standard, judged, seed
        self.forces: list[float] = []
        self.flags: dict[str, list[bool]] = {"limited": [], "touched": [], "alarms": [], "acted": []}
        self.curve: list[tuple[int, float]] = []

    def judge(self, episodes: int, stage: int) -> float:
        """Share of successes of the agent as it is now."""
        agent = export(self.model, "sac", self._standard.mean, self._standard.scale, self._judged)
        return success_rate(agent, self._judged, episode_seeds(self._seed, episodes, stage))

    def _on_step(self) -> bool:
        info = self.locals["infos"][0]
        self.forces.append(info["external_force"])
        self.flags["limited"].append(info["torque_share"] >= AT_LIMIT)
        self.flags["touched"].append(info["torque_peak_share"] >= AT_LIMIT)
        self.flags["alarms"].append(info["asm"]["alarm"])
        self.flags["acted"].append(info["asm"]["intervened"])
        if self.num_timesteps % self._setting.evaluate_every == 0:
            self.curve.append((self.num_timesteps, self.judge(self._setting.evaluation_episodes, stage=2)))
        return True


@lru_cache(maxsize=1)
def _demonstrations(files: tuple[Path, ...]) -> list[Episode]:
    return [load_episode(f) for f in files]


def run(job: tuple[str, int], setting: Setting, memory: Path, demonstrations: Sequence[Path], folder: Path) -> Path:
    """Trains one agent, and writes its outcome.

    Args:
        job: condition and seed.
        memory: a calibrated one.
        demonstrations: episodes that lie in the replay buffer from the beginning.
        folder: for outcomes.
    """
    condition, seed = job
    path = outcome_file(folder, job)
    torch.set_num_threads(1)
    episodes = _demonstrations(tuple(demonstrations))
    observations, actions = steps_of(episodes)
    standard = ObservationScale.of(observations)
    env: gym.Env[Any, Any] = NeuralASMSafety(
        TorqueWatch(gym.make(setting.env_id)), NeuralASM.load(memory), on_overrun="ignore", **CONDITIONS[condition]
    )
    if condition == "terminate":
        env = CostlyReward(env, setting.cost)
    judged = gym.make(setting.env_id, terminate_on_success=True)
    try:
        learner = make_novice(EpisodeMonitor(standard.around(env)), seed)
        fill_buffer(learner, episodes, standard.mean, standard.scale)
        seen = ((observations - standard.mean) / standard.scale).astype(np.float32)
        cloner = Cloner(learner, seen, actions, ANCHOR_RATE, seed)
        violations = ViolationCallback(setting, standard, judged, seed)
        learner.learn(setting.steps, callback=[violations, Anchor(cloner, ANCHOR)])
        success = violations.judge(setting.final_episodes, stage=3)
    finally:
        env.close()
        judged.close()
    flags = {name: np.array(kept) for name, kept in violations.flags.items()}
    counts = count(np.array(violations.forces), setting.force_limit, flags, setting.span)
    steps, curve = len(violations.forces), tuple(violations.curve)
    outcome = TrainingOutcome(
        condition, seed, steps, setting.span, **counts, curve=curve, success=success, episodes=setting.final_episodes
    )
    path.parent.mkdir(parents=True, exist_ok=True)
    unfinished = path.with_suffix(".unfinished")
    unfinished.write_text(json.dumps(asdict(outcome)) + "\n", encoding="utf-8")
    unfinished.replace(path)
    return path


def outcome_file(folder: Path, job: tuple[str, int]) -> Path:
    """Where the outcome of a condition and a seed lies."""
    return folder / f"{job[0]}-{job[1]}.json"


def read_outcome(path: Path) -> TrainingOutcome:
    """What ``run`` wrote."""
    fields = json.loads(path.read_text(encoding="utf-8"))
    lists = {k: tuple(tuple(x) if isinstance(x, list) else x for x in v) for k, v in fields.items() if type(v) is list}
    return TrainingOutcome(**(fields | lists))
