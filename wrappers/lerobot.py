"""Guard a policy that runs in LeRobot: a step of the pipeline between the policy and the robot.

    row_t = [observation_t, action_t]          as LeRobot records them, by the names of motors; judged before it is sent

From an alarm on, until ``quiet_s`` without one, a hold is sent and judged in place of the policy's action. A memory
that was fitted without rests is surprised by a hold, which then does not end.

Source: LeRobot 0.4, ``lerobot/processor/pipeline.py`` (ProcessorStep).
"""

from __future__ import annotations

import logging
import re
import sys
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from asm_gym.data.gaps import blamed, reason
from asm_gym.data.rows import Pace
from asm_gym.guard.checks import check_monitor
from asm_gym.guard.engine import Engine
from asm_gym.guard.options import GuardOptions
from asm_gym.guard.report import FAILURE, RowReport
from asm_gym.guard.robots import Robots
from asm_gym.monitors import Monitor, load_monitor
from asm_gym.policies.base import Policy
from asm_gym.validation import check_choice, check_number

Floats = NDArray[np.float64]
Floats32 = NDArray[np.float32]

_log = logging.getLogger("asm_gym.lerobot")

ON_ALARM = ("hold", "stop", "monitor")  # stay where the arm stood until it is quiet; stay until ``reset``; only report

_MOTOR = re.compile(r"(?P<what>observation\.state|action)\[(?P<motor>.*\D.*)\]")
_GRIPPER = re.compile(r".*(gripper|hand|jaw).*")


class _Stay:
    """Stays where the arm stood when the override began: the first observation (A,), which is also its state."""

    def predict(
        self, observation: Any, state: Any = None, episode_start: Any = None, deterministic: bool = False
    ) -> tuple[Floats32, Any]:
        held = observation if state is None else np.where(np.isfinite(state), state, observation)
        return held.astype(np.float32), held


