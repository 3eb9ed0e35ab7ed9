"""A trained agent made worse, by another draw in each episode."""

from __future__ import annotations

from typing import Any

import gymnasium as gym
import numpy as np

from asm_gym.policies import make_policy
from asm_gym.policies.network import NetworkPolicy

WEAKEST = 0.3
"""Largest standard deviation of the share that a weight is off by; that of an episode is drawn below it."""


class Weakened:
    """An agent of which every weight is off, by another draw in each episode."""

    def __init__(self, agent: NetworkPolicy) -> None:
        self._agent, self._layers, self.predict = agent, agent.layers, agent.predict

    def set_random_seed(self, seed: int) -> None:
        """Of how far off it is."""
        rng = np.random.default_rng([seed, 3])
        size = WEAKEST * rng.random()
        self._agent.layers = [
            ((W * (1.0 + size * rng.standard_normal(W.shape))).astype(np.float32), b) for W, b in self._layers
        ]


def weakened(env: gym.Env[Any, Any], name: str) -> Weakened:
    """The agent of that name, weakened. Raises TypeError where it is no network."""
    agent = make_policy(name, env)
    if not isinstance(agent, NetworkPolicy):
        raise TypeError(f"{name} is no network whose weights could be off")
    return Weakened(agent)
