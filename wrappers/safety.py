"""Watches a policy's every step, and takes over or stops when what the robot feels is not what it expected."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Literal, SupportsFloat

import gymnasium as gym
import numpy as np
from gymnasium.utils import RecordConstructorArgs
from numpy.typing import NDArray

from asm_gym.contact_limits import ContactLimits
from asm_gym.detection import AdaptiveThreshold
from asm_gym.monitors import LearnsOnTheJob, Monitor, Surprise
from asm_gym.protocols import HoldsItself
from asm_gym.spec import control_period
from asm_gym.stream_source import StreamSource
from asm_gym.validation import as_float32, check_choice, check_number, shown
from asm_gym.wrappers.factory import (
    LOG,
    OnAlarm,
    body_memory,
    check_monitor,
    check_rate,
    fitted_parts,
    fitted_to,
    running,
)
from asm_gym.wrappers.guard import Guard, GuardOptions, nothing
from asm_gym.wrappers.observer import Observer, joined
from asm_gym.wrappers.quiet import QuietRow, QuietRows
from asm_gym.wrappers.step_report import INFO, STALE, RowReport, Said, ends, report


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

    ``info["asm"]`` says what came of a step: see ``asm_gym.wrappers.step_report.report``. For loggers the same stands
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
            every controller and wrapper; ``"retract"`` goes back along the path; ``"comply"`` yields to what presses;
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
            ``asm_gym.wrappers.responses.DEFAULT`` says: ``{"contact": "yield"}``. None may let a pressing arm go on.
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
            "responses": responses,
            "contact_limits": contact_limits,
        }
        RecordConstructorArgs.__init__(
            self,
            _disable_deepcopy=True,  # a reflex holds its environment, and a memory is large
            monitor=monitor,
            online_learning_rate=online_learning_rate,
            monitor_freq=monitor_freq,
            on_overrun=on_overrun,
            adaptive_threshold=adaptive_threshold,
            info=info,
            **given,
        )
        gym.Wrapper.__init__(self, env)
        self._box = env.action_space if isinstance(env.action_space, gym.spaces.Box) else None
        if self._box is None and on_alarm not in ("monitor", "terminate"):
            raise TypeError(
                f"on_alarm={shown(on_alarm)} needs a Box action space to act in, got {env.action_space}: others can "
                'only be watched, on_alarm="monitor", or ended, "terminate"'
            )
        check_choice("on_overrun", on_overrun, ("warn", "alarm", "ignore"))
        check_choice("info", info, INFO)
        self._full = info == "full"
        self._options = GuardOptions(**given)
        self.online_learning_rate = check_number("online_learning_rate", online_learning_rate, low=0, high=1)
        self._source, self._monitor_freq = StreamSource(env), monitor_freq
        self._adaptive = adaptive_threshold
        self._spec = self._source.spec
        if monitor_freq is not None:
            sensing = check_rate(env, monitor_freq)
            self._spec = sensing.stream_spec_at(monitor_freq)
        self._rows_per_step = max(1, round(control_period(env) / self._spec.dt)) if self._source.own else 1
        self._watch_with(body_memory(env, self._spec) if monitor is None else monitor)
        if monitor_freq is not None:
            sensing.stream_freq = monitor_freq  # nothing changes before everything is known to fit
        self._on_overrun: str = on_overrun
        self._warm = self._warned = False
        self._holds = env.unwrapped if isinstance(env.unwrapped, HoldsItself) else None
        self._ended = True

    @property
    def monitor(self) -> Monitor:
        """What watches. Another that is assigned, or one that was fitted or calibrated since, takes over at the next
        ``reset``. Raises as the constructor does where it does not fit."""
        return self._monitor

    @monitor.setter
    def monitor(self, monitor: Monitor) -> None:
        check_monitor(fitted_to(monitor, self._spec), self._spec)
        self._next = monitor

    def _watch_with(self, monitor: Monitor) -> None:
        """Takes up a monitor, and all that depends on it."""
        monitor = fitted_to(monitor, self._spec)
        if self.online_learning_rate > 0 and not isinstance(monitor, LearnsOnTheJob):
            raise ValueError(f"{type(monitor).__name__} cannot learn on the job: online_learning_rate must be 0")
        threshold = check_monitor(monitor, self._spec)
        self._running = running(self._adaptive, threshold)
        self._guard = Guard(self.env, monitor, self._options, threshold, self._box, self._rows_per_step)
        self._observer = Observer(monitor, recalls=self._guard.recalls)
        learns = self.online_learning_rate > 0
        self._quiet, self._calm = None if learns else QuietRows.of(monitor, self._guard), False
        self._monitor = self._next = monitor
        self._parts, self._promised = fitted_parts(monitor), threshold
        self._confirmed = False

    def _take_over(self) -> None:
        """Sees whether the monitor has changed since it was taken up."""
        changed = any(a is not b for a, b in zip(fitted_parts(self._next), self._parts, strict=True))
        if changed or check_monitor(self._next, self._spec) != self._promised:
            LOG.info("the monitor was changed, fitted or calibrated since: it is taken over as it is now")
            self._watch_with(self._next)

    @property
    def threshold(self) -> float:
        """What surprise must exceed for an alarm in this episode."""
        return self._guard.arbiter.threshold

    def confirm_alarm(self) -> None:
        """Says that what has alarmed in this episode was real, so that ``adaptive_threshold`` does not take it for a
        false alarm."""
        self._confirmed = True

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        self._ended = True  # until it has worked
        observation, info = self.env.reset(seed=seed, options=options)
        info = dict(info)
        self._follow()
        self._take_over()
        self._observer.begin()
        self._observation = observation
        self._guard.begin()
        if self._quiet is not None:
            self._quiet.begin()
        self._calm = self._quiet is not None and self._guard.calm
        self._threshold = float(self.threshold)
        self._passing: list[NDArray[np.float32]] = []  # quiet rows of which the guard has not been told
        self._alarms = 0
        none = Surprise(np.zeros(1), np.zeros((1, self.monitor.spec.size)))
        self._ended = False
        self._report(info, [nothing(none)], None)
        return observation, info

    def step(self, action: Any) -> tuple[Any, SupportsFloat, bool, bool, dict[str, Any]]:
        if self._ended:
            raise gym.error.ResetNeeded("call reset() before step(): no episode is running")
        if self._box is not None:
            action = np.array(as_float32(action, "an action"))  # a policy may use its buffer again
            if action.shape != self._box.shape:
                raise ValueError(f"an action has the shape {self._box.shape}, got {action.shape}")
        self._ended = True  # where anything raises, nobody knows what was done
        self._failed = ""
        self._command(action)
        overridden = self._guard.arbiter.overriding or self._refused
        self._rows: list[RowReport | QuietRow] = []
        parts = zip(fitted_parts(self._monitor), self._parts, strict=True)
        self._stale = "" if all(a is b for a, b in parts) else STALE
        if self._calm and self._quiet is not None and self._quiet.stale:
            self._interrupt()
            self._quiet = None
        observation, reward, terminated, truncated, info = self._run()
        info = dict(info)  # an environment may use its own again
        row, failure = self._sensed(observation, info)
        self._look(row, failure, info)
        self._observation = observation = self._guard.responder.observed(observation)
        repaired = self._guard.responder.row()
        if repaired is not None and "stream" in info:
            info["stream"] = repaired
        info["overridden"] = overridden or bool(info.get("overridden"))
        asm = self._report(info, self._rows, self._executed)
        if asm["gave_up"] or (
            self._guard.ends_on_alarm and any(r.decision.alarm and ends(r.whole(self.threshold)) for r in self._rows)
        ):
            terminated, truncated = terminated or not self._options.truncate, truncated or self._options.truncate
        self._ended = bool(terminated or truncated)
        return observation, reward, terminated, truncated, info

    def _follow(self) -> None:
        """Moves the threshold by the episode that has ended."""
        guard = self._guard
        if self._running is not None and guard.largest is not None:
            confirmed = self._confirmed or guard.arbiter.confirmed
            self._running.follow(guard.largest, guard.arbiter.threshold, confirmed)
            guard.arbiter.threshold = self._running.value
        guard.largest, self._confirmed = None, False

    def _command(self, action: Any) -> None:
        """Says what is to be done next: the policy's ``action`` (A,), or something else; never, where it is no Box."""
        if self._box is None:
            self._executed, self._refused = action, False
            return
        self._executed, failure, self._refused = self._guard.arbiter.command(action, self._observation)
        self._failed = joined(self._failed, failure)

    def _run(self) -> tuple[Any, SupportsFloat, bool, bool, dict[str, Any]]:
        """The step of the environment. Rows that come before its end are watched meanwhile, and who is held is held in
        all steps that wrappers in between make of one."""
        hooks: Any = self.env.get_wrapper_attr("row_hooks") if self._rows_per_step > 1 else None
        if hooks is not None:
            hooks.append(self._look)
        if self._holds is not None:
            self._holds.keeps_holding = True
        try:
            return self.env.step(self._executed)
        finally:
            if self._holds is not None:
                self._holds.keeps_holding = self._holds.holding = False
            if hooks is not None:
                hooks.remove(self._look)

    def _sensed(self, observation: Any, info: dict[str, Any]) -> tuple[NDArray[np.float32], str]:
        """The row (D,) that ends a step, or NaN and what failed."""
        try:
            row = as_float32(self._source.row(observation, self._executed, info))
            if row.shape != (self.monitor.spec.size,):
                raise ValueError(f"a row has the shape {(self.monitor.spec.size,)}, got {row.shape}")
        except Exception as error:
            return np.full(self.monitor.spec.size, np.nan, np.float32), f"stream: {error!r}"
        return row, ""

    def _look(self, row: NDArray[np.float32], failure: str = "", info: dict[str, Any] | None = None) -> None:
        """One row: what the monitor makes of it, and who acts next; with ``info`` of the step that it ends."""
        guard, late = self._guard, False
        if self._calm:
            if failure or self._refused or self._stale:
                self._interrupt()
            else:
                late = self._passes(row, info)
                if self._calm:
                    return
        beneath = None if info is None else guard.substeps.came(row, info)
        if self._refused:
            failure, self._refused = joined(self._failed, failure), False
        if self._stale:
            failure = joined(failure, self._stale)
        row, failure = guard.read(row, failure)
        surprise, expected, (failure,), latency = self._observer.observe(row[None], (failure,))
        if late or self._late(latency):
            surprise = surprise._replace(value=np.full(1, np.inf))
        surprise = guard.heard(surprise, bool(failure))
        if self.online_learning_rate > 0 and not guard.arbiter.overriding and not failure:
            failure = self._observer.learn(row[None], surprise, self.online_learning_rate)
            surprise = surprise if not failure else surprise._replace(value=np.full(1, np.inf))
        said = guard.judge(
            surprise, row, self._executed, failure, beneath, None if expected is None else expected[0], latency
        )
        if said.decision.acted_on or guard.forgets:
            said = said._replace(failure=joined(said.failure, self._observer.forget(np.ones(1, np.bool_))))
        self._rows.append(said)
        if guard.arbiter.overriding and not said.decision.intervened and beneath is None:
            self._command(self._executed)
            self.env.get_wrapper_attr("command")(self._executed)
        self._calm = self._quiet is not None and guard.calm

    def _passes(self, row: NDArray[np.float32], info: dict[str, Any] | None) -> bool:
        """Lets a row pass in which nothing happens; else it is calm no more. Whether it was so late as to alarm."""
        quiet = self._quiet
        assert quiet is not None
        quiet.take(self._observer.state)
        row = np.array(row)  # an environment may use its own again
        said = quiet.judge(row, info, self._threshold)
        late = said is not None and self._late(said.latency)
        if said is None or late:
            self._interrupt()
            return late
        quiet.keep()
        self._passing.append(row)
        self._rows.append(said)
        if info is not None and (failure := self._let_pass(ends_step=True)):
            decision = said.decision._replace(failure=failure)
            self._rows[-1] = said.whole(self._threshold)._replace(decision=decision, failure=failure)
        return False

    def _let_pass(self, ends_step: bool) -> str:
        """Tells the guard of the quiet rows of this step; what failed."""
        rows, self._passing = self._passing, []
        largest = max(said.value for said in self._rows[-len(rows) :])
        return self._guard.let_pass(rows, self._executed, largest, ends_step)

    def _interrupt(self) -> None:
        """Something may have happened: ``Observer`` and ``Guard`` go on from where the quiet rows have come to."""
        if self._passing:
            self._let_pass(ends_step=False)
        self._calm, state = False, None if self._quiet is None else self._quiet.hand_back()
        if state is not None:
            self._observer.state = state

    def _late(self, latency: float) -> bool:
        """Whether the monitor took so long that it counts as an alarm."""
        late, self._warm = self._warm and latency > self.monitor.spec.dt, True
        if late and self._on_overrun == "warn" and not self._warned:
            self._warned = True
            gym.logger.warn(
                f"the monitor took {1e3 * latency:.1f} ms for a row that lasts {1e3 * self.monitor.spec.dt:.1f} ms"
            )
        return late and self._on_overrun == "alarm"

    def _report(self, info: dict[str, Any], rows: Sequence[Said], executed: Any) -> dict[str, Any]:
        """Says in ``info`` what came of a step."""
        failed, responder = self._failed if executed is not None else "", self._guard.responder
        asm = report(rows, self.monitor.spec, self.threshold, executed, failed)
        self._alarms += asm["alarm"]
        asm.update(completed=responder.completed, unread=responder.unread, lost=responder.lost, alarms=self._alarms)
        if self._running is not None:
            asm.update(ceiling=self._running.ceiling, level=self._running.level)
        if self._full:
            info["asm"] = asm
        info["asm_surprise"], info["asm_alarm"] = np.float64(asm["surprise"]), np.bool_(asm["alarm"])
        info["asm_intervened"], info["cost"] = np.bool_(asm["intervened"]), np.float64(asm["alarm"])
        info["cost_sum"] = np.float64(self._alarms)
        return asm
