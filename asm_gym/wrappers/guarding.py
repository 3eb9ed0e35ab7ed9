"""What a guard of one environment has in common with a guard of many."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import cached_property
from typing import Any, Literal
from uuid import uuid4

import gymnasium as gym
import numpy as np
from gymnasium.vector import VectorEnv
from numpy.typing import NDArray

from asm_gym.data.action_meaning import ACTIONS, ActionMeaning, ActionMeans
from asm_gym.detection import AdaptiveThreshold
from asm_gym.detection.contact_limits import ContactLimits
from asm_gym.guard.contact_state import no_load
from asm_gym.guard.fitted_monitor import (
    LOG,
    FittedMonitor,
    check_answer,
    check_monitor,
    diagnosis_of,
)
from asm_gym.guard.guard import Guard
from asm_gym.guard.options import GuardOptions, OnAlarm
from asm_gym.guard.robot_facts import RobotFacts
from asm_gym.guard.robot_table import Mask
from asm_gym.guard.step_info import LazyInfo, RowReport
from asm_gym.monitors import Monitor, NeuralASM, pretrained_for
from asm_gym.policies.hold import Hold
from asm_gym.policies.policy import Policy
from asm_gym.spec import StreamSpec
from asm_gym.stream_source import layers
from asm_gym.stream_view import StreamView
from asm_gym.validation import as_float32, short_repr
from asm_gym.wrappers.capabilities import controller_of, robots_of
from asm_gym.wrappers.env_attributes import AnyEnv, EnvAttributes, askable

# Attribute by which wrappers that count episodes are known, Gymnasium's and Stable-Baselines3's.
COUNTER_ATTRIBUTE = "episode_returns"


class Guarding:
    """Watch an environment, or many, with a monitor that may be replaced between episodes."""

    env: Any
    guard: Guard
    """The guard: its table of robots, and how often each alarm term held."""

    _spec: StreamSpec  # of the streams
    _view: StreamView  # of them, as the monitor reads them
    _period: float  # control period [s]
    _rows_per_step = 1
    _steps: NDArray[np.int64]  # (n,) done so far in the running episodes
    _alarms: NDArray[np.int64]  # (n,) of these in alarm

    def __init__(
        self,
        env: Any,
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
        self._limits: tuple[Any, ...] = ()
        self._wrap(env, monitor)

    def _wrap(self, env: Any, monitor: Monitor | None) -> None:
        """Wrap an environment; None is the shipped memory of its robot."""
        raise NotImplementedError

    @cached_property
    def _guard_name(self) -> str:
        """Its name among all guards around one environment."""
        return uuid4().hex

    def _watch_with(self, monitor: Monitor | None) -> None:
        """Use a monitor, by default the shipped memory of the robot, and make all that depends on it."""
        options = self._options
        if monitor is None:
            monitor = body_memory(self.env, self._spec)
        refuse_counts(self.env, type(self).__name__, options.on_alarm)
        check_answer(monitor)
        self._check(monitor)
        self._view = StreamView(offered=self._spec, wanted=monitor.spec)
        self._view.describe()

        recorded: ActionMeaning | None = None
        recorded_json = getattr(monitor, "about", {}).get(ACTIONS)
        if recorded_json is not None:
            recorded = ActionMeaning.from_json(recorded_json)
        self._facts, self._observation_map = robots_of(
            self.env, monitor.spec, self._period, recorded, options.action_means
        )

        policies: list[Policy] = []
        reaction = options.reaction(diagnosis_of(monitor) is not None)
        if not isinstance(reaction, str):
            policies = [policy_for(reaction, self.env)] * self._facts.count
        self.guard = Guard(self._facts, monitor, options, policies, self._rows_per_step)
        self._next_monitor = monitor

    def _check(self, monitor: Monitor) -> None:
        """Raise where a monitor does not fit the streams or the controller."""
        check_monitor(monitor, self._spec, controller_of(EnvAttributes(self.env)))

    def _check_period(self, period: float) -> None:
        """Raise ValueError if steps take another time [s] than the monitor was accepted for."""
        if period == self._period:
            return
        self._period = period
        self._spec = replace(self._spec, dt=period / self._rows_per_step)
        self._check(self.guard.fitted.monitor)

    def _limit_contact(self, anew: bool = False) -> None:
        """Set the environments' contact limits if they changed, or ``anew`` for new episodes."""
        limits = self.guard.limits
        if self._facts.limits_contact and (anew or limits is not self._limits):
            named_limits = [(self._guard_name, own) for own in limits]
            if isinstance(self.env, VectorEnv):
                askable(self.env).set_attr("limits_of_guard", named_limits)
            else:
                self.env.unwrapped.limits_of_guard = named_limits[0]
        self._limits = limits

    def _take_over_changed_monitor(self) -> None:
        """Take over the monitor that was assigned, or was fitted or calibrated since; else change nothing."""
        fitted = FittedMonitor.of(self._next_monitor, self._spec)
        if fitted.differs(self.guard.fitted):
            LOG.info(
                "the monitor was changed, fitted or calibrated since: it is taken over as it is now"
            )
            self._watch_with(self._next_monitor)

    def report_step(self, reports: Sequence[RowReport], target: dict[str, Any]) -> None:
        """Write what became of a step to its ``info``, which may tell of a guard inside."""
        surprise = np.max([report.robots["surprise"] for report in reports], axis=0)
        alarm = np.any([report.robots["alarm"] for report in reports], axis=0)
        intervened = np.any([report.robots["overridden"] for report in reports], axis=0)
        alarm |= np.asarray(target.get("asm_alarm", False), bool)
        intervened |= np.asarray(target.get("asm_intervened", False), bool)
        self._alarms += alarm
        numbers = {
            "asm_surprise": surprise,
            "asm_alarm": alarm,
            "asm_intervened": intervened,
            "cost": alarm.astype(np.float64),
            "cost_sum": self._alarms.astype(np.float64),
            "asm_steps": self._steps.copy(),
        }
        asm = LazyInfo(self._describe(reports))
        # Learners read it in every step: it is there without the rest.
        asm["threshold"] = reports[-1].robots["threshold"].copy()
        self._write(target, asm, numbers)

    def _write(self, target: dict[str, Any], asm: LazyInfo, numbers: dict[str, Any]) -> None:
        """Write ``info["asm"]``, and numbers (n,) by name, to the ``info`` of a step."""
        raise NotImplementedError

    def _describe(self, reports: Sequence[RowReport]) -> Callable[[], Any]:
        """Return a function that makes ``info["asm"]`` of this step, whenever it is called."""
        raise NotImplementedError

    def _stopped(self, reports: Sequence[RowReport]) -> Mask:
        """Return (n,) whose episode the guard ends."""
        gave_up = reports[-1].gave_up
        if self.guard.ends_on_alarm:
            alarms = [report.ends for report in reports]
            return np.any([gave_up, *alarms], axis=0)
        return gave_up

    def _running_threshold(self) -> dict[str, float]:
        """Return what ``info["asm"]`` says of a threshold that follows the policy; nothing where none does."""
        running = self.guard.running
        if running is None:
            return {}
        return {"ceiling": running.ceiling, "level": running.level}

    def acknowledge_wear(self) -> None:
        """Forget the wear in ``info["asm"]["wear"]``: the next episodes say what is healthy."""
        self.guard.acknowledge_wear()

    @property
    def latency(self) -> float:
        """How long the monitor took for the last rows [s]."""
        return self.guard.latency

    @property
    def monitor(self) -> Monitor:
        """The monitor in use.

        One that is assigned, or was fitted or calibrated since, takes over at the next reset.
        """
        return self.guard.fitted.monitor

    @monitor.setter
    def monitor(self, monitor: Monitor) -> None:
        self._check(monitor)
        self._next_monitor = monitor


