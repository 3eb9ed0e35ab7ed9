"""What everything that acts has in common: stable-baselines3's ``predict``; and one episode of it."""

from __future__ import annotations

import itertools
from abc import ABC, abstractmethod
from collections.abc import Callable
from typing import Any, Protocol, runtime_checkable

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

from asm_gym.validation import check_number, typed

# What a policy carries from step to step, a value: passed in and handed back, None at the start.
PolicyState = Any


@runtime_checkable
class Policy(Protocol):
    """Choose actions; every stable-baselines3 model is a policy."""

    def predict(
        self,
        observation: Any,
        state: PolicyState = None,
        episode_start: NDArray[np.bool_] | None = None,
        deterministic: bool = False,
    ) -> tuple[NDArray[np.float32], PolicyState]:
        """The action for ``observation``, and the state to pass in next time."""


class StatefulPolicy(ABC):
    """A policy whose state begins anew in every episode."""

    def begin(self, observation: Any) -> Any:
        """Return the first state of an episode; here none."""
        return None

    @abstractmethod
    def act(
        self, observation: Any, state: Any, deterministic: bool
    ) -> tuple[NDArray[np.float32], Any]:
        """Return the action (A,) and the next state."""

    def predict(
        self,
        observation: Any,
        state: PolicyState = None,
        episode_start: NDArray[np.bool_] | None = None,
        deterministic: bool = False,
    ) -> tuple[NDArray[np.float32], PolicyState]:
        """Return the action (A,), and the state to pass in next time; None, or ``episode_start``, begins an episode."""
        if state is None or (episode_start is not None and np.any(episode_start)):
            state = self.begin(observation)
        return self.act(observation, state, deterministic)


@typed
def rollout(
    env: gym.Env[Any, Any],
    policy: Policy,
    seed: int | None = None,
    on_step: Callable[[dict[str, Any]], None] | None = None,
    steps: int | None = None,
) -> bool:
    """Run one episode, until it is terminated or truncated; return whether it succeeded at some step.

    In steps in which another acted, as ``info["overridden"]`` says, the policy's state stays what it was, so that it
    resumes where it was left.

    Args:
        env: the environment.
        policy: what acts in it.
        seed: of the environment.
        on_step: is shown every step's ``info``.
        steps: where to leave it, if it has not ended before.
    """
    if steps is not None:
        check_number("steps", steps, low=1, whole=True)
    observation, _ = env.reset(seed=seed)
    state = None
    begins = np.ones(1, dtype=bool)
    success = False
    for taken in itertools.count(1):
        action, next_state = policy.predict(
            observation, state=state, episode_start=begins, deterministic=False
        )
        observation, _, terminated, truncated, info = env.step(action)
        if not info.get("overridden", False):
            state = next_state
            begins = np.zeros(1, dtype=bool)
        success = success or bool(info.get("success", False))
        if on_step is not None:
            on_step(info)
        if terminated or truncated or taken == steps:
            break
    return success
