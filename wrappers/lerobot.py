"""Guard a policy that runs in LeRobot: a step of the pipeline between the policy and the robot.

    row_t = [observation_t, action_t]          as LeRobot records them, by the names of motors; judged before sending

After an alarm a hold replaces the policy's action until surprise has been low for ``release_s``. Fit the memory on
data with pauses: otherwise a hold surprises it and never ends. Only finite numbers are sent; until every joint has been
sensed or commanded once, an alarm sends nothing.

Source: LeRobot 0.4, ``lerobot/processor/pipeline.py`` (ProcessorStep).
"""

from __future__ import annotations

import logging
import re
import sys
import time
import warnings
from collections import deque
from collections.abc import Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from asm_gym.data.action_meaning import TARGET, UNKNOWN, VELOCITY, ActionMeaning, ActionMeans
from asm_gym.data.rows import ClockWentBack, Pace
from asm_gym.data.timing import blamed, reason
from asm_gym.guard.engine import Engine
from asm_gym.guard.observer import check_monitor
from asm_gym.guard.options import GuardOptions, OnAlarmName
from asm_gym.guard.preview import Preview
from asm_gym.guard.report import FAILURE, RowReport
from asm_gym.guard.robot_facts import RobotFacts
from asm_gym.guard.watchdog import Watchdog
from asm_gym.monitors import Monitor, load_monitor
from asm_gym.validation import check_choice, check_number

Floats32 = NDArray[np.float32]

_log = logging.getLogger("asm_gym.lerobot")

ON_ALARM = ("hold", "stop", "monitor")  # stay where the arm stood until it is quiet; stay until ``reset``; only report

STALLED, OVERHEATED = "stalled", "overheated"  # what is told of a servo that an alarm points to
STALL_S = 0.2  # for so long a stalled servo has not moved [s]
STALL_SHARE = 3.0  # how many times further than it moved it was told to be, throughout
TEMPERATURES, HOT_C = ("temperature", "temp"), 60.0  # names beside a servo's position; servos switch off at 70 °C

_MOTOR = re.compile(r"(?P<what>observation\.state|action)\[(?P<motor>.*\D.*)\]")
_GRIPPER = re.compile(r".*(gripper|hand|jaw).*")


