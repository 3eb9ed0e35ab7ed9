"""Guard a policy that runs in LeRobot: a step of the pipeline between the policy and the robot.

    row_t = [observation_t, action_t]    as LeRobot records them, by motor; judged before sending

After an alarm a hold replaces the policy's action until surprise has been low for ``release_s``.
Fit the memory on data with pauses: otherwise a hold surprises it and never ends. Only finite
numbers are sent; until every joint has been sensed or commanded once, an alarm sends nothing.

Source: LeRobot 0.4, ``lerobot/processor/pipeline.py`` (ProcessorStep).
"""

from __future__ import annotations

import logging
import sys
import time
import warnings
from collections.abc import Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from asm_gym.data.action_meaning import ActionMeans
from asm_gym.data.alarm_reasons import blamed, reason
from asm_gym.data.live_clock import ClockWentBack, Pace
from asm_gym.detection.commands import command_limits
from asm_gym.guard.adapter import Adapter, SensedRows
from asm_gym.guard.alarm_terms import FAILURE, OUT_OF_RANGE
from asm_gym.guard.chunk_preview import Preview
from asm_gym.guard.fitted_monitor import check_monitor
from asm_gym.guard.guard import Guard
from asm_gym.guard.options import GuardOptions, OnAlarmName
from asm_gym.guard.robot_table import Floats32
from asm_gym.guard.step_info import RowReport
from asm_gym.guard.watchdog import Watchdog
from asm_gym.monitors import Monitor, load_monitor
from asm_gym.monitors.blame import FollowedBlame
from asm_gym.validation import check_choice, check_number
from asm_gym.wrappers.lerobot_arm import (
    COMMANDED,
    SENSED,
    LoopStep,
    column_of,
    meaning_of,
    number_of,
    robots_of,
    row_of,
    servo_of,
)
from asm_gym.wrappers.servo_diagnosis import CURRENT, STALLED, ServoHistory, stall_currents

_log = logging.getLogger("asm_gym.lerobot")

# Stay where the arm stood until surprise is low; stay until ``reset``; only report.
ON_ALARM = ("hold", "stop", "monitor")
STALL = "stall"  # reason of an alarm
UNLOAD = "unload"  # response to it


