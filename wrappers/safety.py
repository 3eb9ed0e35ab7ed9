"""Guard a policy: watch every step, and take over or stop when the robot senses what the memory does not expect."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Literal, SupportsFloat

import gymnasium as gym
import numpy as np
from gymnasium.utils import RecordConstructorArgs
from gymnasium.wrappers import RecordEpisodeStatistics
from numpy.typing import NDArray

from asm_gym.data.action_meaning import ActionMeans
from asm_gym.detection import AdaptiveThreshold
from asm_gym.detection.contact_limits import ContactLimits
from asm_gym.guard.arbiter import ENDED
from asm_gym.guard.options import GuardOptions, OnAlarm
from asm_gym.guard.preview import Foretold, checked_chunk
from asm_gym.guard.report import LazyInfo, RowReport, report
from asm_gym.monitors import Monitor
from asm_gym.policies.reflexes import HoldsItself, changed_by, outside
from asm_gym.stream_source import StreamSource, stepped
from asm_gym.validation import as_float32, short_repr
from asm_gym.wrappers.robots import Guarding, body_memory, felt_by, sensed_row

COUNTS = "stable_baselines3.common.monitor"  # module of a wrapper that counts episodes


class NeuralASMSafety(Guarding, gym.Wrapper[Any, Any, Any, Any], RecordConstructorArgs):
    """Guard an environment with a Box action space under any policy; other environments can be watched.

    From the step after an alarm on, a reflex acts in the policy's place, until surprise has stayed under
    80 % of the threshold for ``release_after`` steps. A failure is an alarm too: a monitor that raises or
    returns nonsense, a stream that is missing, an action of the policy that is not finite (it is not executed). A
    reflex that fails is replaced by a hold.

    In environments of this package contact force comes first: from the physics substep that passes ``contact_limits``
    on the arm holds, which is an alarm whatever the surprise. Under ``"graded"`` severity and cause decide what is
    done, and a sensor at fault is completed in observation and stream.

    ``info["asm"]`` describes a step: see ``asm_gym.guard.report.report``. Beside it stand, as NumPy scalars,
    ``info["asm_surprise"]``, ``info["asm_alarm"]``, ``info["asm_intervened"]``, ``info["cost"]`` (1.0 on every step
    with an alarm) and ``info["cost_sum"]`` (of the episode so far). ``info["overridden"]`` is True after a step that
    began with another action than the policy's: a policy with a state then resumes from its state before.

    Guards may stand around one another: of their contact limits and speeds the strictest count, and cost and alarm are
    those of all; ``info["asm"]`` is the outermost's.

    Args:
        env: any Gymnasium environment; where ``info`` has no ``"stream"``, observation and action are the stream.
            Without a Box action space ``on_alarm`` must be ``"monitor"`` or ``"terminate"``.
        monitor: a fitted and calibrated monitor; where None, the shipped memory of the robot in ``env``.
        on_alarm: ``"monitor"`` only reports; ``"hold"`` stays and keeps the grip; ``"retract"`` goes back along the
            path; ``"comply"`` gives way; ``"recall"`` goes on as the memory expects; ``"graded"`` does what severity
            and cause ask for (``responses``), hands back on trial, and ends the episode where trials fail or the policy
            presses too often; ``"terminate"`` ends the episode; any other policy acts itself. A class, or a function
            that makes a policy for an environment, is given this one. None for ``"graded"`` with a monitor that names
            causes, and for ``"hold"`` with any other.
        release_after: control steps of low surprise after which control is handed back.
        max_override: control steps for which a reflex may act, after which the episode ends; an alarm within
            ``release_after`` steps of handing back continues the count. None for no limit, with ``"graded"`` for 3 s.
        try_after: control steps of override after which control is handed back on trial; after each trial that fails,
            twice as many. None for no trials, with ``"graded"`` for 0.5 s.
        truncate: an episode that is ended by an alarm is truncated rather than terminated.
        adaptive_threshold: how the threshold follows a policy that changes, from episode to episode; ``info["asm"]``
            then holds ``ceiling`` and ``level`` too. Alarms above the ceiling, alarms that went on while the reflex
            acted, and episodes with ``confirm_alarm`` do not count as false. None for a threshold that stays.
        responses: under ``"graded"``, responses by cause that replace those of ``asm_gym.guard.responses.DEFAULT``:
            ``{"contact": "comply"}``. None may let a pressing arm go on.
        contact_limits: what an arm may feel and how fast its hand may go. ``"memory"`` for the defaults, raised where
            the monitor's calibration episodes exceed them. None for none; ``"graded"`` then holds at every alarm but a
            sensor's.
        action_means: ``"delta"``, ``"target"``, ``"velocity"`` or ``"torque"``, or one for each number of an action,
            where an environment cannot hold by itself: a target arm is held by the target at which it is, others by
            zero. None for what its attribute ``action_means`` says, or else the episodes that the monitor was
            fitted on.

    Raises:
        ValueError: an unknown ``on_alarm``, cause or response; a response that lets a pressing arm go on; a reflex
            made for another environment; a monitor of another robot, controller, stream or rate (both are named);
            no shipped memory that fits (the message lists them); a hold where nothing tells what
            actions mean, or where they are torques; ``"recall"`` with a monitor that expects no action; a
            wrapper inside that changes actions, where a reflex cannot know what reaches the robot.
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
        if not (isinstance(on_alarm, str) and on_alarm == "monitor"):
            _check_counts(env)
        self._source = StreamSource(env)
        self._spec = self._source.spec
        self._rows_per_step = self._source.rows_per_step
        if self._rows_per_step > 1 and (wrapper := changed_by(env)) is not None:
            raise ValueError(outside(wrapper, "a reflex within a step"))
        self._watch_with(body_memory(env, self._spec) if monitor is None else monitor)
        self._inner: Any = env.unwrapped
        self._holds = isinstance(self._inner, HoldsItself)
        self._ended = True

    @property
    def threshold(self) -> float:
        """What surprise must exceed for an alarm in this episode."""
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
        self._begun, self._foretold, self._announced = info, Foretold(None), 0
        if self._robots.meaning is not None:
            self._engine.sense(np.array(self._source.first(observation, info))[None])
        self._ended = False
        self._executed = np.zeros(0, np.float32)
        self._report(info, [nothing], None)
        return observation, info

    def preview(self, actions: Any) -> Foretold:
        """Say of a chunk of actions (k, A), before the first is done, which should not be, and why.

        ``kept`` are those before it, all of them under ``"monitor"``: do these, and ask the policy anew. Until it
        is done ``info["asm"]["preview"]`` counts down to that action. A chunk of another shape is a ValueError.
        """
        if self._ended or self._box is None:
            raise gym.error.ResetNeeded("preview() needs an episode that runs, and a Box action space")
        chunk = checked_chunk(actions, self._box.shape)
        row = self._source.first(self._observation, self._begun) if self._row is None else self._row
        last = self._executed.ravel() if self._executed.size else self._robots.rest
        found = self._engine.preview(0, chunk.reshape(len(chunk), -1), row, last)
        self._foretold, self._announced = found._replace(kept=chunk[: len(found.kept)]), len(chunk)
        return self._foretold

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
            observation = observation if self._places is None else self._places.repaired(observation, row, missing)
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
        """Choose what is to be done next: the policy's ``action`` (A,), or something else."""
        command = self._engine.act(action.reshape(1, -1), lambda _: self._observation)
        self._executed = command.actions[0].reshape(action.shape)
        if command.brakes[0]:
            self._inner.holding = True
        return bool(command.overridden[0])

    def _run(self) -> tuple[bool, tuple[Any, SupportsFloat, bool, bool, dict[str, Any]]]:
        """Command and step the environment; return whether the policy was overridden, and what came of it.

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
            return overridden, stepped(self.env, self._executed)
        finally:
            if self._holds:
                inner.keeps_holding, inner.holding = kept, held
            if hooks is not None:
                hooks.remove(self._judge)

    def _judge(self, row: NDArray[np.float32], failure: str = "", info: dict[str, Any] | None = None) -> None:
        """Judge one row, with ``info`` of the step that it ends; in mid-step a reflex takes over at once."""
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
        """Say in ``info`` what became of a step."""
        surprise = max([float(row.surprise.value[0]) for row in rows])
        alarm = True in [bool(row.alarm[0]) for row in rows] or bool(info.get("asm_alarm"))  # of a guard inside
        intervened = True in [bool(row.intervened[0]) for row in rows] or bool(info.get("asm_intervened"))
        self._alarms += alarm
        robots, asked, ahead = self._robots, self._executed, None
        if self._announced > 0:
            at = None if self._foretold.at is None else self._foretold.at - 1
            self._announced = 0 if at == -1 else self._announced - 1
            self._foretold = self._foretold._replace(at=at)
            ahead = {"at": at, "reason": self._foretold.reason, "known": self._foretold.known}
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


def _check_counts(env: gym.Env[Any, Any]) -> None:
    """Raise ValueError where a wrapper inside counts episodes, and would not see those that the guard ends."""
    while isinstance(env, gym.Wrapper):
        own = any(kind.__module__ == COUNTS for kind in type(env).__mro__)
        if own or isinstance(env, RecordEpisodeStatistics):
            name = type(env).__name__
            usual = (
                "; with Stable-Baselines3, make_vec_env(lambda: NeuralASMSafety(gym.make(ID), monitor))" if own else ""
            )
            raise ValueError(
                f"{name} counts episodes inside, and would not see those that the guard ends: put it outside, as in "
                f"{name}(NeuralASMSafety(env, monitor)){usual}"
            )
        env = env.env