class LeRobotGuard:
    """Guard a policy as a processor step of LeRobot's pipeline.

    Args:
        monitor: a monitor calibrated on a LeRobot dataset of this robot (``asm-gym fit DATASET``), or its file.
        on_alarm: ``"hold"`` until surprise is low, ``"stop"`` until ``reset``, or ``"monitor"`` only reports.
        release_s: time of surprise below 80 % of the threshold after which the policy acts again [s].
        action_means: as in ``NeuralASMSafety``, in the order of the memory's actions. By default ``.pos`` is a target
            and ``.vel`` a velocity.
        watchdog: receives a beat at every row; its death is an alarm.

    Attributes:
        alarm, intervened: whether the newest row raised an alarm, and whether a hold was sent.
        last_alarm: surprise in thresholds, reason, channel, servo and fault of the servo ("overheated", "stalled" or
            empty) of the newest alarm; empty before the first.

    Example:
        >>> guard = LeRobotGuard("so101.asm")  # doctest: +SKIP
        >>> robot_action_processor = RobotProcessorPipeline([guard], ...)  # doctest: +SKIP
    """

    def __init__(
        self,
        monitor: Monitor | str | Path,
        on_alarm: str = "hold",
        release_s: float = 1.0,
        action_means: ActionMeans | None = None,
        watchdog: Watchdog | None = None,
        quiet_s: float | None = None,
    ) -> None:
        if quiet_s is not None:  # until 0.3
            warnings.warn("quiet_s is deprecated: use release_s", DeprecationWarning, stacklevel=2)
            release_s = quiet_s
        check_choice("on_alarm", on_alarm, ON_ALARM)
        self.on_alarm = on_alarm
        self.release_s = check_number("release_s", release_s, low=0.0)
        self.path = str(monitor) if isinstance(monitor, str | Path) else ""
        self.monitor: Any = load_monitor(Path(monitor)) if isinstance(monitor, str | Path) else monitor
        self._spec = self.monitor.spec
        check_monitor(self.monitor, self._spec)
        self._motors = [_motor_of(label) for label in self._spec.labels]
        self._told, self._watchdog = action_means, watchdog
        self._rows_lately = max(2, round(STALL_S / self._spec.dt))
        with suppress(ImportError):
            from lerobot.processor import ProcessorStep

            ProcessorStep.register(type(self))
        self.reset()

    def reset(self) -> None:
        """Begin a new episode, and end a stop."""
        self._engine: Engine | None = None  # made once the names of the actions are known
        self._sent: Floats32 = np.zeros((1, 0), np.float32)  # (1, A) last
        self._pace = Pace(self._spec.dt)
        self._lately: deque[tuple[Mapping[str, Any], Mapping[str, float]]] = deque(maxlen=self._rows_lately)
        self.alarm = self.intervened = False
        self.last_alarm: dict[str, Any] = {}

    def __call__(self, transition: Mapping[str, Any]) -> dict[str, Any]:
        """Return the transition with the action to send, and with ``info["asm"]``."""
        observation, action = transition["observation"] or {}, transition["action"]
        if not isinstance(action, Mapping):
            raise TypeError(f"LeRobotGuard needs actions with names, got {type(action).__name__}")
        sent = self.guarded(observation, action)
        asm = {"alarm": self.alarm, "intervened": self.intervened, **self.last_alarm}
        return {**transition, "action": sent, "info": {**(transition.get("info") or {}), "asm": asm}}

    def preview(self, observation: Mapping[str, Any], actions: Sequence[Mapping[str, Any]]) -> Preview:
        """Return which action of a chunk leaves the range of healthy commands and why, before the first is executed.

        Execute ``actions[:at]``, then ask the policy again. Raises ValueError for a chunk without an action.
        """
        if not len(actions):
            raise ValueError("a chunk needs at least one action, got none")
        engine = self._begun(actions[0])
        chunk = np.array([[_number(action, name) for name in self._names] for action in actions], np.float32)
        return engine.preview(0, chunk, self._row(observation, self._sent[0]), self._sent[0])

    def guarded(self, observation: Mapping[str, Any], action: Mapping[str, Any]) -> dict[str, Any]:
        """Return the numbers to send in place of an action: finite ones only, and none while no position is known."""
        self._follow_clock()
        engine, acts = self._begun(action), self.on_alarm != "monitor"
        asked = np.array([_number(action, name) for name in self._names], np.float32)[None]

        row = self._row(observation, asked[0])
        engine.sense(row[None])
        executed = engine.act(asked, lambda _: None).actions if acts else asked
        row = self._row(observation, executed[0])
        overriding, in_alarm = bool(engine.overriding[0]), self.alarm
        alone = self._watchdog is not None and not self._watchdog.beat()
        report = engine.judge(row[None], self._sent, failures={0: "watchdog: it has died"} if alone else None)
        self.alarm, self.intervened = bool(report.alarm[0]), overriding or bool(engine.overriding[0])
        if self.alarm:
            self.last_alarm = self._described(row, report, observation)
            if not (overriding or in_alarm):
                _log.warning("%(channel)s %(surprise).3g thresholds", self.last_alarm)
        if self.intervened and not overriding:
            executed = engine.act(asked, lambda _: None).actions
            engine.amend(self._row(observation, executed[0])[None])
        self._lately.append((dict(observation), dict(zip(self._names, self._sent[0].tolist(), strict=True))))
        if not self.intervened:
            self._sent = np.where(np.isfinite(asked), asked, self._sent)
            return {name: value for name, value in action.items() if np.isfinite(_number(action, name))}
        if not np.isfinite(executed).all():
            return {}  # a place that is not known
        self._sent = executed
        return dict(zip(self._names, executed[0].tolist(), strict=True))

    def _begun(self, action: Mapping[str, Any]) -> Engine:
        """Return the engine, which is made once the names of the actions are known."""
        if self._engine is None:
            commanded = [name for is_command, name in self._motors if is_command]
            self._names = tuple(dict.fromkeys([*commanded, *action]))
            self._engine, self._sent = self._guard(), np.full((1, len(self._names)), np.nan, np.float32)
        return self._engine

    def _follow_clock(self) -> None:
        """Say where rows come at another rate than the memory reads."""
        try:
            self._pace.lost(time.monotonic())
        except ClockWentBack as error:
            self._pace = Pace(self._spec.dt)
            _log.warning("%s", error)
        if self._pace.change:
            _log.warning(self._pace.change)

    def _guard(self) -> Engine:
        """Return the engine of one arm whose actions are known by name."""
        dt, size = self._spec.dt, len(self._names)
        low, high, unknown = (np.full(size, value, np.float32) for value in (-np.inf, np.inf, np.nan))
        grip = np.flatnonzero([bool(_GRIPPER.fullmatch(name.lower())) for name in self._names])
        robots = RobotFacts(1, low, high, rest=unknown, grip=grip, dt=dt, meaning=self._meaning())
        release_rows = sys.maxsize if self.on_alarm == "stop" else max(1, int(np.ceil(self.release_s / dt)))
        reaction: OnAlarmName = "hold" if self.on_alarm != "monitor" else "monitor"
        return Engine(robots, self.monitor, GuardOptions(reaction, release_rows, contact_limits=None))

    def _meaning(self) -> ActionMeaning:
        """Return what the actions mean: what is told, or what LeRobot's names say.

        Raises:
            ValueError: they are to be held, and some are torques, or neither a position nor a velocity by their names.
        """
        state = {name: column for column, (is_command, name) in enumerate(self._motors) if not is_command}
        means = [VELOCITY if n.endswith(".vel") else TARGET if n.endswith(".pos") else UNKNOWN for n in self._names]
        if self._told is not None:
            means = list(ActionMeaning.told(self._told, len(means)).means)
        senses = [state.get(n, -1) if m == TARGET else -1 for n, m in zip(self._names, means, strict=True)]
        slopes = [float(sense >= 0) for sense in senses]
        meaning = ActionMeaning(tuple(means), tuple(senses), tuple(slopes), (0.0,) * len(means))
        if self.on_alarm != "monitor":
            meaning.check_stays("this robot", self._names)
        return meaning

    def _described(self, row: Floats32, report: RowReport, observation: Mapping[str, Any]) -> dict[str, Any]:
        """Return what there is to say of an alarm."""
        at = blamed(row, report.surprise.attribution[0])
        motor = "" if at is None else self._motors[at][1]
        return {
            "surprise": float(report.surprise.value[0] / report.threshold[0]),
            "reason": FAILURE if report.failure else reason(row),
            "channel": "" if at is None else self._spec.labels[at],
            "servo": motor.rpartition(".")[0] or motor,
            "fault": self._fault_of(motor, observation),
        }

    def _fault_of(self, motor: str, observation: Mapping[str, Any]) -> str:
        """Return whether a servo is overheated, or has stalled: it has long been told to move and did not; or empty.

        Its temperature is read where the observation holds one beside the position, such as ``elbow_flex.temperature``.
        """
        servo = motor.rpartition(".")[0] or motor
        degrees = max((_number(observation, f"{servo}.{name}") for name in TEMPERATURES), key=np.nan_to_num)
        if degrees >= HOT_C:
            return OVERHEATED
        pairs = [(_number(sensed, motor), sent.get(motor, np.nan)) for sensed, sent in self._lately]
        sensed, sent = np.array(pairs, np.float64).reshape(-1, 2).T
        if len(pairs) < self._rows_lately or not (np.isfinite(sensed).all() and np.isfinite(sent).all()):
            return ""
        return STALLED if np.abs(sent - sensed).min() > STALL_SHARE * np.ptp(sensed) and np.ptp(sent) > 0 else ""

    def _row(self, observation: Mapping[str, Any], action: Floats32) -> Floats32:
        """Return (D,) the row of the stream; NaN where something is missing."""
        commanded = dict(zip(self._names, action.tolist(), strict=True))
        known = (_number(commanded if is_command else observation, name) for is_command, name in self._motors)
        return np.array(list(known), np.float32)

    def get_config(self) -> dict[str, Any]:
        """Return what LeRobot saves of this step."""
        return {"monitor": self.path, "on_alarm": self.on_alarm, "release_s": self.release_s}

    def state_dict(self) -> dict[str, Any]:
        """Return no tensors: the memory has a file of its own."""
        return {}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Take no tensors."""

    def transform_features(self, features: Any) -> Any:
        """Return the features unchanged."""
        return features


def _number(values: Mapping[str, Any], name: str) -> float:
    """Return a number by name; NaN where there is none."""
    try:
        return float(values.get(name, np.nan))
    except (TypeError, ValueError):
        return float("nan")


def _motor_of(label: str) -> tuple[bool, str]:
    """Return whether a number of the memory was commanded, and LeRobot's name of its motor."""
    found = _MOTOR.fullmatch(label)
    if found is None:
        raise ValueError(
            "the memory must be fitted on a LeRobot dataset that names its motors, observation.state[MOTOR] and "
            f"action[MOTOR], got the channel {label!r}"
        )
    return found["what"] == "action", found["motor"]
