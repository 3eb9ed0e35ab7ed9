"""Watches a policy's every step, and takes over or stops when what the robot feels is not what it expected."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any, Literal, NamedTuple, SupportsFloat

import gymnasium as gym
import numpy as np
from gymnasium.utils import RecordConstructorArgs
from numpy.typing import NDArray

from asm_gym.choices import check_choice
from asm_gym.monitors import Monitor, Surprise
from asm_gym.policies.base import Policy
from asm_gym.policies.reflexes import Comply, Graded, Hold, Recall, Retract
from asm_gym.stream import control_period
from asm_gym.wrappers.arbitration import NOTHING, Arbiter, Patience, Verdict
from asm_gym.wrappers.recording import StreamSource

REFLEXES: dict[str, Callable[[gym.Env[Any, Any]], Policy]] = {
    "hold": Hold,
    "retract": Retract,
    "comply": Comply,
    "recall": Recall,
    "graded": Graded,
}
"""Reflexes by name: policies that act after an alarm."""
ON_ALARM = ("monitor", *REFLEXES, "terminate")
"""Names that ``on_alarm`` takes."""


class Look(NamedTuple):
    """What the monitor made of one row."""

    surprise: Surprise
    verdict: Verdict
    latency: float  # of the monitor [s]


class NeuralASMSafety(gym.Wrapper[Any, Any, Any, Any], RecordConstructorArgs):
    """A safety layer around any environment with a Box action space, under any policy.

    After each step the monitor compares what was sensed with what it expected. From the step after an alarm on, a
    reflex acts in the policy's place, until surprise has stayed under ``release_below`` of the threshold for
    ``release_after`` steps; what has alarmed is not counted again, so that a nudge costs a pause and not the task. With
    ``monitor_freq`` it watches within control steps too, and the reflex takes over at the next physics substep.

    ``info["asm"]`` holds ``surprise`` (the largest of this step), ``threshold``, ``alarm`` (surprise is over the
    threshold), ``intervened`` (the reflex acted in this step, or in a part of it), ``gave_up`` (it has acted for
    ``max_override`` steps, and the episode ends), ``transition`` (who acts from now on: ``"override"``,
    ``"release"``, ``"trial"``, ``"give_up"``, or empty where nothing changes; they go to the log ``asm_gym.safety`` as
    well), ``failure`` (why the reflex could not act and the robot held instead,
    or empty), ``executed_action`` (the last one), ``attribution`` (what each number of the stream adds to surprise),
    ``surprises`` (n,) of all rows in this step, and ``latency_us`` (the longest time that the monitor took for one).
    ``info["cost"]`` is 1.0 on every step with an alarm and 0.0 otherwise, as safe-RL libraries expect.

    Args:
        env: any Gymnasium environment; where ``info`` has no ``"stream"``, observation and action are the stream.
        monitor: a fitted and calibrated monitor.
        on_alarm: ``"monitor"`` only reports; ``"hold"`` stays and keeps the grip; ``"retract"`` goes back along the
            path; ``"comply"`` yields to what presses; ``"recall"`` goes on as the memory expects; ``"graded"`` stays,
            yields to what keeps pressing, hands back on trial, and ends the episode where trials fail; ``"terminate"``
            ends the episode; any other policy acts itself, and where it raises, or returns what is no finite action,
            the robot holds.
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

    Raises:
        ValueError: an unknown ``on_alarm``, a monitor fitted for another stream or rate (the message names what
            differs), a rate that does not fit, or ``"recall"`` with a monitor that expects no action.
        RuntimeError: the monitor is not calibrated.
    """

    def __init__(
        self,
        env: gym.Env[Any, Any],
        monitor: Monitor,
        on_alarm: str | Policy = "hold",
        *,
        release_after: int = 10,
        release_below: float = 0.8,
        max_override: int | None = None,
        try_after: int | None = None,
        truncate: bool = False,
        learning_rate: float = 0.0,
        monitor_freq: int | None = None,
        on_overrun: Literal["warn", "alarm", "ignore"] = "warn",
    ) -> None:
        RecordConstructorArgs.__init__(
            self,
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
        )
        gym.Wrapper.__init__(self, env)
        if not isinstance(env.action_space, gym.spaces.Box):
            raise TypeError(f"NeuralASMSafety needs a Box action space, got {env.action_space}")
        check_choice("on_overrun", on_overrun, ("warn", "alarm", "ignore"))
        if not 0.0 <= learning_rate <= 1.0:
            raise ValueError(f"learning_rate must be in [0, 1], got {learning_rate}")
        if learning_rate > 0 and not hasattr(monitor, "adapt"):
            raise ValueError(f"{type(monitor).__name__} cannot learn on the job: learning_rate must be 0")
        if monitor_freq is not None:
            _watch_at(env, monitor_freq)
        self._source = StreamSource(env)
        self._rows_per_step = self._source.rows_per_step
        monitor.spec.require(self._source.spec, "the monitor")
        self.monitor = monitor
        self.threshold, self.learning_rate = monitor.threshold, learning_rate
        self._ends = "truncated" if truncate else "terminated"
        self._on_alarm = on_alarm if isinstance(on_alarm, str) else "policy"
        reflex = make_reflex(on_alarm, env)
        self._recalls = check_expectation(reflex, monitor)
        patience = make_patience(reflex, env, release_after, release_below, max_override, try_after)
        self._arbiter = Arbiter(reflex, self.threshold, patience.in_rows(self._rows_per_step), make_fallback(env))
        self._on_overrun: str = on_overrun
        self._warm = self._warned = False
        self._ended = True

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        observation, info = self.env.reset(seed=seed, options=options)
        self._state = self.monitor.initial_state(batch=1)
        self._observation = observation
        self._arbiter.reset()
        self._ended = False
        none = Surprise(np.zeros(1), np.zeros((1, self.monitor.spec.size)))
        return observation, self._report(info, [Look(none, NOTHING, 0.0)], None)

    def step(self, action: Any) -> tuple[Any, SupportsFloat, bool, bool, dict[str, Any]]:
        if self._ended:
            raise gym.error.ResetNeeded("call reset() before step(): no episode is running")
        self._executed = self._arbiter.executed(action, self._observation)
        self._looks: list[Look] = []
        with self._within_steps():
            observation, reward, terminated, truncated, info = self.env.step(self._executed)
        self._observation = observation
        self._look(self._source.row(observation, self._executed, info), ends_step=True)
        asm = self._report(info, self._looks, self._executed)["asm"]
        if asm["gave_up"] or (asm["alarm"] and self._on_alarm == "terminate"):
            terminated, truncated = terminated or self._ends == "terminated", truncated or self._ends == "truncated"
        self._ended = bool(terminated or truncated)
        return observation, reward, terminated, truncated, info

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

    def _look(self, row: NDArray[np.float32], ends_step: bool = False) -> None:
        """One row: what the monitor makes of it, and who acts next."""
        before, start = self._state, time.perf_counter()
        self._state, surprise = self.monitor.observe(before, row[None])
        latency = time.perf_counter() - start
        if self._late(latency):
            surprise = surprise._replace(value=np.full(1, math.inf))
        expected = self.monitor.expected_action(self._state)[0] if self._recalls else None  # type: ignore[attr-defined]
        value = float(surprise.value[0])
        verdict = self._arbiter.judge(value, row, self._executed, feel=ends_step, expected=expected)
        if verdict.acted_on and hasattr(self.monitor, "resynchronise"):
            self._state = self.monitor.resynchronise(self._state)
        if self.learning_rate > 0 and not verdict.intervened:
            self.monitor.adapt(before, row[None], surprise, self.learning_rate)  # type: ignore[attr-defined]
        self._looks.append(Look(surprise, verdict, latency))
        if self._arbiter.overriding and not verdict.intervened and not ends_step:
            self._executed = self._arbiter.executed(self._executed, self._observation)
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

    def _report(self, info: dict[str, Any], looks: list[Look], executed: NDArray[np.float32] | None) -> dict[str, Any]:
        surprises = np.array([look.surprise.value[0] for look in looks])
        worst = looks[int(np.argmax(surprises))].surprise
        alarm = any(not s <= self.threshold for s in surprises)
        info["asm"] = {
            "surprise": float(worst.value[0]),
            "threshold": self.threshold,
            "alarm": alarm,
            "intervened": any(look.verdict.intervened for look in looks),
            "gave_up": any(look.verdict.gave_up for look in looks),
            "transition": next((t for look in reversed(looks) if (t := look.verdict.transition)), ""),
            "failure": self._arbiter.failure,
            "executed_action": executed,
            "attribution": dict(zip(self.monitor.spec.labels, worst.attribution[0].tolist(), strict=True)),
            "surprises": surprises,
            "latency_us": 1e6 * max(look.latency for look in looks),
        }
        info["cost"] = 1.0 if alarm else 0.0
        return info


def make_reflex(on_alarm: str | Policy, env: gym.Env[Any, Any]) -> Policy | None:
    """The policy that acts during an alarm; None where none does."""
    if not isinstance(on_alarm, str):
        if not callable(getattr(on_alarm, "predict", None)):
            raise ValueError(f"on_alarm must be one of {', '.join(ON_ALARM)} or have a predict(), got {on_alarm!r}")
        return on_alarm
    if on_alarm not in ON_ALARM:
        raise ValueError(f"unknown on_alarm {on_alarm!r}; known: {', '.join(ON_ALARM)}, or any policy")
    return REFLEXES[on_alarm](env) if on_alarm in REFLEXES else None


def make_patience(
    reflex: Policy | None,
    env: gym.Env[Any, Any],
    release_after: int,
    release_below: float,
    max_override: int | None,
    try_after: int | None,
) -> Patience:
    """When control is handed back, in control steps; ``Graded`` has limits of its own where none are given."""
    if isinstance(reflex, Graded):
        dt = control_period(env)
        try_after = try_after or max(1, round(reflex.TRY_AFTER_S / dt))
        max_override = max_override or max(1, round(reflex.GIVE_UP_AFTER_S / dt))
    return Patience(release_after, release_below, max_override, try_after)


def make_fallback(env: gym.Env[Any, Any]) -> Hold:
    """What acts where a reflex fails to: staying, or what comes nearest to no action."""
    space = env.action_space
    assert isinstance(space, gym.spaces.Box)
    rest = np.clip(np.zeros(space.shape, np.float32), space.low, space.high)
    return Hold(env) if not rest.any() else Hold(env, safe_action=rest)


def check_expectation(reflex: Policy | None, monitor: Monitor) -> bool:
    """Whether the reflex has to be told what the memory expects to be commanded.

    Raises:
        ValueError: it has, and the monitor expects nothing.
    """
    recalls = isinstance(reflex, Recall)
    if recalls and not (hasattr(monitor, "expected_action") and monitor.spec.motor.size):
        raise ValueError(f"recall needs a memory that expects actions, and {type(monitor).__name__} does not")
    return recalls


def _watch_at(env: gym.Env[Any, Any], rate: int) -> None:
    """Makes an environment's stream run at ``rate`` [Hz]."""
    inner: Any = env.unwrapped
    if not hasattr(inner, "row_hooks"):
        raise ValueError(f"monitor_freq needs an environment of asm_gym, which {inner} is not: leave it out")
    wrapper = env
    while isinstance(wrapper, gym.Wrapper):
        if isinstance(wrapper, gym.ActionWrapper) and rate > 1 / control_period(env):
            raise ValueError(
                f"{type(wrapper).__name__} changes actions, and a reflex within a step would pass it by: put it outside"
            )
        wrapper = wrapper.env
    inner.stream_freq = rate
