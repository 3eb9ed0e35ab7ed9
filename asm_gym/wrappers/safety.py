"""Guard a policy: watch every step, and take over or stop when sensor readings differ from the prediction."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.utils import RecordConstructorArgs

from asm_gym.control_period import stream_provider
from asm_gym.exceptions import UnsupportedEnvironment
from asm_gym.guard.action_path import passed_on
from asm_gym.guard.adapter import SensedRows
from asm_gym.guard.chunk_preview import Preview, checked_chunk, one_row_each
from asm_gym.guard.commander import Command
from asm_gym.guard.robot_table import Floats32
from asm_gym.guard.step_info import AsmInfo, LazyInfo, RowReport, asm_info
from asm_gym.monitors import Monitor
from asm_gym.policies.hold import HoldsItself, why_changed
from asm_gym.stream_source import StepResult, StreamSource
from asm_gym.validation import as_float32, short_repr
from asm_gym.wrappers.guarding import (
    Guarding,
    as_action,
    load_felt,
    nothing_felt,
    sensed_row,
)


class NeuralASMSafety(Guarding, gym.Wrapper[Any, Any, Any, Any], RecordConstructorArgs):
    """Guard an environment with a Box action space under any policy; other environments can be watched.

    From the step after an alarm, a reflex acts in place of the policy, until surprise has stayed under 80 % of the
    threshold for ``release_after`` steps. A failure is an alarm too: a monitor that raises or returns nonsense, a
    missing stream, an action of the policy that is not finite (it is not executed). A hold replaces a failing reflex.

    In environments of this package the arm holds from the physics substep that passes ``contact_limits``, which is an
    alarm whatever the surprise. Under ``"graded"``, severity and cause choose the response, and an estimate replaces a
    faulty sensor in observation and stream.

    ``info["asm"]`` describes the step; ``asm_gym.guard.step_info.AsmInfo`` lists its fields. Beside it are flat NumPy
    scalars: ``asm_surprise``, ``asm_alarm``, ``asm_intervened``, ``cost`` (1.0 in every step in alarm), ``cost_sum``
    (of the episode), ``asm_steps`` (done in the episode), and ``overridden`` (the policy's action was not executed: a
    recurrent policy keeps its previous state).

    Guards may be nested: the strictest contact limits and speeds apply, and cost and alarm combine all guards, while
    ``info["asm"]`` describes the outermost.

    Args:
        env: any Gymnasium environment. Without ``info["stream"]``, observation and action form the stream. Without a
            Box action space, ``on_alarm`` must be ``"monitor"`` or ``"terminate"``.
        monitor: a fitted and calibrated monitor; by default the shipped memory of the robot in ``env``.
        on_alarm: ``"monitor"`` only reports; ``"hold"`` stays and keeps the grip; ``"retract"`` goes back along the
            path; ``"comply"`` yields to external forces; ``"recall"`` moves as predicted; ``"graded"`` chooses
            by severity and cause (``responses``), returns control on trial, and ends the episode if trials fail or the
            policy presses too often; ``"terminate"`` ends the episode; any other policy acts itself. A class, or a
            function that makes a policy for an environment, is called with this one. By default ``"graded"`` with a
            monitor that names causes, and ``"hold"`` with any other.
        release_after: control steps of low surprise after which control returns to the policy.
        max_override: control steps for which a reflex may act; then the episode ends. An alarm within
            ``release_after`` steps afterwards continues the count. None for no limit, 3 s with ``"graded"``.
        try_after: control steps of override after which the policy acts on trial; each failed trial doubles them. None
            for no trials, 0.5 s with ``"graded"``.
        truncate: an alarm that ends an episode truncates it instead of terminating it.
        adaptive_threshold: how the threshold follows a changing policy, from episode to episode; ``info["asm"]`` then
            has ``ceiling`` and ``level`` too. Alarms above the ceiling, alarms that continued while the reflex acted,
            and episodes with ``confirm_alarm`` do not count as false. None for a fixed threshold.
        responses: under ``"graded"``, responses by cause that replace those of ``asm_gym.guard.responses.DEFAULT``:
            ``{"contact": "comply"}``. None of them may let a pressing arm go on.
        contact_limits: limits of contact force and of the hand's speed. ``"memory"`` for the defaults, raised where
            the monitor's calibration episodes exceed them. None for no limits; ``"graded"`` then holds at every alarm
            except that of a sensor.
        action_means: for an environment that cannot hold by itself, ``"delta"``, ``"target"``, ``"velocity"`` or
            ``"torque"``, or one for each number of an action. A target arm is held by its present position as target,
            others by zero. By default the attribute ``action_means`` of the environment, or else what the
            monitor found in its training episodes.

    Raises:
        ValueError: an unknown ``on_alarm``, cause or response; a response that lets a pressing arm go on; a reflex
            made for another environment; a monitor of another robot, controller, stream or rate (the message names
            both); no shipped memory fits (the message lists them); a hold although actions are torques or of unknown
            meaning; ``"recall"`` with a monitor that predicts no action; a wrapper inside that changes
            actions, so that a reflex cannot know what reaches the robot.
        RuntimeError: the monitor is not calibrated.

    Example:
        >>> import gymnasium as gym
        >>> from asm_gym import NeuralASMSafety
        >>> env = NeuralASMSafety(gym.make("asm_gym/Lift-v0"))  # the shipped memory of the Panda
        >>> observation, info = env.reset(seed=0)
        >>> *_, info = env.step(env.action_space.sample())
        >>> info["asm"]["state"], bool(info["cost_sum"] >= info["cost"])
        ('policy', True)
    """

    def _wrap(self, env: gym.Env[Any, Any], monitor: Monitor | None) -> None:
        recorded = {"monitor": monitor, **vars(self._options)}
        # reflexes and memories are large
        RecordConstructorArgs.__init__(self, _disable_deepcopy=True, **recorded)
        gym.Wrapper.__init__(self, env)
        self._box: gym.spaces.Box | None = None  # of actions; None where a guard cannot act in it
        if isinstance(env.action_space, gym.spaces.Box):
            self._box = env.action_space
        on_alarm = self._options.on_alarm
        if self._box is None and not (
            isinstance(on_alarm, str) and on_alarm in ("monitor", "terminate")
        ):
            needs = (
                f"on_alarm={short_repr(on_alarm)} needs a Box action space to act in, "
                f"got {env.action_space}"
            )
            raise TypeError(
                f'{needs}: others can only be watched, on_alarm="monitor", or ended, "terminate"'
            )

        self._source = StreamSource(env)
        self._spec = self._source.spec
        self._period = self._source.period
        self._rows_per_step = self._source.rows_per_step
        changed = why_changed(env, "a reflex within a step")
        if self._rows_per_step > 1 and changed:
            raise UnsupportedEnvironment(changed)
        self._watch_with(monitor)
        self._inner: Any = env.unwrapped
        self._holds_itself = isinstance(self._inner, HoldsItself)
        self._ended = True

    @property
    def threshold(self) -> float:
        """Surprise above which a row is an alarm in this episode."""
        return float(self.guard.threshold[0])

    @property
    def newest_row(self) -> Floats32 | None:
        """(D,) the row that was sensed last in this episode, as the monitor reads it; None before the first step."""
        return self._row

    @property
    def control_period(self) -> float:
        """Time that a step takes [s]."""
        return self._period

    @property
    def guarded_action_space(self) -> gym.Space[Any]:
        """The actions that this guard takes, whatever wrappers outside make of them."""
        return self.action_space

    def confirm_alarm(self) -> None:
        """Confirm that the alarms of this episode were real, for ``adaptive_threshold``."""
        self.guard.confirm(np.ones(1, bool))

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        self._ended = True  # until it has worked
        observation, info = self.env.reset(seed=seed, options=options)
        info = dict(info)
        self._take_over_changed_monitor()
        report = self.guard.begin()
        self._limit_contact(anew=True)
        self._observation = observation
        self._first_info = info
        self._row: Floats32 | None = None  # (D,) sensed last in this episode
        self._steps = np.zeros(1, np.int64)
        self._alarms = np.zeros(1, np.int64)
        self._solved = False
        self._preview = Preview(at=None)
        self._previewed_actions = 0  # of the previewed chunk, not executed yet
        if self._facts.meaning is not None:
            self.guard.sense(self._view.rows(np.array(self._source.first(observation, info))[None]))
        self._ended = False
        self._executed = np.zeros(0, np.float32)
        info["overridden"] = bool(info.get("overridden"))
        if getattr(self.env.unwrapped, "contact_limits", None) is not None:
            info |= nothing_felt(self._facts.felt_size)
        if "success" in info:
            info.setdefault("is_success", bool(info["success"]))
        self.report_step([report], info)
        return observation, info

    def preview(self, actions: Any, env: gym.Env[Any, Any] | None = None) -> Preview:
        """Return which action of a chunk (k, A) should not be executed and why, before the first is.

        Execute ``kept``, the actions before it (all of them under ``"monitor"``), then ask the policy again. Meanwhile
        ``info["asm"]["preview"]`` counts down to that action. Actions are judged as they reach the robot, through
        ClipAction, RescaleAction and any other TransformAction.

        Args:
            actions: (k, A) the chunk.
            env: the outermost environment, where wrappers outside of this guard change actions: the chunk is of
                its actions. By default it is of the guard's.

        Raises:
            ValueError: a chunk of another shape.
            UnsupportedEnvironment: a wrapper changes actions in an unknown way, or the memory reads actions of
                another size.
        """
        if self._ended or self._box is None:
            raise gym.error.ResetNeeded("preview() needs a running episode and a Box action space")
        outermost = env or self
        chunk = checked_chunk(actions, outermost.action_space.shape or ())
        own_chunk = checked_chunk(passed_on(chunk, outermost, self), self._box.shape)
        row = self._row
        if row is None:
            row = self._view.rows(self._source.first(self._observation, self._first_info))
        last = self._facts.rest
        if self._executed.size:
            last = self._executed
        preview = self.guard.preview(0, own_chunk, row, last, self._as_streamed)
        self._preview = preview._replace(kept=chunk[: len(preview.kept)])
        self._previewed_actions = len(chunk)
        return self._preview

    def _as_streamed(self, actions: Floats32) -> Floats32:
        """Return actions (k, *shape) as the stream tells them (k, A), behind the wrappers in this guard."""
        if self._source.own:
            actions = passed_on(actions, self.env, stream_provider(self.env))
        return one_row_each(actions)

    def step(self, action: Any) -> StepResult:
        if self._ended:
            raise gym.error.ResetNeeded("call reset() before step(): no episode is running")
        self._executed = self._checked(action)
        self._ended = True  # where anything raises, nobody knows what was done
        self._reports: list[RowReport] = []
        overridden, (observation, reward, terminated, truncated, info) = self._run()
        self._check_period(self._source.period)
        info = dict(info)  # an environment may use its own again
        if "success" in info:
            self._solved |= bool(info["success"])
            info.setdefault("is_success", self._solved)

        sensed = self.sense_rows((observation, info))
        self._row = sensed.rows[0]
        self._reports.append(self.guard.judge(sensed, self._executed_row()))
        self._limit_contact()
        self._observation = self._repaired(observation, info)
        info["overridden"] = overridden or bool(info.get("overridden"))
        self._steps += 1
        self.report_step(self._reports, info)

        if self._stopped(self._reports)[0]:
            terminated = terminated or not self._options.truncate
            truncated = truncated or self._options.truncate
        self._ended = bool(terminated or truncated)
        return self._observation, reward, terminated, truncated, info

    # ------------------------------------------------------------------ the adapter's three methods

    def sense_rows(self, given: tuple[Any, dict[str, Any]]) -> SensedRows:
        """Return the row that was sensed at the end of a step, by its observation and ``info``."""
        observation, info = given
        row, failure = sensed_row(
            lambda: self._source.row(observation, self._executed, info), self._spec.size
        )
        rows = self._view.rows(row[None])
        sensed = SensedRows(rows=rows, load=load_felt(self._facts, info), infos=info)
        if failure:
            return sensed._replace(failures={0: failure})
        return sensed

    def send_command(self, command: Command) -> bool:
        """Take up what is to be done; return whether it is something else than the policy's action."""
        self._executed = command.actions[0].reshape(self._executed.shape)
        if command.brakes[0]:
            self._inner.holding = True
        return bool(command.overridden[0])

    def _write(self, target: dict[str, Any], asm: LazyInfo, numbers: dict[str, Any]) -> None:
        asm["threshold"] = float(asm["threshold"][0])
        target["asm"] = asm
        for name, values in numbers.items():
            target[name] = values[0]

    # ------------------------------------------------------------------ parts of a step

    def _checked(self, action: Any) -> Any:
        """Return a copy of an action, as a policy may use its buffer again. Raises ValueError for another shape."""
        if self._box is None:
            return action
        action = np.array(as_float32(action, "an action"))
        if action.shape != self._box.shape:
            raise ValueError(f"an action has the shape {self._box.shape}, got {action.shape}")
        return action

    def _executed_row(self) -> Floats32:
        """Return (1, A) the action that is executed; (1, 0) where actions are no numbers."""
        if self._box is None:
            return np.zeros((1, 0), np.float32)
        return self._executed.reshape(1, -1)

    def _command(self) -> bool:
        """Choose what is done in place of the action so far; return whether that is something else."""
        if self._box is None:
            return False
        return self.send_command(self.guard.act(self._executed_row(), lambda _: self._observation))

    def _run(self) -> tuple[bool, StepResult]:
        """Command and step the environment; return whether the policy was overridden, and the result of the step.

        Rows within the step are judged meanwhile, and a hold lasts through all its parts; one that a guard outside has
        asked for goes on.
        """
        row_hooks: list[Any] = []  # called by nobody where a step is one row
        if self._rows_per_step > 1:
            row_hooks = self.env.get_wrapper_attr("row_hooks")
        row_hooks.append(self._judge_within_step)
        inner = self._inner
        kept_holding = self._holds_itself and inner.keeps_holding  # a guard outside asked for it
        held = kept_holding and inner.holding
        try:
            if self._holds_itself:
                inner.keeps_holding = True
            overridden = self._command()
            return overridden, self._source.step(as_action(self._box, self._executed))
        finally:
            if self._holds_itself:
                inner.keeps_holding = kept_holding
                inner.holding = held
            row_hooks.remove(self._judge_within_step)

    def _judge_within_step(self, row: Floats32) -> None:
        """Judge a row that the environment senses in the middle of a step; a reflex acts at once."""
        rows = self._view.rows(row[None])
        report = self.guard.judge(SensedRows(rows), self._executed_row(), ends_step=False)
        self._reports.append(report)
        takes_over = self.guard.overriding[0] and not report.robots["overridden"][0]
        if takes_over:
            self._command()
            self._limit_contact()
            self.env.get_wrapper_attr("command")(self._executed)

    def _repaired(self, observation: Any, info: dict[str, Any]) -> Any:
        """Return the observation, and set the stream, with what is completed."""
        repaired = self.guard.repaired
        if not repaired:
            return observation
        row, missing = repaired[0]
        if "stream" in info:
            info["stream"] = self._view.written_back(row, info["stream"])
        if self._observation_map is None:
            return observation
        return self._observation_map.repaired(observation, row, missing)

    def _describe(self, reports: Sequence[RowReport]) -> Callable[[], AsmInfo]:
        facts = self._facts
        spec = self.monitor.spec
        commanded: Any = None  # nothing was done before the first step
        if self._row is not None:
            commanded = self._executed
        rows = self.guard.table.rows
        step = {
            "alarms": int(self._alarms[0]),
            "preview": self._count_down(),
            **self._running_threshold(),
        }

        def describe() -> AsmInfo:
            executed = commanded
            slowed = 0.0
            if commanded is not None and self._box is not None:
                flat = commanded.reshape(1, -1)
                executed = facts.executed_in(rows, flat).reshape(commanded.shape)
                slowed = float(facts.slowed(flat, executed.reshape(1, -1))[0])
            return asm_info(reports, 0, spec, executed, slowed=slowed, **step)

        return describe

    def _count_down(self) -> dict[str, Any] | None:
        """Return what ``info`` says of the chunk that was previewed, an action of which is done; None without one."""
        if not self._previewed_actions:
            return None
        actions_before = self._preview.at  # the action that should not be executed
        if actions_before is not None:
            actions_before -= 1
        self._preview = self._preview._replace(at=actions_before)

        self._previewed_actions -= 1
        was_executed = actions_before == -1  # that action: the prediction holds no longer
        if was_executed:
            self._previewed_actions = 0
        if not self._previewed_actions:
            return None
        return {"at": actions_before, "reason": self._preview.reason, "known": self._preview.known}
