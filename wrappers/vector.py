"""Watches many environments of one ``gym.make_vec`` at once, and lets a reflex act in those that are in alarm."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Literal

import gymnasium as gym
import numpy as np
from gymnasium.vector import AutoresetMode, VectorEnv, VectorWrapper
from gymnasium.vector.utils import iterate
from numpy.typing import NDArray

from asm_gym.detection import AdaptiveThreshold
from asm_gym.detection.contact_limits import ContactLimits
from asm_gym.guard.checks import LOG, Fitted, check_answer, check_monitor, diagnosis_of
from asm_gym.guard.engine import Engine
from asm_gym.guard.options import GuardOptions, OnAlarm
from asm_gym.guard.report import INFO, LazyInfo, RowReport, side_by_side
from asm_gym.monitors import Monitor
from asm_gym.policies.base import Policy, Reflex
from asm_gym.policies.reflexes import Hold
from asm_gym.spec import StreamSpec, control_period
from asm_gym.validation import as_float32, check_choice, short_repr
from asm_gym.wrappers.robots import askable, felt_by, memory_of, refuse_running_statistics, robots_of_many
from asm_gym.wrappers.vector_infos import Mask, final, put, replace, said_by

FELT = "contact_load", "contact_left_s", "contact_felt"
"""What environments say of what their arms felt within a step."""


class VectorNeuralASMSafety(VectorWrapper):
    """``NeuralASMSafety`` for n environments side by side, with one batched ``observe`` for all of them.

    Arguments, promises and reports are those of ``NeuralASMSafety``: ``info["asm"]`` holds arrays whose first axis is
    n, and ``info["cost"]``, ``info["asm_surprise"]``, ``info["asm_alarm"]`` and ``info["asm_intervened"]`` are (n,). A
    monitor that raises has judged nobody, and all are in alarm; any other failure is that of one environment. Where an
    episode has just begun, surprise is 0 and ``executed_action`` NaN. Under ``AutoresetMode.SAME_STEP`` the last step
    of an episode is reported in ``info["final_info"]``.

    An episode that the wrapper itself ends begins anew as any other does. Under ``AutoresetMode.NEXT_STEP`` its
    environment, which cannot know, takes one more step before that, which nobody sees.

    Args:
        env: of ``gym.make_vec``; where ``info`` has no ``"stream"``, observation and action are the stream.
        monitor: a fitted and calibrated monitor; where None, the shipped memory of the body that they move.
        on_alarm: a name as in ``NeuralASMSafety``, or one policy that is shared, and must keep what it knows in its
            state.
        release_after, release_below, max_override, try_after, truncate, responses, contact_limits, info: as there.
        adaptive_threshold: as there; all environments share one running threshold, and an episode keeps what it began
            with.

    Raises:
        TypeError: ``env`` is no vector environment, cannot be asked for what its members are, or takes no Box actions.
        ValueError: an unknown ``on_alarm``, a monitor fitted for another stream (the message names the channels), or a
            wrapper inside that changes actions, where the reflex cannot know what reaches the robot, or what it
            makes of the same sense as it goes on.
        RuntimeError: the monitor is not calibrated.

    Example:
        >>> import gymnasium as gym
        >>> from asm_gym import VectorNeuralASMSafety
        >>> envs = VectorNeuralASMSafety(gym.make_vec("asm_gym/Lift-v0", num_envs=2))
        >>> observations, infos = envs.reset(seed=0)
        >>> *_, infos = envs.step(0.1 * envs.action_space.sample())
        >>> infos["asm"]["surprise"].shape, infos["asm"]["reason"].tolist()
        ((2,), ['', ''])
    """

    def __init__(
        self,
        env: VectorEnv[Any, Any, Any],
        monitor: Monitor | None = None,
        on_alarm: OnAlarm | None = None,
        *,
        release_after: int = 10,
        release_below: float = 0.8,
        max_override: int | None = None,
        try_after: int | None = None,
        truncate: bool = False,
        adaptive_threshold: AdaptiveThreshold | None = None,
        responses: Mapping[str, str] | None = None,
        contact_limits: ContactLimits | Literal["memory"] | None = "memory",
        info: Literal["full", "flat"] = "full",
    ) -> None:
        super().__init__(env)
        if not isinstance(env.single_action_space, gym.spaces.Box):
            raise TypeError(f"VectorNeuralASMSafety needs a Box action space, got {env.single_action_space}")
        refuse_running_statistics(env)
        check_choice("info", info, INFO)
        self._full = info == "full"
        self._options = GuardOptions(
            on_alarm,
            release_after,
            release_below,
            max_override,
            try_after,
            truncate,
            responses,
            contact_limits,
            adaptive_threshold,
        )
        self._mode = AutoresetMode(env.metadata.get("autoreset_mode", AutoresetMode.NEXT_STEP))
        self._members = askable(env)
        self._spec, self._own_stream = self._stream()
        self._watch_with(memory_of(env, self._spec) if monitor is None else monitor)
        self._holding = False
        if self._robots.brakes:
            # Who is held is held in all steps that wrappers in between make of one.
            self._members.set_attr("keeps_holding", [True] * env.num_envs)
        self._alarms = np.zeros(env.num_envs, np.int64)
        self._ended: Mask | None = None
        self._forced = np.zeros(env.num_envs, bool)  # ended by this wrapper, which the environment does not know yet

    def _stream(self) -> tuple[StreamSpec, bool]:
        """Return the spec of the members' streams, and whether they have streams of their own."""
        env = self.env
        if not all(self._members.call("has_wrapper_attr", "stream_spec")):
            if not isinstance(env.single_observation_space, gym.spaces.Box):
                raise TypeError(
                    f"environments without a stream are watched side by side where each senses a Box, got "
                    f"{env.single_observation_space}: wrap each in NeuralASMSafety, or in FlattenObservation"
                )
            spaces = env.single_observation_space, env.single_action_space
            return StreamSpec.from_spaces(*spaces, control_period(env)), False  # type: ignore[arg-type]
        first, *others = self._members.call("get_wrapper_attr", "stream_spec")
        for other in others:
            first.require(other, "the first environment")
        periods = (
            self._members.call("get_wrapper_attr", "dt") if all(self._members.call("has_wrapper_attr", "dt")) else ()
        )
        if periods and round(periods[0] / first.dt) > 1:
            raise ValueError("many environments are watched at their control rate: make them without stream_freq")
        return first, True

    def _watch_with(self, monitor: Monitor) -> None:
        """Take up a monitor, and all that depends on it."""
        check_answer(monitor)
        check_monitor(monitor, self._spec)
        chosen = self._options.reaction(diagnosis_of(monitor) is not None)
        self._robots, self._places = robots_of_many(self.env, monitor.spec)
        policies = () if isinstance(chosen, str) else [_shared(chosen)] * self.num_envs
        self._engine = Engine(self._robots, monitor, self._options, policies)
        self._monitor = self._next = monitor
        self._taken_up = Fitted.of(monitor, self._spec)

    @property
    def monitor(self) -> Monitor:
        """As in ``NeuralASMSafety``; what has changed is taken over at the next ``reset`` of all environments."""
        return self._monitor

    @monitor.setter
    def monitor(self, monitor: Monitor) -> None:
        check_answer(monitor)
        check_monitor(monitor, self._spec)
        self._next = monitor

    @property
    def threshold(self) -> NDArray[np.float64]:
        """(n,) what surprise must exceed for an alarm in the episodes that run."""
        return self._engine.threshold.copy()

    def confirm_alarm(self, which: Mask | None = None) -> None:
        """As in ``NeuralASMSafety``, of ``which`` (n,) environments; of all by default."""
        self._engine.confirmed[:] |= np.ones(self.num_envs, bool) if which is None else which

    def reset(self, *, seed: Any = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        n = self.num_envs
        begun = np.array((options or {}).get("reset_mask", np.ones(n, bool)))
        ended, self._ended = self._ended, None  # until it has worked
        # A copy: vector environments take the mask out of the options they are given.
        self._observations, infos = self.env.reset(seed=seed, options=dict(options) if options else options)
        infos = dict(infos)
        if ended is None and not begun.all():
            raise gym.error.ResetNeeded("the first reset() must be of all environments")
        self._ended = np.zeros(n, bool) if ended is None else ended
        nothing = self._begin(begun)
        if begun.all() and Fitted.of(self._next, self._spec).differs(self._taken_up):
            LOG.info("the monitor was changed, fitted or calibrated since: it is taken over as it is now")
            self._watch_with(self._next)
            nothing = self._begin(begun)
        self._report(infos, nothing, np.full(self.env.action_space.shape or (), np.nan, np.float32), begun)
        return self._observations, infos

    def step(self, actions: Any) -> tuple[Any, NDArray[Any], Mask, Mask, dict[str, Any]]:
        if self._ended is None or (self._mode == AutoresetMode.DISABLED and self._ended.any()):
            raise gym.error.ResetNeeded("call reset() before step(): an environment's episode is not running")
        begun, self._ended = self._ended.copy(), None  # where anything raises, nobody knows what was done
        # Those of ``begun`` begin an episode in this step; none of them under SAME_STEP.
        executed, failed = self._command(actions, begun)
        observations, rewards, terminated, truncated, infos = self.env.step(executed.copy())
        infos = dict(infos)
        if self._forced.any():
            forced = self._forced
            observations, fresh = self.env.reset(options={"reset_mask": forced.copy()})
            infos = replace(infos, fresh, forced)
            rewards, terminated, truncated = (np.where(forced, 0, x) for x in (rewards, terminated, truncated))
        same = self._mode == AutoresetMode.SAME_STEP
        known = np.asarray(terminated | truncated, bool)
        last = known if same else np.zeros_like(known)
        rows, failures = self._sensed(observations, executed, infos, last)
        said = self._engine.judge(rows, executed, self._felt(infos, last), failures, active=~begun)
        said = said.with_failures(failed)
        stopped = (said.gave_up | (said.ends & self._engine.ends_on_alarm)) & ~begun
        terminated = np.asarray(terminated, bool) | (stopped & (not self._options.truncate))
        truncated = np.asarray(truncated, bool) | (stopped & self._options.truncate)
        self._forced = stopped & ~known
        observations = self._repaired(observations, infos, ~begun & ~last)
        if same and self._forced.any():
            observations, infos = self._restart(observations, infos)
        executed[begun] = np.nan
        self._ended = np.zeros_like(begun)
        if same:
            self._report_ends(infos, said, executed, terminated | truncated)
        else:
            self._begin(begun)
            self._report(infos, said, executed, np.ones(self.num_envs, bool))
            self._ended = terminated | truncated
        self._observations = observations
        return observations, rewards, terminated, truncated, infos

    def _command(self, actions: Any, begun: Mask) -> tuple[NDArray[np.float32], Mapping[int, str]]:
        """Return (n, A) what is done, and what failed when it was chosen."""
        chosen = as_float32(actions, "actions").copy()
        if chosen.shape != self.env.action_space.shape:
            raise ValueError(f"actions have the shape {self.env.action_space.shape}, got {chosen.shape}")

        def seen(robot: int) -> Any:
            return list(iterate(self.observation_space, self._observations))[robot]

        self._limit()
        command = self._engine.act(chosen.reshape(len(chosen), -1), seen, idle=begun)
        brakes = bool(command.brakes.any())
        if brakes or self._holding:
            self._members.set_attr("holding", command.brakes.tolist())
        self._holding = brakes
        return command.actions.reshape(chosen.shape), command.failures

    def _sensed(
        self, observations: Any, executed: NDArray[np.float32], infos: dict[str, Any], last: Mask
    ) -> tuple[NDArray[np.float32], dict[int, str]]:
        """Return (n, D) what was sensed in this step, and what failed at that by environment; of episodes that were in
        their ``last`` one, before they began anew."""
        n, size = self.num_envs, self._spec.size
        stream: Any = infos.get("stream")
        told = infos.get("_stream", np.ones(n, bool))
        if self._own_stream and not last.any() and np.all(told) and np.shape(stream) == (n, size):
            return np.array(as_float32(stream)), {}
        rows, failures = np.full((n, size), np.nan, np.float32), {}
        for i in range(n):
            try:
                row = self._row(i, observations, executed, infos, bool(last[i]))
                if row.shape != (size,):
                    raise ValueError(f"a row has the shape {(size,)}, got {row.shape}")
                rows[i] = row
            except Exception as error:
                failures[i] = f"stream: {error!r}"
        return rows, failures

    def _row(
        self, i: int, observations: Any, executed: NDArray[np.float32], infos: dict[str, Any], last: bool
    ) -> NDArray[np.float32]:
        """Return (D,) of one environment."""
        if self._own_stream:
            said = said_by(infos, i, last, ("stream",))
            if "stream" not in said:
                raise KeyError('info has no "stream"')
            return as_float32(said["stream"])
        sensed = infos["final_obs"][i] if last else observations[i]
        return as_float32(np.concatenate([np.ravel(sensed), np.ravel(executed[i])]))

    def _felt(self, infos: dict[str, Any], last: Mask) -> NDArray[np.float64]:
        """Return what the arms felt in this step, those of episodes in their ``last`` one before they began anew."""
        now = felt_by(self._robots, infos, infos.get(f"_{FELT[0]}"))
        if not last.any():
            return now
        before = felt_by(self._robots, infos["final_info"], infos["final_info"].get(f"_{FELT[0]}"))
        return np.where(last[:, None], before, now)

    def _repaired(self, observations: Any, infos: dict[str, Any], where: Mask) -> Any:
        """Return the observations, and set the streams, with what is completed in the environments of ``where``."""
        for i, (row, missing) in self._engine.repaired.items():
            if not where[i] or self._places is None:
                continue
            seen = list(iterate(self.observation_space, observations))[i]
            observations = put(observations, i, self._places.repaired(seen, row, missing))
            if "stream" in infos:
                infos["stream"] = put(infos["stream"], i, row)
        return observations

    def _begin(self, begun: Mask) -> RowReport:
        """Begin new episodes, which have forgotten their contact limits."""
        assert self._ended is not None
        self._ended[begun] = self._forced[begun] = False
        self._alarms[begun] = 0
        nothing = self._engine.begin(begun) if begun.any() else self._engine.nothing()
        if begun.any():
            self._limits: tuple[Any, ...] = ()
        self._limit()
        return nothing

    def _limit(self) -> None:
        """Tell the environments their contact limits, where those have changed."""
        limits = self._engine.limits
        if self._robots.limits_contact and limits is not self._limits:
            self._members.set_attr("contact_limits", list(limits))
        self._limits = limits

    def _restart(self, observations: Any, infos: dict[str, Any]) -> tuple[Any, dict[str, Any]]:
        """Begin anew what this wrapper has ended, in the same step."""
        forced = self._forced
        infos = final(infos, list(iterate(self.observation_space, observations)), forced)
        observations, fresh = self.env.reset(options={"reset_mask": forced.copy()})
        return observations, replace(infos, fresh, forced, keep=("final_obs", "final_info"))

    def _report_ends(self, infos: dict[str, Any], said: RowReport, executed: NDArray[np.float32], ended: Mask) -> None:
        """Report what ended in ``final_info``, and what has begun in its place in ``infos``."""
        if ended.any():
            infos["final_info"] = dict(infos["final_info"])
            self._report(infos["final_info"], said, executed, ended)
            self._begin(ended)
            executed = np.where(ended[:, None], np.float32(np.nan), executed)
            self._alarms -= said.alarm & ~ended  # counted by the next report
            said = said.of(~ended)
        else:
            self._begin(ended)
        self._report(infos, said, executed, np.ones(self.num_envs, bool))

    def _report(self, infos: dict[str, Any], said: RowReport, executed: NDArray[np.float32], present: Mask) -> None:
        """Add ``asm`` and ``cost`` of the environments that are ``present``, with Gymnasium's masks."""
        self._alarms += said.alarm
        found: dict[str, Any] = {
            "asm_surprise": said.surprise.value,
            "asm_alarm": said.alarm,
            "asm_intervened": said.intervened,
            "cost": said.alarm.astype(np.float64),
            "cost_sum": self._alarms.astype(np.float64),
        }
        if self._full:
            asm: dict[str, Any] = {"executed_action": executed.copy(), "alarms": self._alarms.copy()}
            if self._engine.running is not None:
                n, running = self.num_envs, self._engine.running
                asm |= {"ceiling": np.full(n, running.ceiling), "level": np.full(n, running.level)}
            found["asm"] = LazyInfo(lambda: side_by_side(said, self._spec) | asm)
        infos.update(found | {f"_{key}": present for key in found})


def _shared(policy: Any) -> Policy:
    """Return a policy that acts in all environments.

    Raises:
        ValueError: it is none, or knows one environment.
    """
    if isinstance(policy, type) or not callable(getattr(policy, "predict", None)):
        raise ValueError(
            f"on_alarm must be a name or one policy with a predict() that all environments share, got "
            f"{short_repr(policy)}"
        )
    if isinstance(policy, Reflex) and not (isinstance(policy, Hold) and policy.explicit):
        raise ValueError(f"one {type(policy).__name__} cannot act in several environments: give its name instead")
    shared: Policy = policy
    return shared
