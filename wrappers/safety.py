"""Watches a policy's every step, and takes over or stops when what the robot feels is not what it expected."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import Any, Literal, SupportsFloat

import gymnasium as gym
import numpy as np
from gymnasium.utils import RecordConstructorArgs
from numpy.typing import NDArray

from asm_gym.detection import AdaptiveThreshold
from asm_gym.monitors import LearnsOnTheJob, Monitor, Surprise
from asm_gym.monitors.spinal import SpinalBand
from asm_gym.policies.base import Policy
from asm_gym.stream_source import StreamSource
from asm_gym.validation import as_float32, check_choice, check_flag, check_number, shown
from asm_gym.wrappers.arbitration import NOTHING, Arbiter
from asm_gym.wrappers.arguments import (
    body_memory,
    check_expectation,
    check_monitor,
    check_rate,
    fitted_to,
    make_fallback,
    make_patience,
    make_reflex,
    names_causes,
    running,
)
from asm_gym.wrappers.observer import Observer, joined
from asm_gym.wrappers.reports import RowReport, report
from asm_gym.wrappers.responses import Responder, responses_from
from asm_gym.wrappers.spinal import Left, SpinalCord


class NeuralASMSafety(gym.Wrapper[Any, Any, Any, Any], RecordConstructorArgs):
    """A safety layer around any environment with a Box action space, under any policy; others can be watched.

    After each step the monitor compares what was sensed with what it expected. From the step after an alarm on, a
    reflex acts in the policy's place, until surprise has stayed under ``release_below`` of the threshold for
    ``release_after`` steps; what has alarmed is not counted again, so that a nudge costs a pause and not the task. With
    ``monitor_freq`` it watches within control steps too, and the reflex takes over at the next physics substep.

    What fails is an alarm too, with the reflex in charge: a monitor that raises or returns nonsense, a stream that is
    missing, a policy whose action is not finite, which is not done. A reflex that fails is replaced by staying; its
    actions are clipped to the box. Where an exception leaves ``reset`` or ``step``, the episode has ended.

    What is wrong is named at every alarm, by monitors that can: ``info["asm"]["cause"]``. Under ``"graded"`` it decides
    what is done, and from the step after an alarm about a sensor on observation and stream hold what that sensor should
    say, completed from all others, until it has been well for a second.

    ``info["asm"]`` says what came of a step: see ``asm_gym.wrappers.reports.report``. For loggers the same stands
    beside it as NumPy scalars: ``info["asm_surprise"]``, ``info["asm_alarm"]``, ``info["asm_intervened"]``, and
    ``info["cost"]``, which is 1.0 on every step with an alarm and 0.0 otherwise, as safe-RL libraries expect.
    ``info["overridden"]`` is True after a step that began with another than the policy in charge: a policy with a state
    then resumes where it was left, if it is given the state from before, as ``asm_gym.policies.rollout`` does.

    Args:
        env: any Gymnasium environment; where ``info`` has no ``"stream"``, observation and action are the stream. No
            reflex can act where actions are not a Box: ``on_alarm`` must be ``"monitor"`` or ``"terminate"`` there.
        monitor: a fitted and calibrated monitor; where None, the shipped memory of the body that ``env`` moves.
        on_alarm: ``"monitor"`` only reports; ``"hold"`` stays and keeps the grip, in environments of this package under
            every controller and wrapper; ``"retract"`` goes back along the path; ``"comply"`` yields to what presses;
            ``"recall"`` goes on as the memory expects; ``"graded"`` does what the cause asks for (``responses``), hands
            back on trial, and ends the episode where trials fail; ``"terminate"`` ends the episode; any other policy
            acts itself, and where it raises, or returns what is no finite action, the robot holds. None for
            ``"graded"`` with a monitor that names causes, and for ``"hold"`` with any other.
        release_after: control steps of quiet after which control is handed back.
        release_below: share of the threshold, in (0, 1], that surprise must be under to count as quiet.
        max_override: control steps for which a reflex may act, after which the episode ends; an alarm that is back
            within ``release_after`` steps of handing back has not gone, and the count goes on. None for as many as it
            takes, with ``"graded"`` for 3 s.
        try_after: control steps of override after which control is handed back on trial, though surprise is not quiet;
            after each trial that fails, twice as many. None for no trials, with ``"graded"`` for 0.5 s.
        truncate: an episode that is ended by an alarm is truncated rather than terminated.
        learning_rate: above 0 the monitor goes on learning from steps that do not surprise it, by its ``adapt``, which
            changes it for all who watch with it: for a robot that slowly wears.
        monitor_freq: rows watched a second [Hz], by a monitor fitted at that rate, on environments whose
            ``stream_freq`` can be set; it is set to this. None for the rate that the environment's stream has.
        on_overrun: where the monitor takes longer for a row than a row lasts, ``"warn"`` says so once, ``"alarm"``
            takes it for infinite surprise, and ``"ignore"`` is for simulations, which wait. The first row does not
            count.
        adapt: how the threshold follows a policy that changes, from episode to episode; ``info["asm"]`` then holds the
            ``threshold`` of this episode, its ``ceiling``, and ``level``, the share of episodes so far with a false
            alarm. Not counted are alarms above the ceiling, those that went on while the reflex acted, and those that
            ``confirm_alarm`` was called for. None for a threshold that stays.

        responses: under ``"graded"``, what is done about which cause, where it is not what
            ``asm_gym.wrappers.responses.DEFAULT`` says: ``{"contact": "yield"}``.
        spinal: a calibrated band on what the arm feels, made with ``monitor``. It is compared in every physics substep
            of the policy's steps; once it is left, the arm stays from the next substep on, and the step is an alarm.
            ``info["asm"]["spinal_s"]`` says when in the step that was [s], or None. What it promises comes beside what
            ``monitor`` does. Elsewhere than in this package it is compared once a step, and a warning says so.

    Raises:
        ValueError: an unknown ``on_alarm``, cause or response, a monitor fitted for another stream or rate (the message
            names what differs), no monitor where no shipped memory fits (the message lists them), a rate that does not
            fit, ``"recall"`` with a monitor that expects no action, or a wrapper inside that changes actions, where the
            reflex cannot know what reaches the robot. Nothing is changed then.
        RuntimeError: the monitor is not calibrated.
    """

    def __init__(
        self,
        env: gym.Env[Any, Any],
        monitor: Monitor | None = None,
        on_alarm: str | Policy | None = None,
        *,
        release_after: int = 10,
        release_below: float = 0.8,
        max_override: int | None = None,
        try_after: int | None = None,
        truncate: bool = False,
        learning_rate: float = 0.0,
        monitor_freq: int | None = None,
        on_overrun: Literal["warn", "alarm", "ignore"] = "warn",
        adapt: AdaptiveThreshold | None = None,
        responses: Mapping[str, str] | None = None,
        spinal: SpinalBand | None = None,
    ) -> None:
        RecordConstructorArgs.__init__(
            self,
            _disable_deepcopy=True,  # a reflex holds its environment, and a memory is large
            monitor=monitor,
            on_alarm=on_alarm,
            release_after=release_after,
            release_below=release_below,
            max_override=max_override,
            try_after=try_after,
            truncate=truncate,
            learning_rate=learning_rate,
            monitor_freq=monitor_freq,
            on_overrun=on_overrun,
            adapt=adapt,
            responses=responses,
            spinal=spinal,
        )
        gym.Wrapper.__init__(self, env)
        self._box = env.action_space if isinstance(env.action_space, gym.spaces.Box) else None
        if self._box is None and on_alarm not in ("monitor", "terminate"):
            raise TypeError(
                f"on_alarm={shown(on_alarm)} needs a Box action space to act in, got {env.action_space}: others can "
                'only be watched, on_alarm="monitor", or ended, "terminate"'
            )
        check_choice("on_overrun", on_overrun, ("warn", "alarm", "ignore"))
        self.learning_rate = check_number("learning_rate", learning_rate, low=0, high=1)
        self._source = StreamSource(env)
        watched = self._source.spec
        if monitor_freq is not None:
            sensing = check_rate(env, monitor_freq)
            watched = sensing.stream_spec_at(monitor_freq)
        monitor = fitted_to(body_memory(env, watched) if monitor is None else monitor, watched)
        if learning_rate > 0 and not isinstance(monitor, LearnsOnTheJob):
            raise ValueError(f"{type(monitor).__name__} cannot learn on the job: learning_rate must be 0")
        threshold = check_monitor(monitor, watched)
        self._running = running(adapt, threshold)
        self.monitor = monitor
        if on_alarm is None:
            on_alarm = "graded" if names_causes(monitor) else "hold"
        self._ends = "truncated" if check_flag("truncate", truncate) else "terminated"
        self._on_alarm = on_alarm if isinstance(on_alarm, str) else "policy"
        reflex = make_reflex(on_alarm, env)
        self._observer = Observer(monitor, recalls=check_expectation(reflex, monitor))
        table = responses_from(responses)
        if responses is not None and on_alarm != "graded":
            raise ValueError(f"responses are those of on_alarm='graded', got on_alarm={shown(on_alarm)}")
        self._responder = Responder(env, monitor, table, repairs=on_alarm == "graded")
        patience = make_patience(reflex, env, release_after, release_below, max_override, try_after)
        fallback = None if self._box is None else make_fallback(env)
        acts = on_alarm != "monitor" and self._box is not None
        self._spinal = None if spinal is None else SpinalCord(env, spinal, monitor, acts)
        if monitor_freq is not None:
            sensing.stream_freq = monitor_freq  # nothing changes before everything is known to fit
        self._rows_per_step = self._source.rows_per_step
        self._arbiter = Arbiter(reflex, threshold, patience.in_rows(self._rows_per_step), fallback, self._box)
        self._largest: float | None = None  # surprise in this episode, while the policy acted
        self._confirmed = False
        self._on_overrun: str = on_overrun
        self._warm = self._warned = False
        self._ended = True

    @property
    def threshold(self) -> float:
        """What surprise must exceed for an alarm in this episode."""
        return self._arbiter.threshold

    def confirm_alarm(self) -> None:
        """Says that what has alarmed in this episode was real, so that ``adapt`` does not take it for a false alarm."""
        self._confirmed = True

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        self._ended = True  # until it has worked
        observation, info = self.env.reset(seed=seed, options=options)
        self._observer.begin()
        self._observation = observation
        self._follow()
        self._arbiter.reset()
        self._responder.reset()
        if self._spinal is not None:
            self._spinal.reset()
        none = Surprise(np.zeros(1), np.zeros((1, self.monitor.spec.size)))
        self._ended = False
        return observation, self._report(info, [RowReport(none, NOTHING)], None)

    def step(self, action: Any) -> tuple[Any, SupportsFloat, bool, bool, dict[str, Any]]:
        if self._ended:
            raise gym.error.ResetNeeded("call reset() before step(): no episode is running")
        if self._box is not None:
            action = as_float32(action, "an action")
            if action.shape != self._box.shape:
                raise ValueError(f"an action has the shape {self._box.shape}, got {action.shape}")
        self._ended = True  # where anything raises, nobody knows what was done
        self._failed = ""
        self._command(action)
        overridden = self._arbiter.overriding or self._refused
        self._rows: list[RowReport] = []
        self._left: Left | None = None
        if self._spinal is not None:
            if overridden:
                self._spinal.pause()
            else:
                self._spinal.send(self._observer.state, self._executed)
        with self._within_steps():
            observation, reward, terminated, truncated, info = self.env.step(self._executed)
        self._look(*self._sensed(observation, info), ends_step=True)
        self._observation = observation = self._responder.observed(observation)
        repaired = self._responder.row()
        if repaired is not None and "stream" in info:
            info["stream"] = repaired
        info["overridden"] = overridden or bool(info.get("overridden"))
        asm = self._report(info, self._rows, self._executed)["asm"]
        if asm["gave_up"] or (asm["alarm"] and self._on_alarm == "terminate"):
            terminated, truncated = terminated or self._ends == "terminated", truncated or self._ends == "truncated"
        self._ended = bool(terminated or truncated)
        return observation, reward, terminated, truncated, info

    def _follow(self) -> None:
        """Moves the threshold by the episode that has ended."""
        if self._running is not None and self._largest is not None:
            confirmed = self._confirmed or self._arbiter.confirmed
            self._running.follow(self._largest, self._arbiter.threshold, confirmed)
            self._arbiter.threshold = self._running.value
        self._largest, self._confirmed = None, False

    def _command(self, action: Any) -> None:
        """Says what is to be done next: the policy's ``action`` (A,), or something else; never, where it is no Box."""
        if self._box is None:
            self._executed, self._refused = action, False
            return
        self._executed, failure, self._refused = self._arbiter.command(action, self._observation)
        self._failed = joined(self._failed, failure)

    @contextmanager
    def _within_steps(self) -> Iterator[None]:
        """Watches the rows that come before the end of a control step, while the block runs."""
        if self._rows_per_step == 1:
            yield
            return
        hooks = self.env.get_wrapper_attr("row_hooks")
        hooks.append(self._look)
        try:
            yield
        finally:
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

    def _look(self, row: NDArray[np.float32], failure: str = "", ends_step: bool = False) -> None:
        """One row: what the monitor makes of it, and who acts next."""
        if self._refused:
            failure, self._refused = joined(self._failed, failure), False
        row = self._responder.read(row)
        failure = joined(failure, self._responder.doubt)
        surprise, expected, (failure,), latency = self._observer.observe(row[None], (failure,))
        if self._late(latency):
            surprise = surprise._replace(value=np.full(1, np.inf))
        if self._responder.completed:
            surprise = surprise.without(self._responder.missing)
        if self._responder.settling and not failure:
            surprise = surprise.silenced(np.ones(1, np.bool_))
        if self.learning_rate > 0 and not self._arbiter.overriding and not failure:
            failure = self._observer.learn(row[None], surprise, self.learning_rate)
            surprise = surprise if not failure else surprise._replace(value=np.full(1, np.inf))
        if failure:
            self._arbiter.warn(failure, "which counts as an alarm")
        watched = float(surprise.value[0])
        if self._spinal is not None and ends_step:
            self._left = self._spinal.left(row)
            surprise = surprise if self._left is None else self._left.added_to(surprise, self.threshold)
        value = float(surprise.value[0])
        alarm = not value <= self.threshold
        response = self._responder.respond(alarm, bool(failure), surprise.attribution[0], self._left is not None)
        decision = self._arbiter.decide(
            value,
            row,
            self._executed,
            ends_step,
            None if expected is None else expected[0],
            response.name,
            response.pressed,
            response.why,
        )
        if not decision.intervened:
            self._largest = max(self._largest or 0.0, watched)
        forget = decision.acted_on or self._responder.settling
        forgot = self._observer.forget(np.ones(1, np.bool_)) if forget else ""
        failure = joined(failure, decision.failure, forgot)
        self._rows.append(RowReport(surprise, decision, latency, failure, response))
        if self._arbiter.overriding and not decision.intervened and not ends_step:
            self._command(self._executed)
            self.env.get_wrapper_attr("command")(self._executed)

    def _late(self, latency: float) -> bool:
        """Whether the monitor took so long that it counts as an alarm."""
        late, self._warm = self._warm and latency > self.monitor.spec.dt, True
        if late and self._on_overrun == "warn" and not self._warned:
            self._warned = True
            gym.logger.warn(
                f"the monitor took {1e3 * latency:.1f} ms for a row that lasts {1e3 * self.monitor.spec.dt:.1f} ms"
            )
        return late and self._on_overrun == "alarm"

    def _report(self, info: dict[str, Any], rows: list[RowReport], executed: Any) -> dict[str, Any]:
        failed = self._failed if executed is not None else ""
        asm = report(rows, self.monitor.spec, self.threshold, executed, failed)
        asm |= {"completed": self._responder.completed, "unread": self._responder.unread}
        if self._spinal is not None:
            asm["spinal_s"] = None if executed is None or self._left is None else self._left.after_s
        if self._running is not None:
            asm |= {"ceiling": self._running.ceiling, "level": self._running.level}
        info["asm"] = asm
        info["asm_surprise"], info["asm_alarm"] = np.float64(asm["surprise"]), np.bool_(asm["alarm"])
        info["asm_intervened"], info["cost"] = np.bool_(asm["intervened"]), np.float64(asm["alarm"])
        return info
