"""Guards a policy that runs in LeRobot: a step of the pipeline between the policy and the robot.

    row_t = [observation_t, action_t]          as LeRobot records them, by the names of motors
    s_t   = surprise of row_t, judged before action_t is sent

    pipeline = RobotProcessorPipeline([LeRobotGuard("so101.asm")], …)      robot_action_processor of its loops

While it is in alarm, and until ``quiet_s`` after, the robot gets what the response says, and that is what the memory is
told. A hold is a rest: a memory that has seen none is surprised by it, and the hold does not end.

Source: LeRobot 0.4, ``lerobot/processor/pipeline.py`` (ProcessorStep).
"""

from __future__ import annotations

import logging
import re
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from asm_gym.data.gaps import blamed, reason
from asm_gym.data.rows import SLOWER, Pace
from asm_gym.monitors import Monitor, load_monitor
from asm_gym.validation import check_choice, check_number

Floats = NDArray[np.float64]

_log = logging.getLogger("asm_gym.lerobot")

RESPONSES = ("hold", "stop", "slow", "monitor")
"""Stay where it stood until it is quiet; stay until ``reset``; go a fifth of the way; only say so. What goes on slowly
presses on, only later: it is for arms that can hurt nobody."""

SLOW = 0.2
"""Of the way from where it stands to where the policy wants it."""

_SENSED, _COMMANDED = (re.compile(rf"{what}(?:\[(.+)\])?") for what in (r"observation\.state", "action"))
_GRIPPER = re.compile(r".*(gripper|hand|jaw).*")


