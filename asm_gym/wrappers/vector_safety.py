"""Guard many environments of one ``gym.make_vec`` at once."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from copy import copy
from dataclasses import replace
from functools import partial
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.vector import AutoresetMode, VectorEnv, VectorWrapper
from gymnasium.vector.utils import iterate
from numpy.typing import NDArray

from asm_gym.control_period import PeriodCheck, control_period
from asm_gym.exceptions import UnsupportedEnvironment
from asm_gym.guard.adapter import SensedRows
from asm_gym.guard.commander import Command
from asm_gym.guard.robot_table import Floats32, Mask
from asm_gym.guard.step_info import LazyInfo, RowReport, side_by_side
from asm_gym.monitors import Monitor
from asm_gym.spec import StreamSpec
from asm_gym.stream_source import refuse_running_statistics
from asm_gym.validation import as_float32
from asm_gym.wrappers.env_attributes import EnvAttributes, askable
from asm_gym.wrappers.guarding import Guarding, as_action, load_felt, sensed_row


class VectorNeuralASMSafety(Guarding, VectorWrapper):
    """Guard the n members of a vector environment, with one batched ``observe`` for all of them.

    Other arguments and reports are those of ``NeuralASMSafety``. The arrays in ``info["asm"]`` have a first axis of
    length n, and ``info["cost"]``, ``info["asm_surprise"]``, ``info["asm_alarm"]``, ``info["asm_intervened"]``,
    ``info["asm_steps"]`` and, after a step, ``info["overridden"]`` have the shape (n,). If the monitor raises, all
    environments are in alarm. In the first step of an episode surprise is 0 and ``executed_action`` NaN.

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

    def _wrap(self, env: VectorEnv[Any, Any, Any], monitor: Monitor | None) -> None:
        VectorWrapper.__init__(self, env)
        if not isinstance(env.single_action_space, gym.spaces.Box):
            raise TypeError(
                f"VectorNeuralASMSafety needs a Box action space, got {env.single_action_space}"
            )
        refuse_running_statistics(env, "VectorNeuralASMSafety")
        mode = AutoresetMode(env.metadata.get("autoreset_mode", AutoresetMode.NEXT_STEP))
        if mode == AutoresetMode.SAME_STEP:
            raise UnsupportedEnvironment(
                "VectorNeuralASMSafety needs AutoresetMode.NEXT_STEP or DISABLED, got SAME_STEP: "
                "make the environments without it, or wrap each in NeuralASMSafety"
            )
        self._resets_itself = mode == AutoresetMode.NEXT_STEP
        self._members = askable(env)
        self._has_stream = all(self._members.call("has_wrapper_attr", "stream_spec"))
        self._period = control_period(env)
        members = getattr(self._members, "envs", [None])  # None: they are in worker processes
        self._first_step = PeriodCheck(members[0], self._period)
        if self._has_stream:
            self._spec = self._stream_spec()
        else:
            self._spec = self._spec_of_spaces()
        self._watch_with(monitor)
        self._holding = False  # members were told to hold in the last step
        if self._facts.brakes:
            # Who is held is held in all steps that wrappers in between make of one.
            self._members.set_attr("keeps_holding", [True] * env.num_envs)
        self._steps = np.zeros(env.num_envs, np.int64)
        self._alarms = np.zeros(env.num_envs, np.int64)
        self._ended: Mask | None = None  # (n,) None before the first reset, and where a step failed
        # ended by this wrapper, which the environment does not know yet
        self._forced = np.zeros(env.num_envs, bool)

    def _stream_spec(self) -> StreamSpec:
        """Return the spec of the members' own streams."""
        first, *others = self._members.call("get_wrapper_attr", "stream_spec")
        for other in others:
            first.require(other, "the first environment")
        if round(EnvAttributes(self.env).first("dt", first.dt) / first.dt) > 1:
            raise ValueError(
                "a vector is watched at its control rate: make the environments without stream_freq"
            )
        return replace(first, dt=self._period)

    def _spec_of_spaces(self) -> StreamSpec:
        """Return the spec of streams that observations and actions form."""
        env = self.env
        if not isinstance(env.single_observation_space, gym.spaces.Box):
            raise TypeError(
                "environments without a stream must have Box observations to be watched in a "
                f"vector, got {env.single_observation_space}: wrap each in NeuralASMSafety, or in "
                "FlattenObservation"
            )
        return StreamSpec.from_spaces(
            env.single_observation_space, env.single_action_space, self._period
        )

    @property
    def threshold(self) -> NDArray[np.float64]:
        """(n,) surprise above which a row is an alarm in the running episodes."""
        return self.guard.threshold

    @property
    def guarded_action_space(self) -> gym.Space[Any]:
        """The actions that this guard takes of each member, whatever wrappers outside make of them."""
        return self.single_action_space

    def confirm_alarm(self, which: Mask | None = None) -> None:
        """Confirm the alarms of the environments ``which`` (n,), by default of all; see ``NeuralASMSafety``."""
        if which is None:
            which = np.ones(self.num_envs, bool)
        self.guard.confirm(which)

    def reset(
        self, *, seed: Any = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        begun = np.ones(self.num_envs, bool)
        if options is not None and "reset_mask" in options:
            begun = np.array(options["reset_mask"])
        ended = self._ended
        if ended is None:
            ended = np.zeros(self.num_envs, bool)
            if not begun.all():
                raise gym.error.ResetNeeded("the first reset() must reset all environments")
        self._ended = None  # until it has worked
        # A copy: vector environments take the mask out of the options they are given.
        self._observations, infos = self.env.reset(seed=seed, options=copy(options))
        self._ended = ended
        if begun.all():
            self._take_over_changed_monitor()
        infos = dict(infos)
        infos["overridden"] = np.zeros(self.num_envs, bool) | infos.get("overridden", False)
        infos["_overridden"] = begun
        self._present = begun
        self._commanded = np.full(self._flat_shape, np.nan, np.float32)
        self._executed = self._commanded
        self.report_step([self._begin(begun)], infos)
        return self._observations, infos

    def step(self, actions: Any) -> tuple[Any, NDArray[Any], Mask, Mask, dict[str, Any]]:
        if self._ended is None or (not self._resets_itself and self._ended.any()):
            raise gym.error.ResetNeeded(
                "call reset() before step(): an environment's episode is not running"
            )
        proposed = as_float32(actions, "actions").copy()
        if proposed.shape != self.env.action_space.shape:
            raise ValueError(
                f"actions have the shape {self.env.action_space.shape}, got {proposed.shape}"
            )
        # their members begin an episode in this step, and take no action
        begun = np.array(self._ended)
        running = ~begun
        self._ended = None  # where anything raises, nobody knows what was done

        self._limit_contact()
        command = self.guard.act(proposed.reshape(self._flat_shape), self._observed_by, idle=begun)
        observations, rewards, terminated, truncated, infos = self._step_members(command, begun)
        sensed = self.sense_rows((observations, infos))
        report = self.guard.judge(sensed, self._commanded, active=running)
        stopped = self._stopped([report]) & running
        self._forced = stopped & ~(terminated | truncated)
        if self._options.truncate:
            truncated = truncated | stopped
        else:
            terminated = terminated | stopped

        self._observations = self._repaired(observations, infos, running)
        self._commanded[begun] = np.nan
        self._executed = self._facts.executed_in(sensed.rows, self._commanded)
        self._ended = np.zeros_like(begun)
        self._steps += 1
        self._begin(begun)
        self._present = np.ones_like(begun)
        self.report_step([report], infos)
        self._ended = terminated | truncated
        return self._observations, rewards, terminated, truncated, infos

    # ------------------------------------------------------------------ the adapter's three methods

    def sense_rows(self, given: tuple[Any, dict[str, Any]]) -> SensedRows:
        """Return what was sensed in a step, by the observations and infos of the members."""
        observations, infos = given
        size = self._spec.size
        load = load_felt(self._facts, infos, infos.get("_contact_load"))
        stream: Any = infos.get("stream")
        everyone = np.ones(self.num_envs, bool)
        present = np.asarray(infos.get("_stream", everyone))
        shape = self.num_envs, size
        if self._has_stream and present.all() and np.shape(stream) == shape:
            rows = self._view.rows(np.asarray(as_float32(stream)))
            return SensedRows(rows, load, infos=infos)

        def read(member: int) -> Floats32:
            if not self._has_stream:
                sensed = np.ravel(observations[member])
                return np.concatenate([sensed, self._commanded[member]])
            if stream is None or not present[member]:
                raise KeyError('info has no "stream"')
            return stream[member]

        rows = np.empty((self.num_envs, size), np.float32)
        failures: dict[int, str] = {}
        for member in range(self.num_envs):
            rows[member], failure = sensed_row(partial(read, member), size)
            if failure:
                failures[member] = failure
        return SensedRows(self._view.rows(rows), load, failures, infos)

    def send_command(self, command: Command) -> tuple[Any, ...]:
        """Step the members as the guard decided; return what that gives."""
        brakes = bool(command.brakes.any())
        if brakes or self._holding:
            self._members.set_attr("holding", command.brakes.tolist())
        self._holding = brakes
        self._commanded = command.actions
        actions = command.actions.copy().reshape(self.env.action_space.shape or ())
        actions = as_action(self.env.single_action_space, actions)
        observations, rewards, terminated, truncated, infos = self.env.step(actions)
        ends = np.asarray(terminated, bool), np.asarray(truncated, bool)
        return observations, rewards, *ends, infos

    def _write(self, target: dict[str, Any], asm: LazyInfo, numbers: dict[str, Any]) -> None:
        asm["executed_action"] = self._executed.reshape(self.env.action_space.shape or ()).copy()
        asm["slowed"] = self._facts.slowed(self._commanded, self._executed)
        for name, values in {"asm": asm, **numbers}.items():
            target[name] = values
            target[f"_{name}"] = self._present  # Gymnasium's mask of the members that it tells of

    # ------------------------------------------------------------------ parts of a step

    @property
    def _flat_shape(self) -> tuple[int, int]:
        """(n, A) of the actions."""
        return self.num_envs, self._facts.rest.size

    def _observed_by(self, member: int) -> Any:
        """Return the last observation of a member."""
        return list(iterate(self.observation_space, self._observations))[member]

    def _step_members(self, command: Command, begun: Mask) -> tuple[Any, ...]:
        """Step the members, and reset those whose episodes this wrapper has ended; return what that gives."""
        self._first_step.begin()
        observations, rewards, terminated, truncated, infos = self.send_command(command)
        self._first_step.end(bool(begun[0] or terminated[0] or truncated[0]))
        self._check_period(self._first_step.period)
        infos = dict(infos)
        infos["overridden"] = command.overridden | infos.get("overridden", False)
        infos["_overridden"] = np.ones_like(begun)
        forced = self._forced
        if forced.any():
            observations, fresh = self.env.reset(options={"reset_mask": forced.copy()})
            infos = _replaced(infos, fresh, forced)
            rewards = np.where(forced, 0, rewards)
            terminated = terminated & ~forced
            truncated = truncated & ~forced
        return observations, rewards, terminated, truncated, infos

    def _repaired(self, observations: Any, infos: dict[str, Any], running: Mask) -> Any:
        """Return the observations, and set the streams, with what is completed of the ``running`` members."""
        for member, (row, missing) in self.guard.repaired.items():
            if not running[member] or self._observation_map is None:
                continue
            observation = list(iterate(self.observation_space, observations))[member]
            repaired = self._observation_map.repaired(observation, row, missing)
            observations = _with(observations, member, repaired)
            if "stream" in infos:
                written = self._view.written_back(row, infos["stream"][member])
                infos["stream"] = _with(infos["stream"], member, written)
        return observations

    def _begin(self, begun: Mask) -> RowReport:
        """Begin new episodes of members, which have forgotten their contact limits."""
        assert self._ended is not None
        self._ended[begun] = False
        self._forced[begun] = False
        self._steps[begun] = 0
        self._alarms[begun] = 0
        if not begun.any():
            return self.guard.empty_report()
        report = self.guard.begin(begun)
        self._limit_contact(anew=True)
        return report

    def _describe(self, reports: Sequence[RowReport]) -> Callable[[], dict[str, Any]]:
        spec = self.monitor.spec
        step: dict[str, Any] = {"alarms": self._alarms.copy()}
        for name, value in self._running_threshold().items():
            step[name] = np.full(self.num_envs, value)
        return lambda: side_by_side(reports[-1], spec, **step)


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
    for name in infos.keys() | by.keys():
        old: Any = infos.get(name)
        new: Any = by.get(name)
        if isinstance(old, dict) or isinstance(new, dict):
            merged[name] = _replaced(old or {}, new or {}, mask)
            continue
        if old is None:
            old = _blank(new)
        if new is None:
            new = _blank(old)
        along_the_first_axis = mask.reshape(-1, *[1] * (old.ndim - 1))
        merged[name] = np.where(along_the_first_axis, new, old)
    return merged


def _blank(values: NDArray[Any]) -> NDArray[Any]:
    """Return an array like ``values`` that says nothing."""
    if values.dtype == object:
        return np.full(values.shape, None, object)
    return np.zeros_like(values)
