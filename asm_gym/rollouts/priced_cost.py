"""Learning under a cost: the cost in the reward, at a fixed price or at one that follows a limit.

    r' = r - λ c        λ ← max(λ + η (mean c - d), 0) after each rollout

The price that follows is the multiplier of reward-constrained policy optimisation (Tessler, Mankowitz and Mannor 2019,
ICLR): c is ``info["cost"]``, d the limit of its mean.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.vec_env import VecEnv, VecEnvWrapper


class PricedCost(VecEnvWrapper):
    """Take the price of the cost off the reward.

    Args:
        envs: whose ``info`` has a ``"cost"``.
        price: λ, of one unit of cost.
    """

    def __init__(self, envs: VecEnv, price: float) -> None:
        super().__init__(envs)
        self.price = price
        self.costs: list[float] = []  # of the steps since the price was last changed

    def reset(self) -> Any:
        return self.venv.reset()

    def step_wait(self) -> Any:
        observations, rewards, dones, infos = self.venv.step_wait()
        costs: NDArray[np.float64] = np.array([float(info["cost"]) for info in infos])
        self.costs += costs.tolist()
        return observations, rewards - self.price * costs, dones, infos


class Lagrangian(BaseCallback):
    """Change the price after each rollout, so that the mean cost of a step comes to the limit.

    Args:
        priced: the vector whose price is changed.
        limit: d, of the mean cost of a step.
        rate: η, of the change.
    """

    def __init__(self, priced: PricedCost, limit: float, rate: float) -> None:
        super().__init__()
        self._priced = priced
        self._limit = limit
        self._rate = rate

    def _on_step(self) -> bool:
        return True

    def _on_rollout_end(self) -> None:
        priced = self._priced
        mean_cost = float(np.mean(priced.costs))
        priced.price = max(0.0, priced.price + self._rate * (mean_cost - self._limit))
        priced.costs.clear()
        self.logger.record("safety/price", priced.price)
