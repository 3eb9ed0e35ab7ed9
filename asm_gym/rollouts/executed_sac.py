"""SAC that learns from what was done, where a guard changes its actions."""

from __future__ import annotations

from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.vector import VectorActionWrapper
from stable_baselines3 import SAC
from stable_baselines3.common.vec_env import VecEnv, VecEnvWrapper

from asm_gym.control_period import layers
from asm_gym.exceptions import UnsupportedEnvironment
from asm_gym.rollouts.learner_vector import LearnerVector
from asm_gym.wrappers import NeuralASMSafety, VectorNeuralASMSafety

CHANGES_ACTIONS = gym.ActionWrapper | VectorActionWrapper
GUARDS = NeuralASMSafety | VectorNeuralASMSafety


class ExecutedSAC(SAC):
    """Stable-baselines3's SAC, whose replay buffer holds the actions after guard and speed limit.

    Each transition is then one of the environment without the guard. Arguments are those of ``SAC``.

    Raises:
        UnsupportedEnvironment: a wrapper outside the guard changes actions, so that the executed action is none of the
            learner's.

    Example:
        >>> import gymnasium as gym
        >>> from asm_gym import NeuralASMSafety
        >>> from asm_gym.rollouts.executed_sac import ExecutedSAC
        >>> env = NeuralASMSafety(gym.make("asm_gym/Lift-v0"))
        >>> ExecutedSAC("MlpPolicy", env, learning_starts=10).learn(12).replay_buffer.size()
        12
    """

    def set_env(self, env: Any, force_reset: bool = True) -> None:
        """Learn in another environment."""
        super().set_env(env, force_reset)
        refuse_changed_actions(self.env)

    def _setup_model(self) -> None:
        super()._setup_model()
        refuse_changed_actions(self.env)

    def _store_transition(
        self,
        buffer: Any,
        action: Any,
        next_observation: Any,
        reward: Any,
        dones: Any,
        infos: Any,
    ) -> None:
        executed = np.array(action)
        for n, info in enumerate(infos):
            if "asm" in info:
                executed[n] = self.policy.scale_action(info["asm"]["executed_action"])
        super()._store_transition(buffer, executed, next_observation, reward, dones, infos)


def refuse_changed_actions(envs: VecEnv | None) -> None:
    """Raise UnsupportedEnvironment for a wrapper outside a guard that changes the learner's actions."""
    for member in members_of(envs):
        changes = ""
        for layer in layers(member):
            if isinstance(layer, GUARDS) and changes:
                raise UnsupportedEnvironment(
                    f"{changes} outside the guard gives the learner other actions than the guard "
                    "executes, so that no executed action can be stored",
                    advice="leave it out, or learn from the chosen actions (SAC, or on-policy PPO)",
                )
            if isinstance(layer, CHANGES_ACTIONS):
                changes = type(layer).__name__


def members_of(envs: VecEnv | None) -> list[Any]:
    """Return the environments in a learner's vector; none where they cannot be looked into."""
    while isinstance(envs, VecEnvWrapper):  # it also has the attributes of what it wraps
        envs = envs.venv
    if isinstance(envs, LearnerVector):
        return [envs.envs]
    return list(getattr(envs, "envs", ()))