class LeRobotGuard:
    """A processor step; where LeRobot is installed it counts as one of its own.

    Args:
        monitor: calibrated, on a LeRobot dataset of this robot (``asm-gym fit DATASET``); or its file.
        on_alarm: one of ``RESPONSES``.
        quiet_s: how long without an alarm until the policy acts again [s].
        clock: seconds that go on, for the rate.

    Attributes:
        alarm: whether there was an alarm at the newest row.
        intervened: whether something else was sent than the policy asked for.
        said: surprise in thresholds, why, and the channel, of the newest alarm.

    Example:
        >>> from asm_gym.wrappers.lerobot import RESPONSES
        >>> RESPONSES[0]
        'hold'
    """

    def __init__(
        self,
        monitor: Monitor | str | Path,
        on_alarm: str = "hold",
        quiet_s: float = 1.0,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        check_choice("on_alarm", on_alarm, RESPONSES)
        self.on_alarm = on_alarm
        self.quiet_s = check_number("quiet_s", quiet_s, low=0.0)
        self.path = str(monitor) if isinstance(monitor, str | Path) else ""
        self.monitor: Any = load_monitor(Path(monitor)) if isinstance(monitor, str | Path) else monitor
        self.threshold = float(self.monitor.threshold)  # raises where it has none
        self._labels = [_name_of(label) for label in self.monitor.spec.labels]
        self._clock = clock
        try:
            from lerobot.processor import ProcessorStep  # it is theirs to say what a step is
        except ImportError:
            pass
        else:
            ProcessorStep.register(type(self))
        self.reset()

    def reset(self) -> None:
        """A new episode: nothing came before, and a stop is over."""
        self._state = self.monitor.initial_state(1)
        self._pace = Pace(self.monitor.spec.dt)
        self._sent: dict[str, float] = {}
        self._held: dict[str, float] = {}
        self._quiet = 0
        self.alarm = self.intervened = False
        self.said: dict[str, Any] = {}

    def __call__(self, transition: Mapping[str, Any]) -> dict[str, Any]:
        """The transition, with the action that is to be sent."""
        observation, action = transition["observation"] or {}, transition["action"]
        if not isinstance(action, Mapping):
            raise TypeError(f"LeRobotGuard stands where actions have names, got {type(action).__name__}")
        sent = self.guarded(observation, dict(action))
        said = {"alarm": self.alarm, "intervened": self.intervened, **self.said}
        return {**transition, "action": sent, "info": {**(transition.get("info") or {}), "asm": said}}

    def guarded(self, observation: Mapping[str, Any], action: dict[str, Any]) -> dict[str, Any]:
        """What is to be sent in place of an action."""
        self._told_the_rate()
        before, acting = self._state, bool(self._held) and self.on_alarm != "monitor"
        asked = self._response(observation, action) if acting else action  # what the policy wants now comes to nothing
        row = self._row(observation, asked)
        value, shares = self._judged(before, row)
        self.alarm = not value <= self.threshold
        if self.alarm:
            at = blamed(row, shares)
            channel = "" if at is None else self.monitor.spec.labels[at]
            if not self.said or not self._held:
                _log.warning("%s %.3g thresholds: %s", channel, value / self.threshold, self.on_alarm)
            self.said = {"surprise": value / self.threshold, "reason": reason(row), "channel": channel}
        self._quiet = 0 if self.alarm else self._quiet + 1
        if self.alarm and not self._held:
            self._held = {name: self._present(name, observation) for name in action}
        elif self.on_alarm != "stop" and self._quiet * self.monitor.spec.dt >= self.quiet_s:
            self._held = {}
        self.intervened = bool(self._held) and self.on_alarm != "monitor"
        sent = self._response(observation, action) if self.intervened else action
        if self.intervened and not acting:
            self._judged(before, self._row(observation, sent))
        self._sent = {name: float(value) for name, value in sent.items() if np.isfinite(value)}
        return sent

    def _judged(self, before: Any, row: Floats) -> tuple[float, Floats]:
        """Surprise of a row (D,) after that state, and the shares (D,) in it; the state goes on from there."""
        try:
            self._state, surprise = self.monitor.observe(before, row[None])
        except Exception:  # an override that was asked for happens
            _log.exception("the monitor failed: an alarm")
            return float("inf"), np.zeros(len(row))
        return float(surprise.value[0]), surprise.attribution[0]

    def _response(self, observation: Mapping[str, Any], action: dict[str, Any]) -> dict[str, Any]:
        if self.on_alarm != "slow":
            return {name: self._held.get(name, self._present(name, observation)) for name in action}
        here = {name: self._present(name, observation) for name in action}
        there = {name: float(v) if np.isfinite(v) else here[name] for name, v in action.items()}
        return {name: at + SLOW * (there[name] - at) for name, at in here.items()}

    def _present(self, name: str, observation: Mapping[str, Any]) -> float:
        """Where to stay: what is sensed; of a gripper what it was last told, or it would let go; of a speed nothing."""
        sensed = float(observation.get(name, np.nan))
        if name.endswith(".vel"):
            return 0.0
        last = self._sent.get(name, sensed)
        return last if _GRIPPER.fullmatch(name.lower()) or not np.isfinite(sensed) else sensed

    def _row(self, observation: Mapping[str, Any], action: Mapping[str, Any]) -> Floats:
        """(D,) NaN where something is missing."""
        numbers = [v for v in observation.values() if isinstance(v, float)], list(action.values())
        row = []
        for commanded, name in self._labels:
            said: Mapping[str, Any] = action if commanded else observation
            if name.isdigit():  # of a dataset that names no motors: by their order
                ordered = numbers[commanded]
                row.append(float(ordered[int(name)]) if int(name) < len(ordered) else np.nan)
            else:
                row.append(float(said.get(name, np.nan)))
        return np.array(row)

    def _told_the_rate(self) -> None:
        self._pace.lost(self._clock())
        if self._pace.change:
            _log.warning(self._pace.change if self._pace.kind != SLOWER else self._pace.change.partition(":")[0])

    def get_config(self) -> dict[str, Any]:
        """What LeRobot saves of it."""
        return {"monitor": self.path, "on_alarm": self.on_alarm, "quiet_s": self.quiet_s}

    def state_dict(self) -> dict[str, Any]:
        """No tensors: the memory has a file of its own."""
        return {}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Takes none."""

    def transform_features(self, features: Any) -> Any:
        """It adds and removes none."""
        return features


def _name_of(label: str) -> tuple[bool, str]:
    """Whether a number of the memory was commanded, and what LeRobot calls its motor."""
    for commanded, pattern in enumerate((_SENSED, _COMMANDED)):
        found = pattern.fullmatch(label)
        if found:
            return bool(commanded), found[1] or "0"
    raise ValueError(
        f"the memory must be of a LeRobot dataset, observation.state and action, got the channel {label!r}"
    )
