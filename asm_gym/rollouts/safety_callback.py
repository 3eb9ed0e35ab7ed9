"""A callback of stable-baselines3 that logs what the guard did in each episode."""

from __future__ import annotations

import numpy as np
from stable_baselines3.common.callbacks import BaseCallback

from asm_gym.data.episode import spans


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
        self._steps: list[list[tuple[float, ...]]] = [[] for _ in range(self.training_env.num_envs)]

    def _on_step(self) -> bool:
        for steps, info, done in zip(
            self._steps, self.locals["infos"], self.locals["dones"], strict=True
        ):
            if "asm" not in info:
                raise KeyError('info has no "asm": wrap the environment in NeuralASMSafety')
            surprise = float(info["asm_surprise"]) / float(info["asm"]["threshold"])
            flat = bool(info["asm_alarm"]), float(info["cost"]), bool(info["asm_intervened"])
            steps.append((surprise, *flat, float(info["asm"]["slowed"])))
            if done:
                worst, alarm, cost, overridden, slowed = zip(*steps, strict=True)
                counts = {
                    "alarms": len(spans(np.array(alarm))),
                    "cost": sum(cost),
                    "overridden": sum(overridden),
                }
                self._log(surprise=max(worst), slowed=float(np.mean(slowed)), **counts)
                steps.clear()
        return True

    def _log(self, **episode: float) -> None:
        self.ended.append(episode)
        for name, value in episode.items():
            self.logger.record_mean(f"safety/{name}", float(value))
