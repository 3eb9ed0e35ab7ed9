"""Guard many environments of one ``gym.make_vec`` at once."""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from typing import Any, Literal

import gymnasium as gym
import numpy as np
from gymnasium.vector import AutoresetMode, VectorEnv, VectorWrapper
from gymnasium.vector.utils import iterate
from numpy.typing import NDArray

from asm_gym.data.action_meaning import ActionMeans
from asm_gym.detection import AdaptiveThreshold
from asm_gym.detection.contact_limits import ContactLimits
from asm_gym.guard.options import GuardOptions, OnAlarm
from asm_gym.guard.report import LazyInfo, RowReport, side_by_side
from asm_gym.monitors import Monitor
from asm_gym.spec import StreamSpec
from asm_gym.stream_source import refuse_running_statistics
from asm_gym.validation import as_float32
from asm_gym.wrappers.capabilities import control_period_of
from asm_gym.wrappers.env_attributes import EnvAttributes, askable
from asm_gym.wrappers.guarding import Guarding, as_action, body_memory, felt_by, sensed_row

Mask = NDArray[np.bool_]


class VectorNeuralASMSafety(Guarding, VectorWrapper):
    """Guard the n members of a vector environment, with one batched ``observe`` for all of them.

    Other arguments and reports are those of ``NeuralASMSafety``. The arrays in ``info["asm"]`` have a first axis of
    length n, and ``info["cost"]``, ``info["asm_surprise"]``, ``info["asm_alarm"]``, ``info["asm_intervened"]`` and,
    after a step, ``info["overridden"]`` have the shape (n,). If the monitor raises, all environments are in alarm. In
    the first step of an episode surprise is 0 and ``executed_action`` NaN.

    Args:
        env: from ``gym.make_vec``, with ``AutoresetMode.NEXT_STEP`` or ``DISABLED``. Without ``info["stream"]``,
            observation and action form the stream.
        on_alarm: a name as in ``NeuralASMSafety``, or one policy for all members that keeps its memory in its state.
        adaptive_threshold: as in ``NeuralASMSafety``; all environments share one running threshold, and an episode
            keeps the threshold that it began with.

    Raises:
        TypeError: ``env`` is no vector environment, its members cannot be inspected, or it takes no Box actions.
        ValueError: as ``NeuralASMSafety``, or another autoreset mode.
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
        max_override: int | None = None,
        try_after: int | None = None,
        truncate: bool = False,
        adaptive_threshold: AdaptiveThreshold | None = None,
        responses: Mapping[str, str] | None = None,
        contact_limits: ContactLimits | Literal["memory"] | None = "memory",
        action_means: ActionMeans | None = None,
    ) -> None:
        super().__init__(env)
        if not isinstance(env.single_action_space, gym.spaces.Box):
            raise TypeError(f"VectorNeuralASMSafety needs a Box action space, got {env.single_action_space}")
        refuse_running_statistics(env, "VectorNeuralASMSafety")
        options = on_alarm, release_after, max_override, try_after, truncate
        self._options = GuardOptions(*options, responses, contact_limits, adaptive_threshold, action_means=action_means)
        mode = AutoresetMode(env.metadata.get("autoreset_mode", AutoresetMode.NEXT_STEP))
        if mode == AutoresetMode.SAME_STEP:
            raise ValueError(
                "VectorNeuralASMSafety needs AutoresetMode.NEXT_STEP or DISABLED, got SAME_STEP: make the environments "
                "without it, or wrap each in NeuralASMSafety"
            )
        self._resets_itself = mode == AutoresetMode.NEXT_STEP
        self._members = askable(env)
        self._spec, self._own_stream = self._stream()
        self._watch_with(body_memory(env, self._spec) if monitor is None else monitor)
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
                    f"environments without a stream must have Box observations to be watched in a vector, got "
                    f"{env.single_observation_space}: wrap each in NeuralASMSafety, or in FlattenObservation"
                )
            spaces = env.single_observation_space, env.single_action_space
            dt = control_period_of(EnvAttributes(env))
            return StreamSpec.from_spaces(*spaces, dt), False
        first, *others = self._members.call("get_wrapper_attr", "stream_spec")
        for other in others:
            first.require(other, "the first environment")
        if round(EnvAttributes(env).first("dt", first.dt) / first.dt) > 1:
            raise ValueError("a vector is watched at its control rate: make the environments without stream_freq")
        return first, True

    @property
    def threshold(self) -> NDArray[np.float64]:
        """(n,) surprise above which a row is an alarm in the running episodes."""
        return self._engine.threshold.copy()

    def confirm_alarm(self, which: Mask | None = None) -> None:
        """Confirm the alarms of the environments ``which`` (n,), by default of all; see ``NeuralASMSafety``."""
        self._engine.confirmed[:] |= np.ones(self.num_envs, bool) if which is None else which

    def reset(self, *, seed: Any = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        n = self.num_envs
        begun = np.array((options or {}).get("reset_mask", np.ones(n, bool)))
        ended, self._ended = self._ended, None  # until it has worked
        # A copy: vector environments take the mask out of the options they are given.
        self._observations, infos = self.env.reset(seed=seed, options=dict(options) if options else options)
        infos = dict(infos)
        if ended is None and not begun.all():
            raise gym.error.ResetNeeded("the first reset() must reset all environments")
        self._ended = np.zeros(n, bool) if ended is None else ended
        if begun.all():
            self._watch_with_next()
        nothing = self._begin(begun)
        self._report(infos, nothing, np.full(self.env.action_space.shape or (), np.nan, np.float32), begun)
        return self._observations, infos

    def step(self, actions: Any) -> tuple[Any, NDArray[Any], Mask, Mask, dict[str, Any]]:
        if self._ended is None or (not self._resets_itself and self._ended.any()):
            raise gym.error.ResetNeeded("call reset() before step(): an environment's episode is not running")
        chosen = as_float32(actions, "actions").copy()
        if chosen.shape != self.env.action_space.shape:
            raise ValueError(f"actions have the shape {self.env.action_space.shape}, got {chosen.shape}")
        begun, self._ended = self._ended.copy(), None  # where anything raises, nobody knows what was done
        executed, overridden = self._command(chosen, begun)
        told = as_action(self.env.single_action_space, executed.copy())
        observations, rewards, terminated, truncated, infos = self.env.step(told)
        infos = dict(infos)
        infos["overridden"], infos["_overridden"] = overridden | infos.get("overridden", False), np.ones_like(begun)
        if self._forced.any():
            forced = self._forced
            observations, fresh = self.env.reset(options={"reset_mask": forced.copy()})
            infos = _replaced(infos, fresh, forced)
            rewards, terminated, truncated = (np.where(forced, 0, x) for x in (rewards, terminated, truncated))
        rows, failures = self._sensed(observations, executed, infos)
        felt = felt_by(self._robots, infos, infos.get("_contact_load"))
        report = self._engine.judge(rows, executed, felt, failures, active=~begun)
        stopped = (report.gave_up | (report.ends & self._engine.ends_on_alarm)) & ~begun
        self._forced = stopped & ~np.asarray(terminated | truncated, bool)
        terminated = np.asarray(terminated, bool) | (stopped & (not self._options.truncate))
        truncated = np.asarray(truncated, bool) | (stopped & self._options.truncate)
        self._observations = self._repaired(observations, infos, ~begun)
        executed[begun] = np.nan
        self._ended = np.zeros_like(begun)
        self._begin(begun)
        flat = executed.reshape(len(executed), -1)
        done = self._robots.executed_in(rows, flat)
        slowed = np.array([self._robots.slowed(*pair) for pair in zip(flat, done, strict=True)])
        self._report(infos, report, done.reshape(executed.shape), np.ones(self.num_envs, bool), slowed)
        self._ended = terminated | truncated
        return self._observations, rewards, terminated, truncated, infos

    def _command(self, chosen: NDArray[np.float32], begun: Mask) -> tuple[NDArray[np.float32], Mask]:
        """Return (n, A) what is done, and (n,) where it is not what the policy wanted."""

        def seen(robot: int) -> Any:
            return list(iterate(self.observation_space, self._observations))[robot]

        self._limit_contact()
        command = self._engine.act(chosen.reshape(len(chosen), -1), seen, idle=begun)
        brakes = bool(command.brakes.any())
        if brakes or self._holding:
            self._members.set_attr("holding", command.brakes.tolist())
        self._holding = brakes
        return command.actions.reshape(chosen.shape), command.overridden.copy()

    def _sensed(
        self, observations: Any, executed: NDArray[np.float32], infos: dict[str, Any]
    ) -> tuple[NDArray[np.float32], dict[int, str]]:
        """Return (n, D) what was sensed in this step, and what failed at that by environment."""
        n, size = self.num_envs, self._spec.size
        stream: Any = infos.get("stream")
        there = np.asarray(infos.get("_stream", np.ones(n, bool)))
        if self._own_stream and there.all() and np.shape(stream) == (n, size):
            return np.array(as_float32(stream)), {}

        def row(i: int) -> NDArray[np.float32]:
            if not self._own_stream:
                return np.concatenate([np.ravel(observations[i]), np.ravel(executed[i])])
            if stream is None or not there[i]:
                raise KeyError('info has no "stream"')
            return stream[i]

        rows, said = zip(*(sensed_row(partial(row, i), size) for i in range(n)), strict=True)
        return np.stack(rows), {i: failure for i, failure in enumerate(said) if failure}

    def _repaired(self, observations: Any, infos: dict[str, Any], where: Mask) -> Any:
        """Return the observations, and set the streams, with what is completed in the environments of ``where``."""
        for i, (row, missing) in self._engine.repaired.items():
            if not where[i] or self._observation_map is None:
                continue
            seen = list(iterate(self.observation_space, observations))[i]
            observations = _with(observations, i, self._observation_map.repaired(seen, row, missing))
            if "stream" in infos:
                infos["stream"] = _with(infos["stream"], i, row)
        return observations

    def _begin(self, begun: Mask) -> RowReport:
        """Begin new episodes, which have forgotten their contact limits."""
        assert self._ended is not None
        self._ended[begun] = self._forced[begun] = False
        self._alarms[begun] = 0
        if not begun.any():
            return self._engine.nothing()
        nothing = self._engine.begin(begun)
        self._limit_contact(anew=True)
        return nothing

    def _report(
        self,
        infos: dict[str, Any],
        report: RowReport,
        executed: NDArray[np.float32],
        present: Mask,
        slowed: NDArray[np.float64] | None = None,
    ) -> None:
        """Add ``asm`` and ``cost`` of the environments that are ``present``, with Gymnasium's masks."""
        alarm = report.alarm | np.asarray(infos.get("asm_alarm", False), bool)  # of guards inside
        self._alarms += alarm
        found: dict[str, Any] = {
            "asm_surprise": report.surprise.value,
            "asm_alarm": alarm,
            "asm_intervened": report.intervened | np.asarray(infos.get("asm_intervened", False), bool),
            "cost": alarm.astype(np.float64),
            "cost_sum": self._alarms.astype(np.float64),
        }
        slowed = np.zeros(self.num_envs) if slowed is None else slowed
        asm: dict[str, Any] = {"executed_action": executed.copy(), "alarms": self._alarms.copy(), "slowed": slowed}
        if self._engine.running is not None:
            n, running = self.num_envs, self._engine.running
            asm |= {"ceiling": np.full(n, running.ceiling), "level": np.full(n, running.level)}
        found["asm"] = LazyInfo(lambda: side_by_side(report, self._spec) | asm)
        infos.update(found | {f"_{key}": present for key in found})


def _with(batch: Any, i: int, value: Any) -> Any:
    """Return a copy of a batch, an array or a dict of such, with ``value`` at ``i``."""
    if isinstance(batch, dict):
        return {key: _with(part, i, value[key]) for key, part in batch.items()}
    changed = np.array(batch)
    changed[i] = value
    return changed


def _replaced(infos: dict[str, Any], by: dict[str, Any], mask: Mask) -> dict[str, Any]:
    """Return infos in which the environments of ``mask`` (n,) have what ``by`` says of them, and nothing else."""
    merged: dict[str, Any] = {}
    for key in infos.keys() | by.keys():
        old, new = infos.get(key), by.get(key)
        if isinstance(old, dict) or isinstance(new, dict):
            merged[key] = _replaced(old or {}, new or {}, mask)
            continue
        like: Any = new if old is None else old
        blank = np.full(like.shape, None, object) if like.dtype == object else np.zeros_like(like)
        old, new = (blank if part is None else part for part in (old, new))
        merged[key] = np.where(mask.reshape(-1, *[1] * (like.ndim - 1)), new, old)
    return merged
