"""One policy in one task under a guard: what the study of harm compares."""

from __future__ import annotations

from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np

from asm_gym.detection.contact_limits import ContactLimits
from asm_gym.evaluation.scored_episode import POLICY_ALONE
from asm_gym.monitors import NeuralASM
from asm_gym.policies import Policy
from asm_gym.policies.hostile import HOSTILE
from asm_gym.rollouts.run_trials import policy_for
from asm_gym.rollouts.trial import RolloutConfig, Trial
from asm_gym.scripts.reproduce.kit import Record
from asm_gym.wrappers import NeuralASMSafety

GUARDS: dict[str, dict[str, Any] | None] = {
    POLICY_ALONE: None,
    "default": {},
    **{f"{v:g} m/s": {"contact_limits": ContactLimits(hand_speed=v)} for v in (0.1, 0.15, 0.25)},
    "no speed limit": {"contact_limits": ContactLimits(hand_speed=np.inf)},
    "no limits": {"contact_limits": None},
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


class Case(NamedTuple):
    """One policy in one task; its trial gets a seed for each episode."""

    kind: str  # "hostile", "healthy" or "faulty"
    policy: str
    trial: Trial
    config: RolloutConfig = RolloutConfig(robot="Panda")
    speed: float = 1.0  # share of the full action of a hostile policy

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
    settings = GUARDS[guard]
    if settings is None:
        return env
    return NeuralASMSafety(env, NeuralASM.pretrained(case.memory), **settings)
