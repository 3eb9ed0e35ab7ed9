"""A callback of stable-baselines3 that logs the safety wrapper's numbers to its logger."""

from __future__ import annotations

from stable_baselines3.common.callbacks import BaseCallback

from asm_gym.wrappers.logging import EpisodeSafety, SafetyCounter


class SafetyCallback(BaseCallback):
    """Log the mean of each number of the episodes that have ended: ``safety/surprise``, ``/alarms``, ``/cost``, …

    Args:
        dt: control period of the environments [s]; by default the first of them tells.
    """

    def __init__(self, dt: float | None = None) -> None:
        super().__init__()
        self.dt = dt

    def _on_training_start(self) -> None:
        dt = self._control_period() if self.dt is None else self.dt
        self._counters = [SafetyCounter(dt) for _ in range(self.training_env.num_envs)]
        self.ended: list[EpisodeSafety] = []
        """All episodes that have ended."""

    def _control_period(self) -> float:
        """Return ``asm_gym.spec.control_period`` of environments that may be in other processes."""
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
                for name, value in counter.total._asdict().items():
                    self.logger.record_mean(f"safety/{name}", float(value))
                counter.clear()
        return True
