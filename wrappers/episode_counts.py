"""Let a wrapper that counts episodes stand inside a guard, and see the ends and costs that the guard reports.

``make_vec_env(id, wrapper_class=NeuralASMSafety)`` of Stable-Baselines3 puts its Monitor there. The guard steps the
environment beneath the counting wrapper, and then steps the wrapper once, which is handed the guard's outcome.
"""

from __future__ import annotations

from typing import Any

import gymnasium as gym
from gymnasium.wrappers import RecordEpisodeStatistics

MONITOR = "stable_baselines3.common.monitor"


class Relay(gym.Wrapper[Any, Any, Any, Any]):
    """Pass on ``outcome`` in place of one step, where there is one."""

    outcome: tuple[Any, ...] | None = None

    def step(self, action: Any) -> Any:
        outcome, self.outcome = self.outcome, None
        return self.env.step(action) if outcome is None else outcome


def relay_beneath_counts(env: gym.Env[Any, Any], ends: bool) -> Relay | None:
    """Put a relay beneath the counting wrappers that stand outermost in ``env``, and return it; None without any.

    Args:
        ends: the guard may end episodes, which a counting wrapper further inside would not see.

    Raises:
        ValueError: there is such a wrapper.
    """
    layer: Any = env
    counting: Any = None
    while isinstance(layer, gym.Wrapper) and _counts(layer):
        layer, counting = layer.env, layer
    inner: Any = layer
    while ends and isinstance(inner, gym.Wrapper):
        if _counts(inner):
            name = type(inner).__name__
            raise ValueError(
                f"{name} counts episodes inside, and would not see those that the guard ends: put it outside, as in "
                f"{name}(NeuralASMSafety(env, monitor)), or directly beneath the guard"
            )
        inner = inner.env
    if counting is None:
        return None
    relay = layer if isinstance(layer, Relay) else Relay(layer)
    counting.env = relay
    return relay


def _counts(layer: Any) -> bool:
    known = isinstance(layer, RecordEpisodeStatistics)
    return known or any(kind.__module__ == MONITOR for kind in type(layer).__mro__)
