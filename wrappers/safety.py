"""Watches a policy's every step, and takes over or stops when what the robot feels is not what it expected."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Literal, Protocol, SupportsFloat, runtime_checkable

import gymnasium as gym
import numpy as np
from gymnasium.utils import RecordConstructorArgs
from numpy.typing import NDArray

from asm_gym.detection import AdaptiveThreshold
from asm_gym.detection.contact_limits import ContactLimits
from asm_gym.guard.arbiter import ENDED
from asm_gym.guard.checks import LOG, Fitted, check_answer, check_monitor, diagnosis_of
from asm_gym.guard.engine import Engine
from asm_gym.guard.motion import Command
from asm_gym.guard.options import GuardOptions, OnAlarm
from asm_gym.guard.report import INFO, LazyInfo, RowReport, report
from asm_gym.monitors import Monitor
from asm_gym.policies.base import Policy
from asm_gym.policies.reflexes import Hold, HoldsItself
from asm_gym.spec import StreamSpec, control_period
from asm_gym.stream_source import StreamSource
from asm_gym.validation import as_float32, check_choice, check_number, short_repr
from asm_gym.wrappers.robots import body_memory, felt_by, robots_of


@runtime_checkable
class SensesWithinSteps(Protocol):
    """An environment whose stream can run faster than control, and whose action can be replaced within a step."""

    row_hooks: list[Any]
    stream_freq: int

    def stream_spec_at(self, rate: int) -> StreamSpec: ...

    def command(self, action: NDArray[np.float32]) -> None: ...


class NeuralASMSafety(gym.Wrapper[Any, Any, Any, Any], RecordConstructorArgs):
    """A safety layer around any environment with a Box action space, under any policy; others can be watched.

    After each step the monitor compares what was sensed with what it expected. From the step after an alarm on, a
    reflex acts in the policy's place, until surprise has stayed under ``release_below`` of the threshold for
    ``release_after`` steps; what has alarmed is not counted again, so that a nudge costs a pause and not the task. With
    ``monitor_freq`` it watches within control steps too, and the reflex takes over at the next physics substep.

    What fails is an alarm too, with the reflex in charge: a monitor that raises or returns nonsense, a stream that is
    missing, a policy whose action is not finite, which is not done. A reflex that fails is replaced by staying; its
    actions are clipped to the box. Where an exception leaves ``reset`` or ``step``, the episode has ended.

    What presses decides, not what it is called: in environments of this package the arm stays from the physics substep
    on in which it felt more than ``contact_limits``, and its hand goes no faster than they say; that is an alarm,
    whatever the surprise. What is wrong is named at every alarm, by monitors that can: ``info["asm"]["cause"]``. Under
    ``"graded"`` severity and cause decide what is done, and from the step after an alarm about a sensor on observation
    and stream hold what that sensor should say, completed from all others, until it has been well for a second. A
    number that is not finite is an alarm; under ``"graded"`` it is completed, and surprise goes on from what is left.

    ``info["asm"]`` says what came of a step: see ``asm_gym.guard.report.report``. For loggers the same stands
    beside it as NumPy scalars: ``info["asm_surprise"]``, ``info["asm_alarm"]``, ``info["asm_intervened"]``, and
    ``info["cost"]``, which is 1.0 on every step with an alarm and 0.0 otherwise, as safe-RL libraries expect.
    ``info["overridden"]`` is True after a step that began with another than the policy in charge: a policy with a state
    then resumes where it was left, if it is given the state from before, as ``asm_gym.policies.rollout`` does.

    Args:
        env: any Gymnasium environment; where ``info`` has no ``"stream"``, observation and action are the stream. No
            reflex can act where actions are not a Box: ``on_alarm`` must be ``"monitor"`` or ``"terminate"`` there. A
            wrapper inside that makes several steps of one is held in all of them; one outside sees ``info`` of the last
            alone, and ``info["asm"]["alarms"]`` and ``info["cost_sum"]`` count those that it skips.
        monitor: a fitted and calibrated monitor; where None, the shipped memory of the body that ``env`` moves.
        on_alarm: ``"monitor"`` only reports; ``"hold"`` stays and keeps the grip, in environments of this package under
            every controller and wrapper; ``"retract"`` goes back along the path; ``"comply"`` gives way;
            ``"recall"`` goes on as the memory expects; ``"graded"`` does what severity and cause ask for
            (``responses``), hands back on trial, and ends the episode where trials fail, or the policy presses too
            often; ``"terminate"`` ends the episode; any other policy acts itself, and where it raises, or returns what
            is no finite action, the robot holds. A class, or a function that makes a policy for an environment, is
            given this one. None for
            ``"graded"`` with a monitor that names causes, and for ``"hold"`` with any other.
        release_after: control steps of quiet after which control is handed back.
        release_below: share of the threshold, in (0, 1], that surprise must be under to count as quiet.
        max_override: control steps for which a reflex may act, after which the episode ends; an alarm that is back
            within ``release_after`` steps of handing back has not gone, and the count goes on. None for as many as it
            takes, with ``"graded"`` for 3 s.
        try_after: control steps of override after which control is handed back on trial, though surprise is not quiet;
            after each trial that fails, twice as many. None for no trials, with ``"graded"`` for 0.5 s.
        truncate: an episode that is ended by an alarm is truncated rather than terminated.
        online_learning_rate: above 0 the monitor goes on learning from steps that do not surprise it, by its
            ``adapt``, which changes it for all who watch with it: for a robot that slowly wears.
        monitor_freq: rows watched a second [Hz], by a monitor fitted at that rate, on environments whose
            ``stream_freq`` can be set; it is set to this. None for the rate that the environment's stream has.
        on_overrun: where the monitor takes longer for a row than a row lasts, ``"warn"`` says so once, ``"alarm"``
            takes it for infinite surprise, and ``"ignore"`` is for simulations, which wait. The first row does not
            count.
        adaptive_threshold: how the threshold follows a policy that changes, from episode to episode; ``info["asm"]``
            then holds the ``threshold`` of this episode, its ``ceiling``, and ``level``, the share of episodes so far
            with a false alarm. Not counted are alarms above the ceiling, those that went on while the reflex acted, and
            those that ``confirm_alarm`` was called for. None for a threshold that stays.
        responses: under ``"graded"``, what is done about which cause, where it is not what
            ``asm_gym.guard.responses.DEFAULT`` says: ``{"contact": "comply"}``. None may let a pressing arm go on.
        contact_limits: what an arm may feel and how fast its hand may go. ``"memory"`` for the usual ones, and more
            where the monitor's calibration episodes have shown that healthy motion here does. None for none: then
            nobody knows what presses, and ``"graded"`` holds at every alarm but a sensor's.
        info: ``"full"``, or ``"flat"`` for the scalars that stand beside ``info["asm"]`` and not that itself. It costs
            little in steps in which nobody reads it, for most of it is put together then.

    Raises:
        ValueError: an unknown ``on_alarm``, cause or response, a response that lets a pressing arm go on, a reflex
            that was made for another environment, a monitor fitted for another stream or rate (the message
            names what differs), no monitor where no shipped memory fits (the message lists them), a rate that does not
            fit, ``"recall"`` with a monitor that expects no action, or a wrapper inside that changes actions, where the
            reflex cannot know what reaches the robot. Nothing is changed then.
        RuntimeError: the monitor is not calibrated.

    Example:
        >>> import gymnasium as gym
        >>> from asm_gym import NeuralASMSafety
        >>> env = NeuralASMSafety(gym.make("asm_gym/Lift-v0"), on_overrun="ignore")  # the shipped memory of the Panda
        >>> observation, info = env.reset(seed=0)
        >>> observation, reward, terminated, truncated, info = env.step(env.action_space.sample())
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
        release_below: float = 0.8,
        max_override: int | None = None,
        try_after: int | None = None,
        truncate: bool = False,
        online_learning_rate: float = 0.0,
        monitor_freq: int | None = None,
        on_overrun: Literal["warn", "alarm", "ignore"] = "warn",
        adaptive_threshold: AdaptiveThreshold | None = None,
        responses: Mapping[str, str] | None = None,
        contact_limits: ContactLimits | Literal["memory"] | None = "memory",
        info: Literal["full", "flat"] = "full",
    ) -> None:
        given: dict[str, Any] = {
            "on_alarm": on_alarm,
            "release_after": release_after,
            "release_below": release_below,
            "max_override": max_override,
            "try_after": try_after,
            "truncate": truncate,
            "online_learning_rate": online_learning_rate,
            "on_overrun": on_overrun,
            "adaptive_threshold": adaptive_threshold,
            "responses": responses,
            "contact_limits": contact_limits,
        }
        RecordConstructorArgs.__init__(
            self,
            _disable_deepcopy=True,  # a reflex holds its environment, and a memory is large
            monitor=monitor,
            monitor_freq=monitor_freq,
            info=info,
            **given,
        )
        gym.Wrapper.__init__(self, env)
        self._box = env.action_space if isinstance(env.action_space, gym.spaces.Box) else None
        if self._box is None and on_alarm not in ("monitor", "terminate"):
            raise TypeError(
                f"on_alarm={short_repr(on_alarm)} needs a Box action space to act in, got {env.action_space}: others "
                'can only be watched, on_alarm="monitor", or ended, "terminate"'
            )
        check_choice("info", info, INFO)
        self._full = info == "full"
        self._options = GuardOptions(**given)
        self._source = StreamSource(env)
        self._spec = self._source.spec
        if monitor_freq is not None:
            sensing = _can_sense(env, monitor_freq)
            self._spec = sensing.stream_spec_at(monitor_freq)
        self._rows_per_step = max(1, round(control_period(env) / self._spec.dt)) if self._source.own else 1
        self._watch_with(body_memory(env, self._spec) if monitor is None else monitor)
        if monitor_freq is not None:
            sensing.stream_freq = monitor_freq  # nothing changes before everything is known to fit
        self._inner: Any = env.unwrapped
        self._holds = isinstance(self._inner, HoldsItself)
        self._ended = True

    @property
    def monitor(self) -> Monitor:
        """What watches. Another that is assigned, or one that was fitted or calibrated since, takes over at the next
        ``reset``. Raises as the constructor does where it does not fit."""
        return self._monitor

    @monitor.setter
    def monitor(self, monitor: Monitor) -> None:
        check_answer(monitor)
        check_monitor(monitor, self._spec)
        self._next = monitor

    def _watch_with(self, monitor: Monitor) -> None:
        """Take up a monitor, and all that depends on it."""
        check_answer(monitor)
        check_monitor(monitor, self._spec)
        chosen = self._options.reaction(diagnosis_of(monitor) is not None)
        policies = () if isinstance(chosen, str) else (made_for(chosen, self.env),)
        robots, self._places = robots_of(self.env, monitor.spec)
        self._engine = Engine(robots, monitor, self._options, policies, self._rows_per_step)
        self._robots, self._monitor = robots, monitor
        self._next, self._taken_up = monitor, Fitted.of(monitor, self._spec)

    @property
    def threshold(self) -> float:
        """What surprise must exceed for an alarm in this episode."""
        return float(self._engine.threshold[0])

    def confirm_alarm(self) -> None:
        """Say that what has alarmed in this episode was real, so that ``adaptive_threshold`` does not take it for a
        false alarm."""
        self._engine.confirmed[:] = True

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        self._ended = True  # until it has worked
        observation, info = self.env.reset(seed=seed, options=options)
        info = dict(info)
        nothing = self._engine.begin()
        if Fitted.of(self._next, self._spec).differs(self._taken_up):
            LOG.info("the monitor was changed, fitted or calibrated since: it is taken over as it is now")
            self._watch_with(self._next)
            nothing = self._engine.begin()
        self._limit_contact(anew=True)
        self._observation, self._alarms, self._failed = observation, 0, ""
        self._ended = False
        self._report(info, [nothing], None)
        return observation, info

    def step(self, action: Any) -> tuple[Any, SupportsFloat, bool, bool, dict[str, Any]]:
        if self._ended:
            raise gym.error.ResetNeeded("call reset() before step(): no episode is running")
        if self._box is not None:
            action = np.array(as_float32(action, "an action"))  # a policy may use its buffer again
            if action.shape != self._box.shape:
                raise ValueError(f"an action has the shape {self._box.shape}, got {action.shape}")
        self._ended = True  # where anything raises, nobody knows what was done
        self._failed, overridden = "", False
        self._executed = action
        if self._box is not None:
            overridden = bool(self._command(action).overridden[0])
        self._rows: list[RowReport] = []
        observation, reward, terminated, truncated, info = self._run()
        info = dict(info)  # an environment may use its own again
        row, failure = self._sensed(observation, info)
        self._judge(row, failure, info)
        self._limit_contact()
        if repaired := self._engine.repaired:
            row, missing = repaired[0]
            observation = observation if self._places is None else self._places.repaired(observation, row, missing)
            if "stream" in info:
                info["stream"] = row.copy()
        self._observation = observation
        info["overridden"] = overridden or bool(info.get("overridden"))
        self._report(info, self._rows, self._executed)
        gave_up = self._rows[-1].state[0] == ENDED
        if gave_up or (self._engine.ends_on_alarm and any(row.ends[0] for row in self._rows)):
            terminated, truncated = terminated or not self._options.truncate, truncated or self._options.truncate
        self._ended = bool(terminated or truncated)
        return observation, reward, terminated, truncated, info

    def _command(self, action: NDArray[np.float32]) -> Command:
        """Choose what is to be done next: the policy's ``action`` (A,), or something else."""
        command = self._engine.act(action.reshape(1, -1), lambda _: self._observation)
        self._executed = command.actions[0].reshape(action.shape)
        self._failed = "; ".join(filter(None, (self._failed, command.failures.get(0, ""))))
        if command.brakes[0]:
            self._inner.holding = True
        return command

    def _run(self) -> tuple[Any, SupportsFloat, bool, bool, dict[str, Any]]:
        """Make a step of the environment. Rows that come before its end are judged meanwhile, and a robot that is held
        is held in all steps that wrappers in between make of one."""
        hooks: Any = self.env.get_wrapper_attr("row_hooks") if self._rows_per_step > 1 else None
        if hooks is not None:
            hooks.append(self._judge)
        if self._holds:
            self._inner.keeps_holding = True
        try:
            return self.env.step(self._executed)
        finally:
            if self._holds:
                self._inner.keeps_holding = self._inner.holding = False
            if hooks is not None:
                hooks.remove(self._judge)

    def _sensed(self, observation: Any, info: dict[str, Any]) -> tuple[NDArray[np.float32], str]:
        """Return the row (D,) that ends a step, or NaN and what failed."""
        try:
            row = as_float32(self._source.row(observation, self._executed, info))
            if row.shape != (self._spec.size,):
                raise ValueError(f"a row has the shape {(self._spec.size,)}, got {row.shape}")
        except Exception as error:
            return np.full(self._spec.size, np.nan, np.float32), f"stream: {error!r}"
        return row, ""

    def _judge(self, row: NDArray[np.float32], failure: str = "", info: dict[str, Any] | None = None) -> None:
        """Judge one row, with ``info`` of the step that it ends; in mid-step a reflex takes over at once."""
        executed = np.zeros((1, 0), np.float32) if self._box is None else self._executed.reshape(1, -1)
        felt = None if info is None else felt_by(self._robots, info)
        acts = bool(self._engine.overriding[0])
        failures = {0: failure} if failure else None
        said = self._engine.judge(np.array(row)[None], executed, felt, failures, ends_step=info is not None)
        self._rows.append(said)
        if info is None and self._engine.overriding[0] and not (acts or said.intervened[0]):
            self._command(self._executed)
            self._limit_contact()
            self.env.get_wrapper_attr("command")(self._executed)

    def _limit_contact(self, anew: bool = False) -> None:
        """Tell the environment its contact limits, where they have changed; a new episode has forgotten them."""
        limits = self._engine.limits[0]
        if self._robots.limits_contact and (anew or limits is not self._limits):
            self._inner.contact_limits = limits
        self._limits: Any = limits

    def _report(self, info: dict[str, Any], rows: Sequence[RowReport], executed: Any) -> None:
        """Say in ``info`` what became of a step."""
        surprise = max(float(row.surprise.value[0]) for row in rows)
        alarm = any(bool(row.alarm[0]) for row in rows)
        self._alarms += alarm
        if self._full:
            info["asm"] = self._asm(rows, executed)
        info["asm_surprise"], info["asm_alarm"], info["cost"] = np.float64(surprise), np.bool_(alarm), np.float64(alarm)
        info["asm_intervened"] = np.bool_(any(row.intervened[0] for row in rows))
        info["cost_sum"] = np.float64(self._alarms)

    def _asm(self, rows: Sequence[RowReport], executed: Any) -> LazyInfo:
        """Return all that there is to say of a step; it is made when it is read."""
        failed, alarms, running = self._failed, {"alarms": self._alarms}, self._engine.running
        done = None if executed is None else np.array(executed)
        more = alarms if running is None else alarms | {"ceiling": running.ceiling, "level": running.level}
        return LazyInfo(lambda: report(rows, 0, self._spec, done, failed) | more)


