"""A callback of stable-baselines3 that logs what the safety wrapper says: to TensorBoard, CSV, or whatever logs."""

from __future__ import annotations

from stable_baselines3.common.callbacks import BaseCallback

from asm_gym.wrappers.logging import EpisodeSafety, SafetyCounter


class SafetyCallback(BaseCallback):
    """Logs the mean of each number of the episodes that have ended: ``safety/surprise``, ``/alarms``, ``/cost``, …

    Args:
        dt: control period of the environments [s].
    """

    def __init__(self, dt: float) -> None:
        super().__init__()
        self.dt = dt

    def _on_training_start(self) -> None:
        self._counters = [SafetyCounter(self.dt) for _ in range(self.training_env.num_envs)]
        self.ended: list[EpisodeSafety] = []
        """Of all episodes that have ended."""
        self._told = 0

    def _on_step(self) -> bool:
        for counter, info, done in zip(self._counters, self.locals["infos"], self.locals["dones"], strict=True):
            counter.add(info)
            if done:
                self.ended.append(counter.total)
                counter.clear()
        for episode in self.ended[self._told :]:
            for name, value in episode._asdict().items():
                self.logger.record_mean(f"safety/{name}", float(value))
        self._told = len(self.ended)
        return True
