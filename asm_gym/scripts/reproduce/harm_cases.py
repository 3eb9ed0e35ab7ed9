"""One policy in one task under a guard: what the study of harm compares."""

from __future__ import annotations

from pathlib import Path
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np

from asm_gym.detection.contact_limits import ContactLimits
from asm_gym.evaluation.scored_episode import POLICY_ALONE
from asm_gym.monitors import NeuralASM
from asm_gym.policies import Policy, rollout
from asm_gym.policies.hostile import HOSTILE
from asm_gym.rollouts.run_trials import policy_for
from asm_gym.rollouts.trial import RolloutConfig, Trial
from asm_gym.scripts.reproduce.kit import Record
from asm_gym.tasks import env_id
from asm_gym.wrappers import NeuralASMSafety

GUARDS: dict[str, dict[str, Any] | None] = {
    POLICY_ALONE: None,
    "default": {},
    **{f"{v:g} m/s": {"contact_limits": ContactLimits(hand_speed=v)} for v in (0.1, 0.15, 0.25)},
    "no speed limit": {"contact_limits": ContactLimits(hand_speed=np.inf)},
    "no limits": {"contact_limits": None},
    "hold": {"on_alarm": "hold"},
    "terminate": {"on_alarm": "terminate"},
}
"""Settings of the wrapper by name; None for no wrapper."""
RAMMED_TASKS = ("Lift", "Stack", "Door", "PickPlaceCan", "NutAssemblySquare")
"""Tasks of hostile policies."""
CONTROL_RATE = 20  # rows of a memory a second [Hz]
ELSEWHERE = (
    RolloutConfig(robot="Sawyer"),
    RolloutConfig(robot="IIWA"),
    RolloutConfig(robot="Panda", stream_freq=100),
    RolloutConfig(robot="Sawyer", stream_freq=100),
    RolloutConfig(robot="IIWA", stream_freq=100),
)
"""Other arms, and another rate of the memory."""
CASE = ("kind", "task", "policy", "fault", "robot", "rate")
"""Values that distinguish one case from another."""


EARNED = "earned "  # begins the name of the default guard after so many episodes of earning
EARNING_SEED = 70_000  # of the first of these episodes


class Case(NamedTuple):
    """One policy in one task; its trial gets a seed for each episode."""

    kind: str  # "hostile", "healthy" or "faulty"
    policy: str
    trial: Trial
    config: RolloutConfig = RolloutConfig(robot="Panda")
    speed: float = 1.0  # share of the full action of a hostile policy
    folder: str = ""  # of memories that have earned speed

    @property
    def rate(self) -> int:
        """Rows of the memory a second [Hz]."""
        return self.config.stream_freq or CONTROL_RATE

    @property
    def memory(self) -> str:
        """Name of the shipped memory for the arm and the rate."""
        arm = str(self.config.robot).lower()
        if self.rate == CONTROL_RATE:
            return arm
        return f"{arm}_{self.rate}hz"

    @property
    def key(self) -> Record:
        """Values of ``CASE``."""
        policy = self.policy
        if self.speed != 1.0:
            policy += f", {self.speed:g} of full speed"
        return {
            "kind": self.kind,
            "task": self.trial.task,
            "policy": policy,
            "fault": self.trial.kind,
            "robot": self.config.robot,
            "rate": self.rate,
        }

    def make_policy(self, env: gym.Env[Any, Any]) -> Policy:
        """Return the policy for the episode of the trial's seed."""
        if self.kind == "hostile":
            return HOSTILE[self.policy](env, self.trial.seed, self.speed)
        return policy_for(self.policy, env, self.trial.seed)


def guarded(env: gym.Env[Any, Any], guard: str, case: Case) -> gym.Env[Any, Any]:
    """Return the environment under one of ``GUARDS``."""
    if guard.startswith(EARNED):
        path = earned_path(case.folder, case.trial.task, int(guard.removeprefix(EARNED)))
        return NeuralASMSafety(env, NeuralASM.load(path))
    settings = GUARDS[guard]
    if settings is None:
        return env
    return NeuralASMSafety(env, NeuralASM.pretrained(case.memory), **settings)


def earned_path(folder: str, task: str, episodes: int) -> Path:
    """Return the file of the Panda's memory after so many episodes of a task's expert under the guard."""
    return Path(folder) / f"{task} after {episodes}.asm"


def earn(job: tuple[str, str, tuple[int, ...]]) -> None:
    """Let the scripted expert earn speed under the default guard, and keep the memory after some episodes.

    Args:
        job: folder, task, and after how many episodes.
    """
    folder, task, counts = job
    if all(earned_path(folder, task, count).exists() for count in counts):
        return
    memory = NeuralASM.pretrained("panda")
    guarded_env = NeuralASMSafety(gym.make(env_id(task), robot="Panda"), memory)
    for episode in range(max(counts) + 1):
        seed = EARNING_SEED + episode
        if episode in counts:
            guarded_env.reset(seed=seed)  # which ends the episode before
            guarded_env.keep_earned_speed()
            memory.save(earned_path(folder, task, episode))
        if episode < max(counts):
            rollout(guarded_env, policy_for("scripted", guarded_env, seed), seed)
    guarded_env.close()
