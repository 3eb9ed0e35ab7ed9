"""What others' learners and their logs read: numbers of each episode, flat infos, and safety-gymnasium's six values."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple, Protocol, SupportsFloat

import gymnasium as gym
import numpy as np
from gymnasium.utils import RecordConstructorArgs
from numpy.typing import NDArray

from asm_gym.detection.events import FAULT, KNOCK, NO_EVENT, STOP
from asm_gym.spec import control_period
from asm_gym.validation import check_text, typed

FLAT = ("cost", "asm_surprise", "asm_alarm", "asm_intervened")
"""What the safety wrapper says in numbers, beside its dictionary."""


class EpisodeSafety(NamedTuple):
    """An episode in numbers.

    Attributes:
        surprise: the greatest, in thresholds.
        alarms: how often one began.
        knocks, stops, faults: how often one of these began; see ``info["asm"]["event"]``.
        cost: steps in alarm.
        override_s: for how long something else than the policy acted [s].
    """

    surprise: float = 0.0
    alarms: int = 0
    cost: float = 0.0
    override_s: float = 0.0
    knocks: int = 0
    stops: int = 0
    faults: int = 0


class SafetyCounter:
    """Adds up what the safety wrapper says of each step of an episode.

    Args:
        dt: control period [s].
    """

    def __init__(self, dt: float) -> None:
        self.dt = dt
        self.clear()

    def clear(self) -> None:
        """A new episode begins."""
        self.total, self._alarm, self._event = EpisodeSafety(), False, NO_EVENT

    def add(self, info: Mapping[str, Any]) -> None:
        """One step. Raises KeyError where ``info`` is of no watched environment."""
        if "asm" not in info:
            raise KeyError('info has no "asm": put this outside of NeuralASMSafety')
        alarm, so_far = bool(info["asm_alarm"]), self.total
        event = str(info["asm"].get("event", NO_EVENT))
        begun = [event == which and event != self._event for which in (KNOCK, STOP, FAULT)]
        self.total = EpisodeSafety(
            max(so_far.surprise, float(info["asm_surprise"]) / float(info["asm"]["threshold"])),
            so_far.alarms + (alarm and not self._alarm),
            so_far.cost + float(info["cost"]),
            so_far.override_s + self.dt * bool(info["asm_intervened"]),
            *(count + one for count, one in zip(so_far[4:], begun, strict=True)),
        )
        self._alarm, self._event = alarm, event


class Writer(Protocol):
    """Where numbers go: ``torch.utils.tensorboard.SummaryWriter`` is one."""

    def add_scalar(self, tag: str, scalar_value: float, global_step: int) -> None: ...


class WandbWriter:
    """Writes to a run of Weights and Biases, ``wandb.init(mode="offline")`` for instance."""

    def __init__(self, run: Any) -> None:
        self.run = run

    def add_scalar(self, tag: str, scalar_value: float, global_step: int) -> None:
        """One number."""
        self.run.log({tag: scalar_value}, step=global_step)


class SafetyLog(gym.Wrapper[Any, Any, Any, Any], RecordConstructorArgs):
    """Writes the numbers of each episode that ends, as ``safety/surprise`` and so on, at the count of steps so far.

    Args:
        env: a watched environment.
        writer: whatever has ``add_scalar(tag, value, step)``: TensorBoard's SummaryWriter, or ``WandbWriter(run)``.
        prefix: of the names.
    """

    @typed
    def __init__(self, env: gym.Env[Any, Any], writer: Writer, prefix: str = "safety") -> None:
        RecordConstructorArgs.__init__(self, _disable_deepcopy=True, writer=writer, prefix=prefix)
        gym.Wrapper.__init__(self, env)
        self.writer, self.prefix = writer, check_text("prefix", prefix)
        self._counter, self._steps = SafetyCounter(control_period(env)), 0

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        self._counter.clear()
        return self.env.reset(seed=seed, options=options)

    def step(self, action: Any) -> tuple[Any, SupportsFloat, bool, bool, dict[str, Any]]:
        observation, reward, terminated, truncated, info = self.env.step(action)
        self._counter.add(info)
        self._steps += 1
        if terminated or truncated:
            for name, value in self._counter.total._asdict().items():
                self.writer.add_scalar(f"{self.prefix}/{name}", float(value), self._steps)
        return observation, reward, terminated, truncated, info


class FlatInfo(gym.Wrapper[Any, Any, Any, Any], RecordConstructorArgs):
    """Leaves in ``info`` only numbers, the same ones at every step, float32 where they are no booleans.

    TorchRL reads them so: by ``GymWrapper(FlatInfo(env)).auto_register_info_dict()``, or by its
    ``default_info_dict_reader(["cost"])``.

    Args:
        env: a watched environment.
        keys: what to keep.
    """

    @typed
    def __init__(self, env: gym.Env[Any, Any], keys: Sequence[str] = FLAT) -> None:
        RecordConstructorArgs.__init__(self, keys=keys)
        gym.Wrapper.__init__(self, env)
        self.keys = tuple(keys)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        observation, info = self.env.reset(seed=seed, options=options)
        return observation, self._flat(info)

    def step(self, action: Any) -> tuple[Any, SupportsFloat, bool, bool, dict[str, Any]]:
        observation, reward, terminated, truncated, info = self.env.step(action)
        return observation, reward, terminated, truncated, self._flat(info)

    def _flat(self, info: Mapping[str, Any]) -> dict[str, NDArray[Any]]:
        missing = [key for key in self.keys if key not in info]
        if missing:
            raise KeyError(f"info has no {', '.join(missing)}: put FlatInfo outside of NeuralASMSafety")
        numbers = {key: np.asarray(info[key]) for key in self.keys}
        return {key: n if n.dtype == np.bool_ else n.astype(np.float32) for key, n in numbers.items()}


class SixValues(gym.Wrapper[Any, Any, Any, Any], RecordConstructorArgs):
    """``step`` returns what safety-gymnasium's does: observation, reward, cost, terminated, truncated, info.

    Args:
        env: one whose ``info`` has ``"cost"``.
    """

    @typed
    def __init__(self, env: gym.Env[Any, Any]) -> None:
        RecordConstructorArgs.__init__(self)
        gym.Wrapper.__init__(self, env)

    def step(self, action: Any) -> tuple[Any, ...]:
        """The six."""
        observation, reward, terminated, truncated, info = self.env.step(action)
        return observation, float(reward), float(info["cost"]), terminated, truncated, info