class LeRobotGuard(Adapter):
    """Guard a policy as a processor step of LeRobot's pipeline.

    Args:
        monitor: a monitor calibrated on a LeRobot dataset of this robot (``asm-gym fit DATASET``),
            or its file.
        on_alarm: ``"hold"`` until surprise is low, ``"stop"`` until ``reset``, or ``"monitor"``
            only reports.
        release_s: time of surprise below 80 % of the threshold after which the policy acts
            again [s].
        action_means: as in ``NeuralASMSafety``, in the order of the memory's actions. By default
            ``.pos`` is a target and ``.vel`` a velocity.
        watchdog: receives a beat at every row; its death is an alarm.

    Attributes:
        alarm, intervened: whether the newest row raised an alarm, and whether a hold was sent.
        last_alarm: surprise in thresholds, reason, channel, servo, fault of the servo
            ("overheated", "stalled" or empty) and response of the newest alarm; empty before the
            first. Where a servo has stalled, the reason is "stall" and the response "unload": its
            target becomes where it stands, so that its current falls.

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
        self.path = ""
        if isinstance(monitor, str | Path):
            self.path = str(monitor)
            monitor = load_monitor(Path(monitor))
        self.monitor: Any = monitor
        self._spec = monitor.spec
        check_monitor(monitor, self._spec)
        self._columns = [column_of(label) for label in self._spec.labels]
        self._action_means = action_means
        self._watchdog = watchdog
        with suppress(ImportError):
            from lerobot.processor import ProcessorStep

            ProcessorStep.register(type(self))
        self.reset()

    def reset(self) -> None:
        """Begin a new episode, and end a stop."""
        self._guard: Guard | None = None  # made once the names of the actions are known
        self._sent: dict[str, float] = {}  # the newest finite number that was sent, by name
        self._unloaded: dict[str, float] = {}  # targets of servos that stalled in this hold
        self._pace = Pace(self._spec.dt)
        self._history = ServoHistory(self._spec.dt, stall_currents(self.monitor, self._columns))
        self._blame = FollowedBlame(self.monitor)
        self.alarm = False
        self.intervened = False
        self.last_alarm: dict[str, Any] = {}

    def __call__(self, transition: Mapping[str, Any]) -> dict[str, Any]:
        """Return the transition with the action to send, and with ``info["asm"]``."""
        action = transition["action"]
        if not isinstance(action, Mapping):
            raise TypeError(f"LeRobotGuard needs actions with names, got {type(action).__name__}")
        sent = self.guarded(transition["observation"] or {}, action)
        info = dict(transition.get("info") or {})
        info["asm"] = {"alarm": self.alarm, "intervened": self.intervened, **self.last_alarm}
        return {**transition, "action": sent, "info": info}

    def preview(
        self,
        observation: Mapping[str, Any],
        actions: Sequence[Mapping[str, Any]],
    ) -> Preview:
        """Return which action of a chunk leaves the range of healthy commands and why.

        Execute ``actions[:at]``, then ask the policy again.

        Raises:
            ValueError: a chunk without an action, or names that the memory does not know.
        """
        if not len(actions):
            raise ValueError("a chunk needs at least one action, got none")
        for action in actions:
            guard = self._guard_for(action)
        chunk = np.concatenate([self._numbers(action) for action in actions])  # (k, A)
        row = row_of(LoopStep(observation, self._sent), self._columns)[0]
        return guard.preview(0, chunk, row, self._numbers(self._sent)[0])

    def guarded(self, observation: Mapping[str, Any], action: Mapping[str, Any]) -> dict[str, Any]:
        """Return the numbers to send in place of an action: finite ones only.

        Args:
            observation: numbers that were sensed, by name.
            action: numbers that the policy wants, by name.

        Returns:
            Numbers by name; none in an alarm while no position is known.
        """
        self._check_rate()
        guard = self._guard_for(action)
        step = LoopStep(observation, action)
        guard.sense(row_of(step, self._columns))
        if self.on_alarm != "monitor":
            step = LoopStep(observation, self._chosen(guard, action))
        sensed = self.sense_rows(step)
        report = guard.judge(sensed, executed=self._numbers(self._sent))
        self.report_step([report], step)

        overrides = bool(report.robots["overridden"][0])
        self.intervened = overrides or bool(guard.overriding[0])
        if self.intervened and not overrides:  # the hold begins before anything is sent
            step = LoopStep(observation, self._chosen(guard, action))
            guard.amend(row_of(step, self._columns))
        self._history.append(observation, self._sent)
        command = action
        if self.intervened:
            command = step.command
            if not np.isfinite(self._numbers(command)).all():  # no position is known
                return {}
        return self.send_command(command)

    def sense_rows(self, given: LoopStep) -> SensedRows:
        """Return the row of a step, and tell the watchdog of it."""
        row = row_of(given, self._columns)
        failure = self._beyond_range(row[0], given)
        stalled = self._history.overloaded(given.observation)
        if stalled:
            position = f"{stalled}.pos"
            sensed = number_of(given.observation, position)
            if np.isfinite(sensed):
                self._unloaded[position] = sensed
            failure = f"{STALL}: {stalled} does not move and takes more current than ever learned"
        if self._watchdog is not None and not self._watchdog.beat():
            failure = "watchdog: it has died"
        return SensedRows(row, failures={0: failure} if failure else {})

    def _beyond_range(self, row: Floats32, step: LoopStep) -> str:
        """Return which position is beyond what healthy policies command, or which command; else empty.

        An arm that pursues its targets goes where they are. A command is checked before it is sent,
        but for ``"monitor"``, which sends all.
        """
        if self._healthy is None:
            return ""
        least, most, _ = self._healthy
        sensed = self._meaning.sensed_target(row)
        values = {"is at": sensed}
        if self.on_alarm == "monitor":
            values["is commanded"] = self._numbers(step.command)[0]
        for what, numbers in values.items():
            beyond = np.flatnonzero((numbers < least) | (numbers > most))
            if len(beyond):
                k = int(beyond[0])
                range_text = f"{least[k]:.4g} to {most[k]:.4g}"
                return (
                    f"range: {self._names[k]} {what} {numbers[k]:.4g}, and healthy is {range_text}"
                )
        return ""

    def send_command(self, command: Mapping[str, Any]) -> dict[str, Any]:
        """Return and remember the finite numbers of a command, for LeRobot to send."""
        finite = {}
        for name, value in command.items():
            number = number_of(command, name)
            if np.isfinite(number):
                finite[name] = value
                self._sent[name] = number
        return finite

    def report_step(self, reports: Sequence[RowReport], target: LoopStep) -> None:
        """Keep what there is to say of an alarm, and log the first of several."""
        report = reports[-1]
        was_alarm = self.alarm
        self.alarm = bool(report.robots["alarm"][0])
        row = row_of(target, self._columns)[0]
        shares = self._blame.shares(row, self.alarm, report.attribution[0])
        if not self.alarm:
            return
        self.last_alarm = self._description(report, row, shares, target)
        if not (was_alarm or report.robots["overridden"][0]):
            _log.warning("%(channel)s %(surprise).3g thresholds", self.last_alarm)

    def _guard_for(self, action: Mapping[str, Any]) -> Guard:
        """Return the guard, which is made with the first action.

        Raises:
            ValueError: the action has names that the memory does not know.
        """
        if self._guard is None:
            commanded = [column.motor for column in self._columns if column.group == COMMANDED]
            self._names = tuple(dict.fromkeys(commanded or action))
            self._guard = self._new_guard()
        unknown = [name for name in action if name not in self._names]
        if unknown:
            raise ValueError(
                f"the memory knows no action called {', '.join(map(str, unknown[:6]))}; it knows "
                f"{', '.join(self._names)}"
            )
        return self._guard

    def _new_guard(self) -> Guard:
        """Return the guard of one arm whose actions are known by name.

        Raises:
            ValueError: the actions are to be held, and some are torques, or neither a position nor
                a velocity by their names.
        """
        dt = self._spec.dt
        meaning = meaning_of(self._names, self._spec.labels, self._action_means)
        self._meaning = meaning
        commands = getattr(self.monitor, "commands_", None)
        self._healthy = None  # (3, A) least, most and greatest step of healthy commands
        if commands is not None and commands.shape[1] == len(self._names):
            self._healthy = command_limits(commands)
        reaction: OnAlarmName = "monitor"
        if self.on_alarm != "monitor":
            meaning.check_stays("this robot", self._names)
            reaction = "hold"
        release_rows = max(1, int(np.ceil(self.release_s / dt)))
        if self.on_alarm == "stop":
            release_rows = sys.maxsize
        options = GuardOptions(reaction, release_rows, contact_limits=None)
        return Guard(robots_of(self._names, meaning, dt), self.monitor, options)

    def _check_rate(self) -> None:
        """Log that rows come at another rate than the memory reads."""
        try:
            self._pace.rows_lost_before(time.monotonic())
        except ClockWentBack as error:
            self._pace = Pace(self._spec.dt)
            _log.warning("%s", error)
        if self._pace.change:
            _log.warning(self._pace.change)

    def _chosen(self, guard: Guard, action: Mapping[str, Any]) -> dict[str, float]:
        """Return the action that the guard chooses, the policy's or a hold; some may be NaN."""
        executed = guard.act(self._numbers(action), lambda _: None).actions[0]
        chosen = dict(zip(self._names, executed.tolist(), strict=True))
        if not guard.overriding[0]:
            self._unloaded.clear()
        return chosen | self._unloaded

    def _numbers(self, action: Mapping[str, Any]) -> Floats32:
        """Return (1, A) the numbers of an action; NaN where one is missing."""
        return np.array([[number_of(action, name) for name in self._names]], np.float32)

    def _description(
        self, report: RowReport, row: Floats32, shares: NDArray[np.float64], step: LoopStep
    ) -> dict[str, Any]:
        """Return what there is to say of an alarm in a row (D,), by the shares (D,) of its numbers."""
        robot = report.robots[0]
        failure = report.failures.get(0, "")
        cause = reason(row)
        if failure:
            cause = FAILURE
        if robot["out_of_range"] or failure.startswith("range"):
            cause = OUT_OF_RANGE
        response = self.on_alarm
        channel = ""
        motor = ""
        column = blamed(row, shares)
        if column is not None:
            channel = self._spec.labels[column]
            motor = self._columns[column].motor
        servo = servo_of(motor)
        fault = self._history.fault_of(motor, step.observation)
        if failure.startswith(STALL):
            cause = STALL
            servo = self._history.overloaded(step.observation)
            fault = STALLED
            channel = f"{SENSED}[{servo}{CURRENT}]"
        if cause == STALL and response != "monitor":
            response = UNLOAD
        return {
            "surprise": float(robot["surprise"] / robot["threshold"]),
            "reason": cause,
            "channel": channel,
            "servo": servo,
            "fault": fault,
            "response": response,
        }

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
