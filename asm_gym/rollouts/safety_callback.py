"""A callback of stable-baselines3 that logs what the guard did in each episode."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from stable_baselines3.common.callbacks import BaseCallback

from asm_gym.episode import spans


class EpisodeSafety(NamedTuple):
    """What the guard reported in one episode.

    Attributes:
        surprise: the greatest, in thresholds.
        alarms: how often one began.
        cost: steps in alarm.
        override_s: for how long something else than the policy acted [s].
    """

    surprise: float
    alarms: int
    cost: float
    override_s: float


class SafetyCallback(BaseCallback):
    """Log the mean of each number of the episodes that have ended: ``safety/surprise``, ``/alarms``, ``/cost``, …

    They go to stable-baselines3's logger, and from there to TensorBoard, CSV, or Weights and Biases.

    Args:
        dt: control period of the environments [s]; by default the first of them tells.
    """

    def __init__(self, dt: float | None = None) -> None:
        super().__init__()
        self.dt = dt
        self.ended: list[EpisodeSafety] = []
        """All episodes that have ended."""

    def _on_training_start(self) -> None:
        self._dt = self._control_period() if self.dt is None else self.dt
        self._steps: list[list[tuple[float, bool, float, bool]]] = [[] for _ in range(self.training_env.num_envs)]

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
        episode = EpisodeSafety(max(surprise), len(spans(np.array(alarm))), sum(cost), self._dt * sum(overridden))
        self.ended.append(episode)
        for name, value in episode._asdict().items():
            self.logger.record_mean(f"safety/{name}", float(value))
