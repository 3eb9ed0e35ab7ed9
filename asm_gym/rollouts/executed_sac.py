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
ROUNDING = 1e-3  # of an action scaled to 1, by which two numbers are still the same


class ExecutedSAC(SAC):
    """Stable-baselines3's SAC, whose replay buffer holds the actions after guard and speed limit.

    Each transition is then one of the environment without the guard. Arguments are those of ``SAC``.

    Raises:
        UnsupportedEnvironment: a wrapper outside the guard changes actions, so that the executed action is none of the
            learner's. What no class or action space shows is raised in the first step that differs.

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
                if let_through(info) and not np.allclose(executed[n], action[n], atol=ROUNDING):
                    raise changed_by("a wrapper")
        super()._store_transition(buffer, executed, next_observation, reward, dones, infos)


def let_through(info: dict[str, Any]) -> bool:
    """Return whether the guard let the action of a step through as it was."""
    return not info["asm_intervened"] and info["asm"]["slowed"] == 0.0


def refuse_changed_actions(envs: VecEnv | None) -> None:
    """Raise UnsupportedEnvironment for a wrapper outside a guard that changes the learner's actions."""
    if envs is None:
        return
    for member in members_of(envs):
        changes = ""
        for layer in layers(member):
            if isinstance(layer, GUARDS) and changes:
                raise changed_by(changes)
            if isinstance(layer, CHANGES_ACTIONS):
                changes = type(layer).__name__
    if any(space != envs.action_space for space in guarded_spaces(envs)):
        raise changed_by("a wrapper")


def guarded_spaces(envs: VecEnv) -> list[gym.Space[Any]]:
    """Return the action spaces of the guards in a learner's vector, also of members in other processes."""
    members = members_of(envs)
    if not members:
        if not envs.has_attr("guarded_action_space"):
            return []
        return envs.get_attr("guarded_action_space")
    guards = [layer for member in members for layer in layers(member) if isinstance(layer, GUARDS)]
    return [guard.guarded_action_space for guard in guards]


def changed_by(wrapper: str) -> UnsupportedEnvironment:
    """Return the error that says what a wrapper does to the learner's actions."""
    return UnsupportedEnvironment(
        f"{wrapper} outside the guard gives the learner other actions than the guard executes, so "
        "that no executed action can be stored",
        advice="leave it out, or learn from the chosen actions (SAC, or on-policy PPO)",
    )


def members_of(envs: VecEnv | None) -> list[Any]:
    """Return the environments in a learner's vector; none where they cannot be looked into."""
    while isinstance(envs, VecEnvWrapper):  # it also has the attributes of what it wraps
        envs = envs.venv
    if isinstance(envs, LearnerVector):
        return [envs.envs]
    return list(getattr(envs, "envs", ()))