class LeRobotGuard:
    """A processor step; where LeRobot is installed it counts as one of its own.

    Args:
        monitor: calibrated, on a LeRobot dataset of this robot (``asm-gym fit DATASET``); or its file.
        on_alarm: one of ``ON_ALARM``.
        quiet_s: how long without an alarm until the policy acts again [s].
        clock: a clock in seconds, for the rate.

    Attributes:
        alarm, intervened: whether there was an alarm at the newest row, and whether a hold was sent.
        last_alarm: surprise in thresholds, reason and channel of the newest alarm; empty before the first.

    Example:
        >>> guard = LeRobotGuard("so101.asm")  # doctest: +SKIP
        >>> robot_action_processor = RobotProcessorPipeline([guard], ...)  # doctest: +SKIP
    """

    def __init__(
        self,
        monitor: Monitor | str | Path,
        on_alarm: str = "hold",
        quiet_s: float = 1.0,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        check_choice("on_alarm", on_alarm, ON_ALARM)
        self.on_alarm = on_alarm
        self.quiet_s = check_number("quiet_s", quiet_s, low=0.0)
        self.path = str(monitor) if isinstance(monitor, str | Path) else ""
        self.monitor: Any = load_monitor(Path(monitor)) if isinstance(monitor, str | Path) else monitor
        self._spec = self.monitor.spec
        check_monitor(self.monitor, self._spec)
        self._motors = [_motor_of(label) for label in self._spec.labels]
        self._clock = clock
        try:
            from lerobot.processor import ProcessorStep
        except ImportError:
            pass
        else:
            ProcessorStep.register(type(self))
        self.reset()

    def reset(self) -> None:
        """Begin a new episode; a stop is over."""
        self._engine: Engine | None = None  # made once the names of the actions are known
        self._pace = Pace(self._spec.dt)
        self._sent: dict[str, float] = {}
        self.alarm = self.intervened = False
        self.last_alarm: dict[str, Any] = {}

    def __call__(self, transition: Mapping[str, Any]) -> dict[str, Any]:
        """Return the transition with the action that is to be sent, and ``info["asm"]``."""
        observation, action = transition["observation"] or {}, transition["action"]
        if not isinstance(action, Mapping):
            raise TypeError(f"LeRobotGuard needs actions with names, got {type(action).__name__}")
        sent = self.guarded(observation, dict(action))
        asm = {"alarm": self.alarm, "intervened": self.intervened, **self.last_alarm}
        return {**transition, "action": sent, "info": {**(transition.get("info") or {}), "asm": asm}}

    def guarded(self, observation: Mapping[str, Any], action: dict[str, Any]) -> dict[str, Any]:
        """Return what is to be sent in place of an action; nothing where no place to stay is known."""
        self._pace.lost(self._clock())
        if self._pace.change:
            _log.warning(self._pace.change)
        if self._engine is None:
            self._names = tuple(action)
            self._engine = self._guard()
        engine, acts = self._engine, self.on_alarm != "monitor"
        wanted = np.array([action.get(name, np.nan) for name in self._names], np.float64)
        present = np.array([self._present(name, observation) for name in self._names])
        asked = wanted.astype(np.float32)

        executed: Floats32 = engine.act(asked[None], lambda _: present).actions[0] if acts else asked
        row = self._row(observation, executed)
        overriding, in_alarm = bool(engine.overriding[0]), self.alarm
        report = engine.judge(row[None], executed[None])
        self.alarm, self.intervened = bool(report.alarm[0]), bool(engine.overriding[0])
        if self.alarm:
            self.last_alarm = self._described(row, report)
            if not (overriding or in_alarm):
                _log.warning("%(channel)s %(surprise).3g thresholds", self.last_alarm)
        if self.intervened and not overriding:
            executed = engine.act(asked[None], lambda _: present).actions[0]
            engine.amend(self._row(observation, executed)[None])
        if self.intervened:
            action = {n: float(value) for n, value in zip(self._names, executed, strict=True) if np.isfinite(value)}
        self._sent = {name: float(value) for name, value in action.items() if np.isfinite(value)}
        return action

    def _guard(self) -> Engine:
        """Return the engine of one arm whose actions are known by name alone: no action of zeros makes it stay."""
        dt = self._spec.dt
        low, high, unknown = (np.full(len(self._names), value, np.float32) for value in (-np.inf, np.inf, np.nan))
        robots = Robots(1, low, high, rest=unknown, rests=False, dt=dt)
        policies: list[Policy] = [] if self.on_alarm == "monitor" else [_Stay()]
        quiet_rows = sys.maxsize if self.on_alarm == "stop" else max(1, int(np.ceil(self.quiet_s / dt)))
        options = GuardOptions(policies[0] if policies else "monitor", quiet_rows, 1.0, contact_limits=None)
        return Engine(robots, self.monitor, options, policies)

    def _described(self, row: Floats32, report: RowReport) -> dict[str, Any]:
        """Return what there is to say of an alarm."""
        at = blamed(row, report.surprise.attribution[0])
        return {
            "surprise": float(report.surprise.value[0] / report.threshold[0]),
            "reason": FAILURE if report.failure else reason(row),
            "channel": "" if at is None else self._spec.labels[at],
        }

    def _present(self, name: str, observation: Mapping[str, Any]) -> float:
        """Return where to stay: what is sensed; for a gripper the last command, or it would let go; for a speed 0."""
        if name.endswith(".vel"):
            return 0.0
        sensed = float(observation.get(name, np.nan))
        last = self._sent.get(name, sensed)
        return last if _GRIPPER.fullmatch(name.lower()) or not np.isfinite(sensed) else sensed

    def _row(self, observation: Mapping[str, Any], action: Floats32) -> Floats32:
        """Return (D,) the row of the stream; NaN where something is missing."""
        commanded = dict(zip(self._names, action.tolist(), strict=True))
        known = ((commanded if is_command else observation).get(name, np.nan) for is_command, name in self._motors)
        return np.array([float(value) for value in known], np.float32)

    def get_config(self) -> dict[str, Any]:
        """Return what LeRobot saves of this step."""
        return {"monitor": self.path, "on_alarm": self.on_alarm, "quiet_s": self.quiet_s}

    def state_dict(self) -> dict[str, Any]:
        """Return no tensors: the memory has a file of its own."""
        return {}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Take no tensors."""

    def transform_features(self, features: Any) -> Any:
        """Return the features unchanged."""
        return features


def _motor_of(label: str) -> tuple[bool, str]:
    """Return whether a number of the memory was commanded, and LeRobot's name of its motor."""
    found = _MOTOR.fullmatch(label)
    if found is None:
        raise ValueError(
            "the memory must be of a LeRobot dataset that names its motors, observation.state[MOTOR] and "
            f"action[MOTOR], got the channel {label!r}"
        )
    return found["what"] == "action", found["motor"]