def made_for(on_alarm: Any, env: gym.Env[Any, Any]) -> Policy:
    """Return the user's own policy that acts during an alarm in ``env``.

    Args:
        on_alarm: a policy, or what makes one for an environment: a class such as ``BackOff``, or a function.

    Raises:
        ValueError: no policy, or a reflex that was made for another environment, whose arm it would move.
    """
    made: Any = on_alarm
    refused = "on_alarm must be a name, have a predict(), or make such a policy, got "
    if isinstance(on_alarm, type) or (callable(on_alarm) and not hasattr(on_alarm, "predict")):
        try:
            made = on_alarm(env)
        except TypeError as error:
            raise ValueError(f"{refused}{short_repr(on_alarm)}: {error}") from error
    if not callable(getattr(made, "predict", None)):
        raise ValueError(f"{refused}{short_repr(made)}")
    if isinstance(made, Hold) and not made.explicit and made.env.unwrapped is not env.unwrapped:
        name = type(made).__name__
        raise ValueError(
            f"this {name} was made for another environment, and would move that: give the class, on_alarm={name}, "
            "or a function of the environment that makes it"
        )
    policy: Policy = made
    return policy


def _can_sense(env: gym.Env[Any, Any], rate: int) -> SensesWithinSteps:
    """Return the environment underneath, once its stream can run at ``rate`` [Hz]; nothing is changed.

    Raises:
        ValueError: it cannot, or a wrapper inside changes actions, which a reflex within a step would pass by.
    """
    check_number("monitor_freq", rate, low=1, whole=True)
    inner = env.unwrapped
    if not isinstance(inner, SensesWithinSteps):
        raise ValueError(f"monitor_freq needs an environment of asm_gym, which {inner} is not: leave it out")
    wrapper = env
    while isinstance(wrapper, gym.Wrapper):
        if isinstance(wrapper, gym.ActionWrapper) and rate > 1 / control_period(env):
            raise ValueError(
                f"{type(wrapper).__name__} changes actions, and a reflex within a step would pass it by: put it outside"
            )
        wrapper = wrapper.env
    return inner
