"""Watches many environments of one ``gym.make_vec`` at once, and lets a reflex act in those that are in alarm."""

from __future__ import annotations

from collections.abc import Mapping
from itertools import zip_longest
from typing import Any, Literal

import gymnasium as gym
import numpy as np
from gymnasium.vector import AutoresetMode, VectorEnv, VectorWrapper
from gymnasium.vector.utils import iterate
from numpy.typing import NDArray

from asm_gym.contact_limits import ContactLimits
from asm_gym.detection import AdaptiveThreshold
from asm_gym.monitors import Monitor, Surprise
from asm_gym.policies.reflexes import Graded, Hold, Reflex, nearest_to_rest
from asm_gym.protocols import HoldsItself, LimitsContact
from asm_gym.spec import StreamSpec
from asm_gym.stream_source import StreamSource
from asm_gym.validation import as_float32, check_choice
from asm_gym.wrappers.arbiter import Command
from asm_gym.wrappers.factory import LOG, OnAlarm, body_memory, check_monitor, fitted_parts, fitted_to, running
from asm_gym.wrappers.guard import Guard, GuardOptions, nothing
from asm_gym.wrappers.lazily import Lazily
from asm_gym.wrappers.observer import Observer, joined
from asm_gym.wrappers.step_report import INFO, STALE, RowReport, ends, report
from asm_gym.wrappers.vector_utils import (
    Mask,
    Member,
    final,
    members,
    put,
    refuse_changes,
    refuse_running_statistics,
    replace,
    said_by,
    set_attribute,
    stacked,
)

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
        on_alarm: as in ``NeuralASMSafety``; a policy of yours is shared, and must keep what it knows in its state.
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
        self._space = env.single_action_space
        if isinstance(on_alarm, Reflex) and not (isinstance(on_alarm, Hold) and on_alarm.explicit):
            raise ValueError(f"one {type(on_alarm).__name__} cannot act in several environments: give its name instead")
        refuse_running_statistics(env)
        check_choice("info", info, INFO)
        self._full = info == "full"
        self._options = GuardOptions(
            on_alarm, release_after, release_below, max_override, try_after, truncate, responses, contact_limits
        )
        self._adaptive = adaptive_threshold
        self._mode = AutoresetMode(env.metadata.get("autoreset_mode", AutoresetMode.NEXT_STEP))
        self._members = members(env)
        first = self._members[0]
        self._own_stream = first.has_wrapper_attr("stream_spec")
        if not self._own_stream and not isinstance(env.single_observation_space, gym.spaces.Box):
            raise TypeError(
                f"environments without a stream are watched side by side where each senses a Box, got "
                f"{env.single_observation_space}: wrap each in NeuralASMSafety, or in FlattenObservation"
            )
        self._watch_with(body_memory(first, StreamSource(first).spec) if monitor is None else monitor)
        # Asked once: whether an object has what a protocol asks for takes longer than a row of the memory.
        self._limited = [member for member in self._members if isinstance(member, LimitsContact)]
        self._holders = [member for member in self._members if isinstance(member, HoldsItself)]
        self._told: list[ContactLimits | None] = []
        self._holding = [False] * env.num_envs
        if self._holders:
            # Who is held is held in all steps that wrappers in between make of one.
            set_attribute(env, "keeps_holding", [True] * env.num_envs)
        self._confirmed = np.zeros(env.num_envs, bool)
        self._alarms = np.zeros(env.num_envs, np.int64)
        self._ended: Mask | None = None
        self._forced = np.zeros(env.num_envs, bool)  # ended by this wrapper, which the environment does not know yet

    def _watch_with(self, monitor: Monitor) -> None:
        """Takes up a monitor, and all that depends on it."""
        for member in self._members:
            source = StreamSource(member)
            if source.rows_per_step > 1:
                raise ValueError("many environments are watched at their control rate: make them without stream_freq")
            monitor = fitted_to(monitor, source.spec)
            threshold = check_monitor(monitor, source.spec)
        self._running = running(self._adaptive, threshold)
        self._guards = [self._guard(member, monitor, threshold) for member in self._members]
        self._observer = Observer(monitor, self.num_envs, any(guard.recalls for guard in self._guards))
        self._monitor = self._next = monitor
        self._parts, self._promised = fitted_parts(monitor), threshold

    def _guard(self, env: Member, monitor: Monitor, threshold: float) -> Guard:
        guard = Guard(env, monitor, self._options, threshold, self._space)
        reflex = guard.reflex
        holds = type(reflex) is Hold and (reflex.explicit or isinstance(env, HoldsItself))
        graded = isinstance(reflex, Graded) and isinstance(env, HoldsItself)
        if isinstance(reflex, Reflex) and not (holds or graded):
            refuse_changes(self.env)
        return guard

    @property
    def monitor(self) -> Monitor:
        """As in ``NeuralASMSafety``; what has changed is taken over at the next ``reset`` of all environments."""
        return self._monitor

    @monitor.setter
    def monitor(self, monitor: Monitor) -> None:
        spec = self._monitor.spec
        check_monitor(fitted_to(monitor, spec), spec)
        self._next = monitor

    @property
    def threshold(self) -> NDArray[np.float64]:
        """(n,) what surprise must exceed for an alarm in the episodes that run."""
        return np.array([guard.arbiter.threshold for guard in self._guards])

    def confirm_alarm(self, which: Mask | None = None) -> None:
        """As in ``NeuralASMSafety``, of ``which`` (n,) environments; of all by default."""
        self._confirmed |= np.ones(self.num_envs, bool) if which is None else which

    def reset(self, *, seed: Any = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        n = self.num_envs
        begun = np.array((options or {}).get("reset_mask", np.ones(n, bool)))
        ended, self._ended = self._ended, None  # until it has worked
        # A copy: vector environments take the mask out of the options they are given.
        self._observations, infos = self.env.reset(seed=seed, options=dict(options) if options else options)
        infos = dict(infos)
        if ended is None and not begun.all():
            raise gym.error.ResetNeeded("the first reset() must be of all environments")
        if begun.all():
            self._follow(begun)
            changed = any(a is not b for a, b in zip(fitted_parts(self._next), self._parts, strict=True))
            if changed or check_monitor(self._next, self._next.spec) != self._promised:
                LOG.info("the monitor was changed, fitted or calibrated since: it is taken over as it is now")
                self._watch_with(self._next)
            self._observer.begin()
        self._ended = np.zeros(n, bool) if ended is None else ended
        self._begin(begun)
        self._report(infos, self._nothing(), self._no_actions(), begun)
        return self._observations, infos

    def step(self, actions: Any) -> tuple[Any, NDArray[Any], Mask, Mask, dict[str, Any]]:
        if self._ended is None or (self._mode == AutoresetMode.DISABLED and self._ended.any()):
            raise gym.error.ResetNeeded("call reset() before step(): an environment's episode is not running")
        begun, self._ended = self._ended.copy(), None  # where anything raises, nobody knows what was done
        # Those of ``begun`` begin an episode in this step; none of them under SAME_STEP.
        executed, commands = self._command(actions, begun)
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
        reports = self._judge(rows, executed, begun, commands, failures, infos, last)
        stopped = np.array(
            [r.decision.gave_up or (g.ends_on_alarm and ends(r)) for r, g in zip(reports, self._guards, strict=True)]
        )
        stopped &= ~begun
        terminated = np.asarray(terminated, bool) | (stopped & (not self._options.truncate))
        truncated = np.asarray(truncated, bool) | (stopped & self._options.truncate)
        self._forced = stopped & ~known
        observations = self._repaired(observations, infos, ~begun & ~last)
        if same and self._forced.any():
            observations, infos = self._restart(observations, infos)
        executed[begun] = np.nan
        self._ended = np.zeros_like(begun)
        if same:
            self._report_ends(infos, reports, executed, terminated | truncated)
        else:
            self._begin(begun)
            self._report(infos, reports, executed, np.ones(self.num_envs, bool))
            self._ended = terminated | truncated
        self._observations = observations
        return observations, rewards, terminated, truncated, infos

    def _command(self, actions: Any, begun: Mask) -> tuple[NDArray[np.float32], list[Command]]:
        """(n, A) what is done, and how it came to that in each."""
        chosen = as_float32(actions, "actions").copy()
        if chosen.shape != self.env.action_space.shape:
            raise ValueError(f"actions have the shape {self.env.action_space.shape}, got {chosen.shape}")
        rest = Command(nearest_to_rest(self._space))  # where an episode begins, nothing is done
        observed = iterate(self.observation_space, self._observations)
        each = zip(self._guards, chosen, observed, begun, strict=True)
        commands = [rest if fresh else guard.arbiter.command(action, seen) for guard, action, seen, fresh in each]
        self._limit()
        if self._holders:  # one has what all have
            wanted = [member.holding for member in self._holders]
            if any(wanted) or any(self._holding):
                set_attribute(self.env, "holding", wanted)
            self._holding = wanted
            for member in self._holders:
                member.holding = False
        return np.stack([command.action for command in commands]), commands

    def _sensed(
        self, observations: Any, executed: NDArray[np.float32], infos: dict[str, Any], last: Mask
    ) -> tuple[NDArray[np.float32], list[str]]:
        """(n, D) what was sensed in this step, and what failed at that in each; of episodes that were in their ``last``
        one, before they began anew."""
        n, size = self.num_envs, self.monitor.spec.size
        stream: Any = infos.get("stream")
        told = infos.get("_stream", np.ones(n, bool))
        if self._own_stream and not last.any() and np.all(told) and np.shape(stream) == (n, size):
            return np.array(as_float32(stream)), [""] * n
        rows, failures = np.full((n, size), np.nan, np.float32), [""] * n
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
        """(D,) of one environment."""
        if self._own_stream:
            said = said_by(infos, i, last, ("stream",))
            if "stream" not in said:
                raise KeyError('info has no "stream"')
            return as_float32(said["stream"])
        sensed = infos["final_obs"][i] if last else observations[i]
        return as_float32(np.concatenate([np.ravel(sensed), np.ravel(executed[i])]))

    def _judge(
        self,
        rows: NDArray[np.float32],
        executed: NDArray[np.float32],
        begun: Mask,
        commands: list[Command],
        failures: list[str],
        infos: dict[str, Any],
        last: Mask,
    ) -> list[RowReport]:
        """One ``observe`` for all, and who acts next in each; nothing counts where an episode has only ``begun``."""
        everywhere = np.ones(self.num_envs, bool)
        known = [
            "" if b else joined(c.failure if c.refused else "", f)
            for c, f, b in zip(commands, failures, begun, strict=True)
        ]
        if any(a is not b for a, b in zip(fitted_parts(self._monitor), self._parts, strict=True)):
            known = [joined(f, STALE) for f in known]
        for i in np.flatnonzero(~begun):
            rows[i], known[i] = self._guards[i].read(rows[i], known[i])
        surprise, expected, failed, latency = self._observer.observe(rows, tuple(known))
        reports: list[RowReport] = []
        felt = [(name, infos[name], infos.get(f"_{name}", everywhere)) for name in FELT if name in infos]
        for i, guard in enumerate(self._guards):
            own = surprise.of(i)
            if begun[i]:
                reports.append(nothing(own.silenced(np.ones(1, bool))))
                continue
            told = said_by(infos, i, True, FELT) if last[i] else {name: v[i] for name, v, there in felt if there[i]}
            beneath = guard.substeps.came(rows[i], told)
            said = None if expected is None else expected[i]
            heard = guard.heard(own, bool(failed[i]))
            report = guard.judge(heard, rows[i], executed[i], failed[i], beneath, said, latency)
            reports.append(report._replace(failure=joined(commands[i].failure, report.failure)))
        acted = (
            np.array([r.decision.acted_on or g.forgets for r, g in zip(reports, self._guards, strict=True)]) & ~begun
        )
        if forgot := self._observer.forget(acted):
            reports = [
                r._replace(failure=joined(r.failure, forgot)) if a else r for r, a in zip(reports, acted, strict=True)
            ]
        return reports

    def _repaired(self, observations: Any, infos: dict[str, Any], where: Mask) -> Any:
        """The observations, and the streams in ``infos``, with what is completed in the environments of ``where``."""
        for i in np.flatnonzero(where):
            responder = self._guards[i].responder
            row = responder.row()
            if row is None:
                continue
            seen = list(iterate(self.observation_space, observations))[i]
            observations = put(observations, i, responder.observed(seen))
            if "stream" in infos:
                infos["stream"] = put(infos["stream"], i, row)
        return observations

    def _follow(self, begun: Mask) -> None:
        """Moves the threshold by the episodes that have ended."""
        for i in np.flatnonzero(begun):
            guard = self._guards[i]
            if self._running is not None and guard.largest is not None:
                confirmed = guard.arbiter.confirmed or bool(self._confirmed[i])
                self._running.follow(guard.largest, guard.arbiter.threshold, confirmed)
                guard.arbiter.threshold = self._running.value
            guard.largest = None
        self._confirmed[begun] = False

    def _begin(self, begun: Mask) -> None:
        """New episodes."""
        assert self._ended is not None
        self._ended[begun] = self._forced[begun] = False
        self._alarms[begun] = 0
        self._observer.begin_in(begun)
        self._follow(begun)
        for i in np.flatnonzero(begun):
            self._guards[i].begin()
        if begun.any():
            self._told = []  # a new episode has forgotten its limits

    def _limit(self) -> None:
        """Tells the environments their limits, where those have changed."""
        limits = [member.contact_limits for member in self._limited]
        if any(a is not b for a, b in zip_longest(limits, self._told)):
            set_attribute(self.env, "contact_limits", limits)
            self._told = limits

    def _restart(self, observations: Any, infos: dict[str, Any]) -> tuple[Any, dict[str, Any]]:
        """Begins anew what this wrapper has ended, in the same step."""
        forced = self._forced
        infos = final(infos, list(iterate(self.observation_space, observations)), forced)
        observations, fresh = self.env.reset(options={"reset_mask": forced.copy()})
        return observations, replace(infos, fresh, forced, keep=("final_obs", "final_info"))

    def _report_ends(
        self, infos: dict[str, Any], reports: list[RowReport], executed: NDArray[np.float32], ended: Mask
    ) -> None:
        """What ended is reported in ``final_info``, and what has begun in its place in ``infos``."""
        if ended.any():
            infos["final_info"] = dict(infos["final_info"])
            self._report(infos["final_info"], reports, executed, ended)
            self._begin(ended)
            executed = np.where(ended[:, None], np.float32(np.nan), executed)
            blank = self._nothing()
            reports = [n if e else r for n, r, e in zip(blank, reports, ended, strict=True)]
            self._alarms -= np.where(ended, 0, [r.decision.alarm for r in reports])  # counted by the next report
        self._report(infos, reports, executed, np.ones(self.num_envs, bool))

    def _report(
        self, infos: dict[str, Any], reports: list[RowReport], executed: NDArray[np.float32], present: Mask
    ) -> None:
        """Adds ``asm`` and ``cost`` of the environments that are ``present``, with Gymnasium's masks."""
        alarm = np.array([r.decision.alarm for r in reports])
        self._alarms += alarm
        now = {
            "surprise": np.array([float(r.surprise.value[0]) for r in reports]),
            "alarm": alarm,
            "intervened": np.array([r.decision.intervened for r in reports]),
        }
        same = {"executed_action": executed.copy()}
        if self._running is not None:
            both = {"ceiling": self._running.ceiling, "level": self._running.level}
            same |= {name: np.full(self.num_envs, value) for name, value in both.items()}
        said: dict[str, Any] = {f"asm_{name}": value for name, value in now.items()}
        said |= {"cost": alarm.astype(np.float64), "cost_sum": self._alarms.astype(np.float64)}
        if self._full:
            beside = [
                {"completed": s.completed, "unread": s.unread, "lost": s.lost, "alarms": int(n)}
                for s, n in zip((guard.responder for guard in self._guards), self._alarms, strict=True)
            ]
            thresholds = [guard.arbiter.threshold for guard in self._guards]
            each = self.monitor.spec, reports, thresholds, beside
            said["asm"] = Lazily(now, lambda: _side_by_side(*each) | same)
        infos.update(said | {f"_{key}": present for key in said})

    def _nothing(self) -> list[RowReport]:
        none = Surprise(np.zeros(1), np.zeros((1, self.monitor.spec.size)))
        return [nothing(none)] * self.num_envs

    def _no_actions(self) -> NDArray[np.float32]:
        shape = self.env.single_action_space.shape or ()
        return np.full((self.num_envs, *shape), np.nan, np.float32)


def _side_by_side(
    spec: StreamSpec, reports: list[RowReport], thresholds: list[float], beside: list[dict[str, Any]]
) -> dict[str, Any]:
    """What is said of each environment, in arrays."""
    each = [report([r], spec, t, None, "") | b for r, t, b in zip(reports, thresholds, beside, strict=True)]
    return {name: stacked([one[name] for one in each]) for name in each[0]}
