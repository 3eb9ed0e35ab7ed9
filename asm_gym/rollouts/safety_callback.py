"""A callback of stable-baselines3 that logs what the guard did in each episode."""

from __future__ import annotations

from typing import Any

import numpy as np
from stable_baselines3.common.callbacks import BaseCallback

from asm_gym.episode import spans


class SafetyCallback(BaseCallback):
    """Log the mean over the episodes that have ended, to stable-baselines3's logger.

    ``safety/surprise``: the greatest, in thresholds. ``safety/alarms``: how often one began. ``safety/cost``: steps in
    alarm. ``safety/override_s``: for how long something else than the policy acted [s].

    Args:
        dt: control period of the environments [s]; by default the first of them tells.
    """

    def __init__(self, dt: float | None = None) -> None:
        super().__init__()
        self.dt = dt
        self.ended: list[dict[str, float]] = []
        """The numbers of all episodes that have ended."""

    def _on_training_start(self) -> None:
        self._steps: list[list[tuple[float, bool, float, bool]]] = [[] for _ in range(self.training_env.num_envs)]
        if self.dt is None:
            self.dt = self._control_period()

    def _control_period(self) -> float:
        """Return ``asm_gym.spec.control_period`` of environments that may be in other processes."""
        try:
            return float(self.training_env.get_attr("dt", 0)[0])
        except AttributeError:
            rate = (self.training_env.get_attr("metadata", 0)[0] or {}).get("render_fps")
            return 1.0 / rate if rate else 1.0

    def _on_step(self) -> bool:
        for steps, info, done in zip(self._steps, self.locals["infos"], self.locals["dones"], strict=True):
            if "asm" not in info:
                raise KeyError('info has no "asm": wrap the environment in NeuralASMSafety')
            surprise = float(info["asm_surprise"]) / float(info["asm"]["threshold"])
            steps.append((surprise, bool(info["asm_alarm"]), float(info["cost"]), bool(info["asm_intervened"])))
            if done:
                self._end_episode(steps)
                steps.clear()
        return True

    def _end_episode(self, steps: list[Any]) -> None:
        surprise, alarm, cost, overridden = zip(*steps, strict=True)
        episode = {
            "surprise": max(surprise),
            "alarms": float(len(spans(np.array(alarm)))),
            "cost": sum(cost),
            "override_s": (self.dt or 0.0) * sum(overridden),
        }
        self.ended.append(episode)
        for name, value in episode.items():
            self.logger.record_mean(f"safety/{name}", value)
