"""Runs a policy in an environment for one episode."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import gymnasium as gym
import numpy as np

from asm_gym.policies.base import Policy
from asm_gym.validation import check_number, typed


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
        on_step: is shown every step's ``info``.
        steps: where to leave it, if it has not ended before.
    """
    if steps is not None:
        check_number("steps", steps, low=1, whole=True)
    observation, _ = env.reset(seed=seed)
    state, success, done, taken = None, False, False, 0
    start = np.ones(1, dtype=bool)
    while not done:
        action, next_state = policy.predict(observation, state=state, episode_start=start, deterministic=False)
        observation, _, terminated, truncated, info = env.step(action)
        if not info.get("overridden", False):
            state, start = next_state, np.zeros(1, dtype=bool)
        taken += 1
        done = bool(terminated or truncated) or taken == steps
        success = success or bool(info.get("success", False))
        if on_step is not None:
            on_step(info)
    return success