def body_memory(env: AnyEnv, watched: StreamSpec) -> NeuralASM:
    """Return the shipped memory of the robot in ``env``, or in all its members.

    Raises:
        ValueError: no memory fits its stream and controller.
    """
    memory = NeuralASM.pretrained(pretrained_for(watched, controller_of(EnvAttributes(env))))
    LOG.info("watching %s with %r", env.unwrapped, memory)
    return memory


def policy_for(on_alarm: Any, env: AnyEnv) -> Policy:
    """Return the user's own policy that acts during an alarm.

    Args:
        on_alarm: a policy; for a single environment also a class or a function that makes one.
        env: the environment, or a vector environment.

    Raises:
        ValueError: it is no policy, or a reflex that would move the arm of another environment.
    """
    policy = on_alarm
    needs = "have a predict(), or make a policy"
    is_class = isinstance(on_alarm, type)
    makes_policy = callable(on_alarm) and (is_class or not hasattr(on_alarm, "predict"))
    if isinstance(env, VectorEnv):
        needs = "one policy with a predict() that all environments share"
        makes_policy = False
    try:
        if makes_policy:
            policy = on_alarm(env)
        if isinstance(policy, type) or not callable(getattr(policy, "predict", None)):
            raise TypeError("it has no predict()")
    except TypeError as error:
        message = f"on_alarm must be a name, or {needs}, got {short_repr(policy)}: {error}"
        raise ValueError(message) from error
    if isinstance(policy, Hold) and not policy.explicit:
        _check_bound(policy, env)
    return policy


