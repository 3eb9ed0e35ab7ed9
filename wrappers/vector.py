"""Watches many environments of one ``gym.make_vec`` at once, and lets a reflex act in those that are in alarm."""

from __future__ import annotations

from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.vector import AutoresetMode, VectorEnv, VectorWrapper
from gymnasium.vector.utils import iterate
from numpy.typing import NDArray

from asm_gym.detection import AdaptiveThreshold
from asm_gym.monitors import Monitor, Surprise
from asm_gym.policies.base import Policy
from asm_gym.policies.reflexes import Hold, Reflex, nearest_to_rest
from asm_gym.protocols import HoldsItself
from asm_gym.stream_source import StreamSource
from asm_gym.validation import as_float32, check_flag
from asm_gym.wrappers.arbitration import NOTHING, Arbiter, Command, Decision
from asm_gym.wrappers.arguments import (
    body_memory,
    check_expectation,
    check_monitor,
    fitted_to,
    make_fallback,
    make_patience,
    make_reflex,
    running,
)
from asm_gym.wrappers.batches import Mask, Member, final, members, refuse_changes, replace, set_attribute
from asm_gym.wrappers.observer import Observer, joined


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
            Causes are not named here and senses not completed, so that ``"graded"`` holds as it does for the unknown.
            Nor is a band sent down: for ``spinal``, wrap each member and put those side by side in ``ThreadVectorEnv``.
        release_after, release_below, max_override, try_after, truncate: as in ``NeuralASMSafety``.
        adapt: as there; all environments share one running threshold, and an episode keeps what it began with.

    Raises:
        TypeError: ``env`` is no vector environment, cannot be asked for what its members are, or takes no Box actions.
        ValueError: an unknown ``on_alarm``, a monitor fitted for another stream (the message names the channels), or a
            wrapper inside that changes actions, where the reflex cannot know what reaches the robot.
        RuntimeError: the monitor is not calibrated.
    """

    def __init__(
        self,
        env: VectorEnv[Any, Any, Any],
        monitor: Monitor | None = None,
        on_alarm: str | Policy = "hold",
        *,
        release_after: int = 10,
        release_below: float = 0.8,
        max_override: int | None = None,
        try_after: int | None = None,
        truncate: bool = False,
        adapt: AdaptiveThreshold | None = None,
    ) -> None:
        super().__init__(env)
        if not isinstance(env.single_action_space, gym.spaces.Box):
            raise TypeError(f"VectorNeuralASMSafety needs a Box action space, got {env.single_action_space}")
        self._space = env.single_action_space
        if isinstance(on_alarm, Reflex) and not (isinstance(on_alarm, Hold) and on_alarm.explicit):
            raise ValueError(f"one {type(on_alarm).__name__} cannot act in several environments: give its name instead")
        self._mode = AutoresetMode(env.metadata.get("autoreset_mode", AutoresetMode.NEXT_STEP))
        self._members = members(env)
        if monitor is None:
            first = self._members[0]
            monitor = body_memory(first, StreamSource(first).spec)
        self._own_stream = self._members[0].has_wrapper_attr("stream_spec")
        if not self._own_stream and not isinstance(env.single_observation_space, gym.spaces.Box):
            raise TypeError(
                f"environments without a stream are watched side by side where each senses a Box, got "
                f"{env.single_observation_space}: wrap each in NeuralASMSafety, or in FlattenObservation"
            )
        for member in self._members:
            source = StreamSource(member)
            if source.rows_per_step > 1:
                raise ValueError("many environments are watched at their control rate: make them without stream_freq")
            monitor = fitted_to(monitor, source.spec)
            threshold = check_monitor(monitor, source.spec)
        self.monitor = monitor
        self._running = running(adapt, threshold)
        self._ends_truncated = check_flag("truncate", truncate)
        self._terminates = on_alarm == "terminate"
        limits = release_after, release_below, max_override, try_after
        self._arbiters = [self._arbiter(on_alarm, member, threshold, limits) for member in self._members]
        self._largest = np.full(env.num_envs, np.nan)  # surprise in each episode, while the policy acted
        self._confirmed = np.zeros(env.num_envs, bool)
        self._failures = [""] * env.num_envs
        self._ended: Mask | None = None
        self._forced = np.zeros(env.num_envs, bool)  # ended by this wrapper, which the environment does not know yet

    @property
    def threshold(self) -> NDArray[np.float64]:
        """(n,) what surprise must exceed for an alarm in the episodes that run."""
        return np.array([arbiter.threshold for arbiter in self._arbiters])

    def confirm_alarm(self, which: Mask | None = None) -> None:
        """As in ``NeuralASMSafety``, of ``which`` (n,) environments; of all by default."""
        self._confirmed |= np.ones(self.num_envs, bool) if which is None else which

    def _arbiter(self, on_alarm: str | Policy, env: Member, threshold: float, limits: tuple[Any, ...]) -> Arbiter:
        reflex = make_reflex(on_alarm, env)
        holds = type(reflex) is Hold and (reflex.explicit or isinstance(env, HoldsItself))
        if isinstance(reflex, Reflex) and not holds:
            refuse_changes(self.env)
        self._observer = Observer(self.monitor, self.num_envs, check_expectation(reflex, self.monitor))
        patience = make_patience(reflex, env, *limits)
        return Arbiter(reflex, threshold, patience, make_fallback(env), self._space)

    def reset(self, *, seed: Any = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        n = self.num_envs
        begun = np.array((options or {}).get("reset_mask", np.ones(n, bool)))
        ended, self._ended = self._ended, None  # until it has worked
        # A copy: vector environments take the mask out of the options they are given.
        self._observations, infos = self.env.reset(seed=seed, options=dict(options) if options else options)
        if ended is None:
            if not begun.all():
                raise gym.error.ResetNeeded("the first reset() must be of all environments")
            self._observer.begin()
        self._ended = np.zeros(n, bool) if ended is None else ended
        self._begin(begun)
        self._report(infos, self._nothing(), self._no_actions(), None, begun)
        return self._observations, infos

    def step(self, actions: Any) -> tuple[Any, NDArray[Any], Mask, Mask, dict[str, Any]]:
        if self._ended is None or (self._mode == AutoresetMode.DISABLED and self._ended.any()):
            raise gym.error.ResetNeeded("call reset() before step(): an environment's episode is not running")
        begun, self._ended = self._ended.copy(), None  # where anything raises, nobody knows what was done
        # Those of ``begun`` begin an episode in this step; none of them under SAME_STEP.
        executed, commands = self._command(actions, begun)
        observations, rewards, terminated, truncated, infos = self.env.step(executed)
        if self._forced.any():
            forced = self._forced
            observations, fresh = self.env.reset(options={"reset_mask": forced.copy()})
            infos = replace(infos, fresh, forced)
            rewards, terminated, truncated = (np.where(forced, 0, x) for x in (rewards, terminated, truncated))
        same = self._mode == AutoresetMode.SAME_STEP
        known = np.asarray(terminated | truncated, bool)
        last = known if same else np.zeros_like(known)
        rows, failures = self._sensed(observations, executed, infos, last)
        surprise, decisions = self._decide(rows, executed, begun, commands, failures)
        stopped = np.array([d.gave_up or (d.alarm and self._terminates) for d in decisions]) & ~begun
        terminated = np.asarray(terminated, bool) | (stopped & (not self._ends_truncated))
        truncated = np.asarray(truncated, bool) | (stopped & self._ends_truncated)
        self._forced = stopped & ~known
        if same and self._forced.any():
            observations, infos = self._restart(observations, infos)
        executed[begun] = np.nan
        self._ended = np.zeros_like(begun)
        if same:
            self._report_ends(infos, surprise, executed, decisions, terminated | truncated)
        else:
            self._begin(begun)
            self._report(infos, surprise, executed, decisions, np.ones(self.num_envs, bool))
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
        each = zip(self._arbiters, chosen, observed, begun, strict=True)
        commands = [rest if fresh else arbiter.command(action, seen) for arbiter, action, seen, fresh in each]
        able = [member for member in self._members if isinstance(member, HoldsItself)]
        if any(member.holding for member in able):
            set_attribute(self.env, "holding", [member.holding for member in able])
            for member in able:
                member.holding = False
        return np.stack([command.action for command in commands]), commands

    def _sensed(
        self, observations: Any, executed: NDArray[np.float32], infos: dict[str, Any], last: Mask
    ) -> tuple[NDArray[np.float32], list[str]]:
        """(n, D) what was sensed in this step, and what failed at that in each; of episodes that were in their ``last``
        one, before they began anew."""
        n, size = self.num_envs, self.monitor.spec.size
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
            said = infos.get("final_info", {}) if last else infos
            there = said.get("_stream")
            if "stream" not in said or not (there is None or there[i]):
                raise KeyError('info has no "stream"')
            return as_float32(said["stream"][i])
        sensed = infos["final_obs"][i] if last else observations[i]
        return as_float32(np.concatenate([np.ravel(sensed), np.ravel(executed[i])]))

    def _decide(
        self,
        rows: NDArray[np.float32],
        executed: NDArray[np.float32],
        begun: Mask,
        commands: list[Command],
        failures: list[str],
    ) -> tuple[Surprise, list[Decision]]:
        """One ``observe`` for all, and who acts next in each; nothing counts where an episode has only ``begun``."""
        refused = (c.failure if c.refused else "" for c in commands)
        known = (joined(r, f) if not b else "" for r, f, b in zip(refused, failures, begun, strict=True))
        surprise, expected, failed, _ = self._observer.observe(rows, tuple(known))
        surprise = surprise.silenced(begun)
        value = surprise.value
        decisions: list[Decision] = []
        self._failures = [""] * self.num_envs
        for i, arbiter in enumerate(self._arbiters):
            if begun[i]:
                decisions.append(NOTHING)
                continue
            if failed[i]:
                arbiter.warn(failed[i], "which counts as an alarm")
            said = None if expected is None else expected[i]
            decisions.append(arbiter.decide(float(value[i]), rows[i], executed[i], expected=said))
            if not decisions[i].intervened:
                self._largest[i] = np.fmax(self._largest[i], value[i])
            self._failures[i] = joined(commands[i].failure, failed[i], decisions[i].failure)
        forgot = self._observer.forget(np.array([d.acted_on for d in decisions]))
        for i in np.flatnonzero([d.acted_on for d in decisions]):
            self._failures[i] = joined(self._failures[i], forgot)
        return surprise, decisions

    def _begin(self, begun: Mask) -> None:
        """New episodes."""
        assert self._ended is not None
        self._ended[begun] = self._forced[begun] = False
        self._observer.begin_in(begun)
        for i in np.flatnonzero(begun):
            arbiter = self._arbiters[i]
            if self._running is not None and not np.isnan(self._largest[i]):
                confirmed = arbiter.confirmed or bool(self._confirmed[i])
                self._running.follow(float(self._largest[i]), arbiter.threshold, confirmed)
                arbiter.threshold = self._running.value
            arbiter.reset()
        self._largest[begun], self._confirmed[begun] = np.nan, False

    def _restart(self, observations: Any, infos: dict[str, Any]) -> tuple[Any, dict[str, Any]]:
        """Begins anew what this wrapper has ended, in the same step."""
        forced = self._forced
        infos = final(infos, list(iterate(self.observation_space, observations)), forced)
        observations, fresh = self.env.reset(options={"reset_mask": forced.copy()})
        return observations, replace(infos, fresh, forced, keep=("final_obs", "final_info"))

    def _report_ends(
        self,
        infos: dict[str, Any],
        surprise: Surprise,
        executed: NDArray[np.float32],
        decisions: list[Decision],
        ended: Mask,
    ) -> None:
        """What ended is reported in ``final_info``, and what has begun in its place in ``infos``."""
        if ended.any():
            self._report(infos["final_info"], surprise, executed, decisions, ended)
            self._begin(ended)
            surprise = surprise.silenced(ended)
            executed = np.where(ended[:, None], np.float32(np.nan), executed)
            decisions = [NOTHING if e else d for e, d in zip(ended, decisions, strict=True)]
        self._report(infos, surprise, executed, decisions, np.ones(self.num_envs, bool))

    def _report(
        self,
        infos: dict[str, Any],
        surprise: Surprise,
        executed: NDArray[np.float32],
        decisions: list[Decision] | None,
        present: Mask,
    ) -> None:
        """Adds ``asm`` and ``cost`` of the environments that are ``present``, with Gymnasium's masks."""
        threshold = self.threshold
        alarm = surprise.value > threshold
        decisions = decisions or [NOTHING] * self.num_envs
        intervened = np.array([d.intervened for d in decisions])
        body, skill = surprise.parts
        infos["asm"] = {
            "surprise": surprise.value,
            "surprise_body": body,
            "surprise_skill": skill,
            "threshold": threshold,
            "alarm": alarm,
            "intervened": intervened,
            "gave_up": np.array([d.gave_up for d in decisions]),
            "transition": np.array([d.transition for d in decisions]),
            "failure": np.where([d is NOTHING for d in decisions], "", self._failures),
            "executed_action": executed,
            "attribution": dict(zip(self.monitor.spec.labels, surprise.attribution.T, strict=True)),
        }
        if self._running is not None:
            both = {"ceiling": self._running.ceiling, "level": self._running.level}
            infos["asm"] |= {name: np.full(self.num_envs, value) for name, value in both.items()}
        flat = {"asm_surprise": surprise.value, "asm_alarm": alarm, "asm_intervened": intervened}
        infos.update(flat, cost=alarm.astype(np.float64))
        infos.update({f"_{key}": present for key in ("asm", "cost", *flat)})

    def _nothing(self) -> Surprise:
        return Surprise(np.zeros(self.num_envs), np.zeros((self.num_envs, self.monitor.spec.size)))

    def _no_actions(self) -> NDArray[np.float32]:
        shape = self.env.single_action_space.shape or ()
        return np.full((self.num_envs, *shape), np.nan, np.float32)
