"""A callback of stable-baselines3 that logs what the safety wrapper says: to TensorBoard, CSV, or whatever logs."""

from __future__ import annotations

from stable_baselines3.common.callbacks import BaseCallback

from asm_gym.wrappers.logging import EpisodeSafety, SafetyCounter


class SafetyCallback(BaseCallback):
    """Logs the mean of each number of the episodes that have ended: ``safety/surprise``, ``/alarms``, ``/cost``, …

    Args:
        dt: control period of the environments [s]; where None, what the first of them says.
    """

    def __init__(self, dt: float | None = None) -> None:
        super().__init__()
        self.dt = dt

    def _on_training_start(self) -> None:
        dt = self._control_period() if self.dt is None else self.dt
        self._counters = [SafetyCounter(dt) for _ in range(self.training_env.num_envs)]
        self.ended: list[EpisodeSafety] = []
        """Of all episodes that have ended."""
        self._told = 0

    def _control_period(self) -> float:
        """As ``asm_gym.spec.control_period`` has it, of environments that may be in other processes."""
        try:
            return float(self.training_env.get_attr("dt", 0)[0])
        except AttributeError:
            rate = (self.training_env.get_attr("metadata", 0)[0] or {}).get("render_fps")
            return 1.0 / rate if rate else 1.0

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