def _check_bound(policy: Hold, env: AnyEnv) -> None:
    """Raise ValueError unless a reflex that is bound to an environment is bound to this one."""
    name = type(policy).__name__
    if isinstance(env, VectorEnv):
        raise ValueError(f"one {name} cannot act in several environments: give its name instead")
    if policy.env.unwrapped is not env.unwrapped:
        raise ValueError(
            f"this {name} was made for another environment, and would move that: "
            f"give the class, on_alarm={name}, or a function of the environment that makes it"
        )


def refuse_counts(env: AnyEnv, guard: str, on_alarm: object) -> None:
    """Raise ValueError for a wrapper inside the guard that counts episodes.

    It would miss the episodes that the guard ends, or numbers that the guard reports.

    Args:
        env: the environment that is guarded.
        guard: the name of the guard's class.
        on_alarm: what the guard does at an alarm; under ``"monitor"`` it ends no episode.
    """
    only_reports = isinstance(on_alarm, str) and on_alarm == "monitor"
    ends_episodes = not only_reports
    for layer in layers(env):
        attributes = vars(layer)
        reported = attributes.get("info_keywords", ())  # of Stable-Baselines3's Monitor
        reports_guard = any(key.startswith(("asm", "cost")) for key in reported)
        if COUNTER_ATTRIBUTE in attributes and (ends_episodes or reports_guard):
            name = type(layer).__name__
            raise ValueError(
                f"{name} inside the guard would miss the episodes that the guard ends, "
                f"and what it reports: put it outside, as in {name}({guard}(env, monitor)); "
                "with Stable-Baselines3, "
                "make_vec_env(lambda: NeuralASMSafety(gym.make(ID), monitor))"
            )
    if not (isinstance(env, VectorEnv) and ends_episodes):
        return
    if any(EnvAttributes(env).call("has_wrapper_attr", COUNTER_ATTRIBUTE)):
        raise ValueError(
            "wrappers of the members that count episodes would miss those that the guard ends: use "
            f"gymnasium.wrappers.vector.RecordEpisodeStatistics({guard}(envs, monitor))"
        )


def sensed_row(read: Callable[[], Any], size: int) -> tuple[NDArray[np.float32], str]:
    """Return the row (D,) that is read, or NaN and what failed."""
    try:
        row = as_float32(read())
        if row.shape != (size,):
            raise ValueError(f"a row has the shape {(size,)}, got {row.shape}")
    except Exception as error:
        return np.full(size, np.nan, np.float32), f"stream: {error!r}"
    return row, ""


def nothing_felt(size: int) -> dict[str, Any]:
    """Return what ``info`` says of contact before the first step, of ``size`` numbers that are felt."""
    return {
        "contact_load": np.nan,
        "contact_left_s": np.nan,
        "contact_felt": np.full(size, np.nan),
    }


def load_felt(
    facts: RobotFacts,
    infos: Mapping[str, Any],
    present: NDArray[np.bool_] | None = None,
) -> NDArray[np.float64] | None:
    """Return what the arms felt in a step (n, 2 + F), see ``asm_gym.guard.contact_state.no_load``; None for nothing.

    Args:
        facts: what is known of the robots.
        infos: ``info`` of the step.
        present: (n,) the robots that ``infos`` tell of; all by default.
    """
    if "contact_load" not in infos:
        return None
    load = no_load(facts.count, facts.felt_size)
    load[:, 0] = infos["contact_load"]
    load[:, 1] = infos.get("contact_left_s", np.nan)
    if "contact_felt" in infos:
        load[:, 2:] = infos["contact_felt"]
    if present is not None:
        load[~present] = np.nan
    return load


def as_action(space: gym.spaces.Space[Any] | None, action: Any) -> Any:
    """Return actions in the type of their space: whole numbers where a Box holds these."""
    if isinstance(space, gym.spaces.Box) and space.dtype.kind in "iu":
        return np.rint(action).astype(space.dtype)
    return action
