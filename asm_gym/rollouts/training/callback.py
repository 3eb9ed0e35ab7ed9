"""A callback of stable-baselines3 that logs what the guard did in each episode."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

from stable_baselines3.common.callbacks import BaseCallback

from asm_gym.detection.events import FAULT, KNOCK, NO_EVENT, STOP


class EpisodeSafety(NamedTuple):
    """What the guard reported in one episode.

    Attributes:
        surprise: the greatest, in thresholds.
        alarms: how often one began.
        cost: steps in alarm.
        override_s: for how long something else than the policy acted [s].
        knocks, stops, faults: how often one of these began; see ``info["asm"]["event"]``.
    """

    surprise: float = 0.0
    alarms: int = 0
    cost: float = 0.0
    override_s: float = 0.0
    knocks: int = 0
    stops: int = 0
    faults: int = 0


class SafetyCounter:
    """Adds up the guard's reports of one episode.

    Args:
        dt: control period [s].
    """

    def __init__(self, dt: float) -> None:
        self.dt = dt
        self.clear()

    def clear(self) -> None:
        """Begin a new episode."""
        self.total, self._alarm, self._event = EpisodeSafety(), False, NO_EVENT

    def add(self, info: Mapping[str, Any]) -> None:
        """Add one step. Raises KeyError where ``info`` is not from a guarded environment."""
        if "asm" not in info:
            raise KeyError('info has no "asm": wrap the environment in NeuralASMSafety')
        alarm, total, event = bool(info["asm_alarm"]), self.total, str(info["asm"]["event"])
        begun = event if event != self._event else NO_EVENT
        self.total = EpisodeSafety(
            max(total.surprise, float(info["asm_surprise"]) / float(info["asm"]["threshold"])),
            total.alarms + (alarm and not self._alarm),
            total.cost + float(info["cost"]),
            total.override_s + self.dt * bool(info["asm_intervened"]),
            total.knocks + (begun == KNOCK),
            total.stops + (begun == STOP),
            total.faults + (begun == FAULT),
        )
        self._alarm, self._event = alarm, event


class SafetyCallback(BaseCallback):
    """Log the mean of each number of the episodes that have ended: ``safety/surprise``, ``/alarms``, ``/cost``, …

    They go to stable-baselines3's logger, and from there to TensorBoard, CSV, or Weights and Biases.

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
