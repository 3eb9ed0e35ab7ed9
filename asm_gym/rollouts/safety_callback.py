"""A callback of stable-baselines3 that logs what the guard did in each episode."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from stable_baselines3.common.callbacks import BaseCallback

from asm_gym.readings import spans


class GuardedStep(NamedTuple):
    """What the guard did in one step."""

    surprise: float  # in thresholds
    alarm: bool
    cost: float
    overridden: bool
    slowed: float  # share of the action that the speed limit removed


class SafetyCallback(BaseCallback):
    """Log means over finished episodes to stable-baselines3's logger.

    ``safety/surprise``: the largest surprise in thresholds. ``safety/alarms``: the number of alarms. ``safety/cost``:
    steps in alarm. ``safety/overridden``: steps in which a reflex acted. ``safety/slowed``: the mean share
    of the action that the speed limit removed.
    """

    def __init__(self) -> None:
        super().__init__()
        self.ended: list[dict[str, float]] = []  # the numbers of all episodes that have ended

    def _on_training_start(self) -> None:
        self._steps: list[list[GuardedStep]] = [[] for _ in range(self.training_env.num_envs)]

    def _on_step(self) -> bool:
        infos = self.locals["infos"]
        for steps, info, done in zip(self._steps, infos, self.locals["dones"], strict=True):
            if "asm" not in info:
                raise KeyError('info has no "asm": wrap the environment in NeuralASMSafety')
            steps.append(
                GuardedStep(
                    surprise=float(info["asm_surprise"]) / float(info["asm"]["threshold"]),
                    alarm=bool(info["asm_alarm"]),
                    cost=float(info["cost"]),
                    overridden=bool(info["asm_intervened"]),
                    slowed=float(info["asm"]["slowed"]),
                )
            )
            if done:
                self._log(
                    surprise=max(step.surprise for step in steps),
                    slowed=float(np.mean([step.slowed for step in steps])),
                    alarms=len(spans(np.array([step.alarm for step in steps]))),
                    cost=sum(step.cost for step in steps),
                    overridden=sum(step.overridden for step in steps),
                )
                steps.clear()
        return True

    def _log(self, **episode: float) -> None:
        self.ended.append(episode)
        for name, value in episode.items():
            self.logger.record_mean(f"safety/{name}", float(value))
