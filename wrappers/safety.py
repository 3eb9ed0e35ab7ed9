"""Guard a policy: watch every step, and take over or stop when sensor readings differ from the prediction."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Literal, SupportsFloat

import gymnasium as gym
import numpy as np
from gymnasium.utils import RecordConstructorArgs
from numpy.typing import NDArray

from asm_gym.data.action_meaning import ActionMeans
from asm_gym.detection import AdaptiveThreshold
from asm_gym.detection.contact_limits import ContactLimits
from asm_gym.guard.arbiter import ENDED
from asm_gym.guard.options import GuardOptions, OnAlarm
from asm_gym.guard.preview import Preview, checked_chunk
from asm_gym.guard.report import LazyInfo, RowReport, report
from asm_gym.monitors import Monitor
from asm_gym.policies.hold import HoldsItself, why_changed
from asm_gym.stream_source import StreamSource, stepped
from asm_gym.validation import as_float32, short_repr
from asm_gym.wrappers.guarding import Guarding, as_action, body_memory, felt_by, sensed_row


class NeuralASMSafety(Guarding, gym.Wrapper[Any, Any, Any, Any], RecordConstructorArgs):
    """Guard an environment with a Box action space under any policy; other environments can be watched.

    From the step after an alarm, a reflex acts in place of the policy, until surprise has stayed under 80 % of the
    threshold for ``release_after`` steps. A failure is an alarm too: a monitor that raises or returns nonsense, a
    missing stream, an action of the policy that is not finite (it is not executed). A hold replaces a failing reflex.

    In environments of this package the arm holds from the physics substep that passes ``contact_limits``, which is an
    alarm whatever the surprise. Under ``"graded"``, severity and cause choose the response, and an estimate replaces a
    faulty sensor in observation and stream.

    ``info["asm"]`` describes the step; ``asm_gym.guard.report.report`` lists its fields. Flat NumPy scalars are beside
    it: ``asm_surprise``, ``asm_alarm``, ``asm_intervened``, ``cost`` (1.0 in every step in alarm), ``cost_sum`` (of the
    episode), and ``overridden`` (the policy's action was not executed: a recurrent policy keeps its previous state).

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

    def __init__(
        self,
        env: gym.Env[Any, Any],
        monitor: Monitor | None = None,
        on_alarm: OnAlarm | None = None,
        *,
        release_after: int = 10,
        max_override: int | None = None,
        try_after: int | None = None,
        truncate: bool = False,
        adaptive_threshold: AdaptiveThreshold | None = None,
        responses: Mapping[str, str] | None = None,
        contact_limits: ContactLimits | Literal["memory"] | None = "memory",
        action_means: ActionMeans | None = None,
    ) -> None:
        self._options = GuardOptions(
            on_alarm=on_alarm,
            release_after=release_after,
            max_override=max_override,
            try_after=try_after,
            truncate=truncate,
            adaptive_threshold=adaptive_threshold,
            responses=responses,
            contact_limits=contact_limits,
            action_means=action_means,
        )
        recorded = {"monitor": monitor, **vars(self._options)}
        RecordConstructorArgs.__init__(self, _disable_deepcopy=True, **recorded)  # reflexes and memories are large
        gym.Wrapper.__init__(self, env)
        self._box = env.action_space if isinstance(env.action_space, gym.spaces.Box) else None
        if self._box is None and not (isinstance(on_alarm, str) and on_alarm in ("monitor", "terminate")):
            needs = f"on_alarm={short_repr(on_alarm)} needs a Box action space to act in, got {env.action_space}"
            raise TypeError(f'{needs}: others can only be watched, on_alarm="monitor", or ended, "terminate"')
        self._source = StreamSource(env)
        self._spec = self._source.spec
        self._rows_per_step = self._source.rows_per_step
        changed = why_changed(env, "a reflex within a step")
        if self._rows_per_step > 1 and changed:
            raise ValueError(changed)
        self._watch_with(body_memory(env, self._spec) if monitor is None else monitor)
        self._inner: Any = env.unwrapped
        self._holds = isinstance(self._inner, HoldsItself)
        self._ended = True

    @property
    def threshold(self) -> float:
        """Surprise above which a row is an alarm in this episode."""
        return float(self._engine.threshold[0])

    def confirm_alarm(self) -> None:
        """Confirm that the alarms of this episode were real, for ``adaptive_threshold``."""
        self._engine.confirmed[:] = True

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        self._ended = True  # until it has worked
        observation, info = self.env.reset(seed=seed, options=options)
        info = dict(info)
        self._watch_with_next()
        nothing = self._engine.begin()
        self._limit_contact(anew=True)
        self._observation, self._alarms, self._solved = observation, 0, False
        self._row: NDArray[np.float32] | None = None  # (D,) sensed last in this episode
        self._begun, self._preview, self._announced = info, Preview(None), 0
        if self._robots.meaning is not None:
            self._engine.sense(np.array(self._source.first(observation, info))[None])
        self._ended = False
        self._executed = np.zeros(0, np.float32)
        self._report(info, [nothing], None)
        return observation, info

    def preview(self, actions: Any) -> Preview:
        """Return which action of a chunk (k, A) should not be executed and why, before the first is.

        Execute ``kept``, the actions before it (all of them under ``"monitor"``), then ask the policy again. Meanwhile
        ``info["asm"]["preview"]`` counts down to that action. Raises ValueError for a chunk of another shape.
        """
        if self._ended or self._box is None:
            raise gym.error.ResetNeeded("preview() needs a running episode and a Box action space")
        chunk = checked_chunk(actions, self._box.shape)
        row = self._source.first(self._observation, self._begun) if self._row is None else self._row
        last = self._executed.ravel() if self._executed.size else self._robots.rest
        found = self._engine.preview(0, chunk.reshape(len(chunk), -1), row, last)
        self._preview, self._announced = found._replace(kept=chunk[: len(found.kept)]), len(chunk)
        return self._preview

    def step(self, action: Any) -> tuple[Any, SupportsFloat, bool, bool, dict[str, Any]]:
        if self._ended:
            raise gym.error.ResetNeeded("call reset() before step(): no episode is running")
        if self._box is not None:
            action = np.array(as_float32(action, "an action"))  # a policy may use its buffer again
            if action.shape != self._box.shape:
                raise ValueError(f"an action has the shape {self._box.shape}, got {action.shape}")
        self._ended = True  # where anything raises, nobody knows what was done
        self._executed = action
        self._rows: list[RowReport] = []
        overridden, (observation, reward, terminated, truncated, info) = self._run()
        info = dict(info)  # an environment may use its own again
        if "success" in info:
            self._solved |= bool(info["success"])
            info.setdefault("is_success", self._solved)
        row, failure = sensed_row(lambda: self._source.row(observation, self._executed, info), self._spec.size)
        done = self._executed
        if self._box is not None:
            done = self._robots.executed_in(row[None], done.reshape(1, -1))[0].reshape(done.shape)
        self._row = row
        self._judge(row, failure, info)
        self._limit_contact()
        if repaired := self._engine.repaired:
            row, missing = repaired[0]
            if self._observation_map is not None:
                observation = self._observation_map.repaired(observation, row, missing)
            if "stream" in info:
                info["stream"] = row.copy()
        self._observation = observation
        info["overridden"] = overridden or bool(info.get("overridden"))
        self._report(info, self._rows, done)
        gave_up = self._rows[-1].state[0] == ENDED
        if gave_up or (self._engine.ends_on_alarm and any(row.ends[0] for row in self._rows)):
            terminated, truncated = terminated or not self._options.truncate, truncated or self._options.truncate
        self._ended = bool(terminated or truncated)
        return observation, reward, terminated, truncated, info

    def _command(self, action: NDArray[np.float32]) -> bool:
        """Choose the next action: the policy's ``action`` (A,), or another."""
        command = self._engine.act(action.reshape(1, -1), lambda _: self._observation)
        self._executed = command.actions[0].reshape(action.shape)
        if command.brakes[0]:
            self._inner.holding = True
        return bool(command.overridden[0])

    def _run(self) -> tuple[bool, tuple[Any, SupportsFloat, bool, bool, dict[str, Any]]]:
        """Command and step the environment; return whether the policy was overridden, and the result of the step.

        Rows within the step are judged meanwhile, and a hold lasts through all its parts; one that a guard outside has
        asked for goes on.
        """
        hooks: Any = self.env.get_wrapper_attr("row_hooks") if self._rows_per_step > 1 else None
        if hooks is not None:
            hooks.append(self._judge)
        inner = self._inner
        kept = self._holds and inner.keeps_holding
        held = kept and inner.holding
        try:
            if self._holds:
                inner.keeps_holding = True
            overridden = self._box is not None and self._command(self._executed)
            return overridden, stepped(self.env, as_action(self._box, self._executed))
        finally:
            if self._holds:
                inner.keeps_holding, inner.holding = kept, held
            if hooks is not None:
                hooks.remove(self._judge)

    def _judge(self, row: NDArray[np.float32], failure: str = "", info: dict[str, Any] | None = None) -> None:
        """Judge one row, with the ``info`` of the step that it completes; in mid-step a reflex acts at once."""
        executed = np.zeros((1, 0), np.float32) if self._box is None else self._executed.reshape(1, -1)
        felt = None if info is None else felt_by(self._robots, info)
        acts = bool(self._engine.overriding[0])
        failures = {0: failure} if failure else None
        judged = self._engine.judge(np.array(row)[None], executed, felt, failures, ends_step=info is not None)
        self._rows.append(judged)
        if info is None and self._engine.overriding[0] and not (acts or judged.intervened[0]):
            self._command(self._executed)
            self._limit_contact()
            self.env.get_wrapper_attr("command")(self._executed)

    def _report(self, info: dict[str, Any], rows: Sequence[RowReport], executed: Any) -> None:
        """Write the report of a step to ``info``."""
        surprise = max([float(row.surprise.value[0]) for row in rows])
        alarm = True in [bool(row.alarm[0]) for row in rows] or bool(info.get("asm_alarm"))  # of a guard inside
        intervened = True in [bool(row.intervened[0]) for row in rows] or bool(info.get("asm_intervened"))
        self._alarms += alarm
        robots, asked, ahead = self._robots, self._executed, None
        if self._announced > 0:
            at = None if self._preview.at is None else self._preview.at - 1
            self._announced = 0 if at == -1 else self._announced - 1
            self._preview = self._preview._replace(at=at)
            ahead = {"at": at, "reason": self._preview.reason, "known": self._preview.known}
            ahead = ahead if self._announced else None
        more: dict[str, float] = {"alarms": self._alarms}
        if (running := self._engine.running) is not None:
            more = more | {"ceiling": running.ceiling, "level": running.level}

        def told() -> dict[str, Any]:
            slowed = 0.0 if executed is None or self._box is None else robots.slowed(asked, executed)
            return report(rows, 0, self._spec, executed) | more | {"slowed": slowed, "preview": ahead}

        info["asm"] = LazyInfo(told)
        info["asm_surprise"], info["asm_alarm"], info["cost"] = np.float64(surprise), np.bool_(alarm), np.float64(alarm)
        info["asm_intervened"] = np.bool_(intervened)
        info["cost_sum"] = np.float64(self._alarms)
