"""Ask one environment, or all members of a vector environment, for an attribute."""

from __future__ import annotations

from typing import Any

import gymnasium as gym
from gymnasium.vector import VectorEnv

AnyEnv = gym.Env[Any, Any] | VectorEnv[Any, Any, Any]


class EnvAttributes:
    """Attributes of an environment, or of each member of a vector environment.

    Args:
        env: an environment, or a vector environment.

    Raises:
        TypeError: the members of a vector environment cannot be asked.
    """

    def __init__(self, env: AnyEnv) -> None:
        self.env: Any = env
        self.is_vector = isinstance(env, VectorEnv)
        if isinstance(env, VectorEnv):
            self.count = askable(env).num_envs
            self.action_space = env.single_action_space
            self.observation_space = env.single_observation_space
        else:
            self.count = 1
            self.action_space = env.action_space
            self.observation_space = env.observation_space

    def has(self, name: str) -> bool:
        """Return whether each environment has an attribute."""
        return all(self.call("has_wrapper_attr", name))

    def ask(self, name: str) -> tuple[Any, ...]:
        """Return an attribute of each environment; an empty tuple where one lacks it."""
        # Gymnasium ends a worker process in which an attribute is missing: ``has`` comes first.
        if not self.has(name):
            return ()
        return self.call("get_wrapper_attr", name)

    def first(self, name: str, default: Any = None) -> Any:
        """Return an attribute of the first environment; the default where one lacks it."""
        values = self.ask(name) or (default,)
        return values[0]

    def call(self, method: str, argument: Any) -> tuple[Any, ...]:
        """Return what a method of each environment returns."""
        if self.is_vector:
            return tuple(self.env.unwrapped.call(method, argument))
        return (self.env.get_wrapper_attr(method)(argument),)


def askable(envs: VectorEnv[Any, Any, Any]) -> Any:
    """Return the innermost vector environment, whose members can be asked for attributes.

    Raises:
        TypeError: they cannot be asked.
    """
    inner: Any = envs.unwrapped
    if not (hasattr(inner, "call") and hasattr(inner, "set_attr")):
        advice = "make it with SyncVectorEnv or AsyncVectorEnv"
        raise TypeError(f"the environments in {inner} cannot be inspected: {advice}")
    return inner
