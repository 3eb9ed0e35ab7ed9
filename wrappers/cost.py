"""A reward that minds ``info["cost"]``."""

from __future__ import annotations

from typing import Any, SupportsFloat

import gymnasium as gym


class CostlyReward(gym.Wrapper[Any, Any, Any, Any]):
    """r - weight x cost.

    Args:
        env: one whose ``info`` holds ``"cost"``.
        weight: of the cost; may be changed at any time.
    """

    def __init__(self, env: gym.Env[Any, Any], weight: float = 0.0) -> None:
        super().__init__(env)
        self.weight = weight

    def step(self, action: Any) -> tuple[Any, SupportsFloat, bool, bool, dict[str, Any]]:
        observation, reward, terminated, truncated, info = self.env.step(action)
        return observation, float(reward) - self.weight * info["cost"], terminated, truncated, info
