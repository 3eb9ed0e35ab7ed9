"""Watches many environments of one ``gym.make_vec`` at once, and lets a reflex act in those that are in alarm."""

from __future__ import annotations

from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.vector import AutoresetMode, VectorEnv, VectorWrapper
from gymnasium.vector.utils import iterate
from numpy.typing import NDArray

from asm_gym.monitors import Monitor, Surprise
from asm_gym.policies.base import Policy
from asm_gym.policies.reflexes import Hold
from asm_gym.wrappers.arbitration import NOTHING, Arbiter, Verdict
from asm_gym.wrappers.batches import choose, final, members, replace
from asm_gym.wrappers.recording import StreamSource
from asm_gym.wrappers.safety import check_expectation, make_fallback, make_patience, make_reflex

Mask = NDArray[np.bool_]


class VectorNeuralASMSafety(VectorWrapper):
    """``NeuralASMSafety`` for n environments side by side, with one batched ``observe`` for all of them.

    Arguments and reports are those of ``NeuralASMSafety``: ``info["asm"]`` holds arrays whose first axis is n, and
    ``info["cost"]`` is (n,). Where an episode has just begun, surprise is 0 and ``executed_action`` NaN. Under
    ``AutoresetMode.SAME_STEP`` the last step of an episode is reported in ``info["final_info"]``.

    An episode that the wrapper itself ends begins anew as any other does. Under ``AutoresetMode.NEXT_STEP`` its
    environment, which cannot know, takes one more step before that, which nobody sees.

    Args:
        env: of ``gym.make_vec``; where ``info`` has no ``"stream"``, observation and action are the stream.
        monitor: a fitted and calibrated monitor.
        on_alarm: as in ``NeuralASMSafety``; a policy of yours is shared, and must keep what it knows in its state.
        release_after, release_below, max_override, try_after, truncate: as in ``NeuralASMSafety``.

    Raises:
        TypeError: ``env`` is no vector environment, cannot be asked for what its members are, or takes no Box actions.
        ValueError: an unknown ``on_alarm``, or a monitor fitted for another stream (the message names the channels).
        RuntimeError: the monitor is not calibrated.
    """

    def __init__(
        self,
        env: VectorEnv[Any, Any, Any],
        monitor: Monitor,
        on_alarm: str | Policy = "hold",
        *,
        release_after: int = 10,
        release_below: float = 0.8,
        max_override: int | None = None,
        try_after: int | None = None,
        truncate: bool = False,
    ) -> None:
        super().__init__(env)
        if not isinstance(env.single_action_space, gym.spaces.Box):
            raise TypeError(f"VectorNeuralASMSafety needs a Box action space, got {env.single_action_space}")
        if isinstance(on_alarm, Hold) and type(on_alarm) is not Hold:
            raise ValueError(f"one {type(on_alarm).__name__} cannot act in several environments: give its name instead")
        self._mode = AutoresetMode(env.metadata.get("autoreset_mode", AutoresetMode.NEXT_STEP))
        each = members(env)
        self._own_stream = each[0].has_wrapper_attr("stream_spec")
        for member in each:
            source = StreamSource(member)
            if source.rows_per_step > 1:
                raise ValueError("many environments are watched at their control rate: make them without stream_freq")
            monitor.spec.require(source.spec, "the monitor")
        self.monitor, self.threshold = monitor, monitor.threshold
        self._ends_truncated = truncate
        self._terminates = on_alarm == "terminate"
        limits = release_after, release_below, max_override, try_after
        self._arbiters = [self._arbiter(on_alarm, member, limits) for member in each]
        self._ended: Mask | None = None
        self._forced = np.zeros(env.num_envs, bool)  # ended by this wrapper, which the environment does not know yet

    def _arbiter(self, on_alarm: str | Policy, env: Any, limits: tuple[Any, ...]) -> Arbiter:
        reflex = make_reflex(on_alarm, env)
        self._recalls = check_expectation(reflex, self.monitor)
        return Arbiter(reflex, self.threshold, make_patience(reflex, env, *limits), make_fallback(env))

    def reset(self, *, seed: Any = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        n = self.num_envs
        begun = np.array((options or {}).get("reset_mask", np.ones(n, bool)))
        # A copy: vector environments take the mask out of the options they are given.
        self._observations, infos = self.env.reset(seed=seed, options=dict(options) if options else options)
        if self._ended is None:
            if not begun.all():
                raise gym.error.ResetNeeded("the first reset() must be of all environments")
            self._ended, self._state = np.zeros(n, bool), self.monitor.initial_state(batch=n)
        self._begin(begun)
        self._report(infos, self._unsurprised(), self._no_actions(), None, begun)
        return self._observations, infos

    def step(self, actions: Any) -> tuple[Any, NDArray[Any], Mask, Mask, dict[str, Any]]:
        if self._ended is None or (self._mode == AutoresetMode.DISABLED and self._ended.any()):
            raise gym.error.ResetNeeded("call reset() before step(): an environment's episode is not running")
        begun = self._ended.copy()  # those that begin an episode in this step; none of them under SAME_STEP
        executed = self._executed(actions)
        observations, rewards, terminated, truncated, infos = self.env.step(executed)
        if self._forced.any():
            forced = self._forced
            observations, fresh = self.env.reset(options={"reset_mask": forced.copy()})
            infos = replace(infos, fresh, forced)
            rewards, terminated, truncated = (np.where(forced, 0, x) for x in (rewards, terminated, truncated))
        same = self._mode == AutoresetMode.SAME_STEP
        known = np.asarray(terminated | truncated, bool)
        last = known if same else np.zeros_like(known)
        surprise, verdicts = self._judge(self._rows(observations, executed, infos, last), executed, begun)
        stopped = np.array([v.gave_up or (v.alarm and self._terminates) for v in verdicts]) & ~begun
        terminated = np.asarray(terminated, bool) | (stopped & (not self._ends_truncated))
        truncated = np.asarray(truncated, bool) | (stopped & self._ends_truncated)
        self._forced = stopped & ~known
        if same and self._forced.any():
            observations, infos = self._restart(observations, infos)
        executed[begun] = np.nan
        if same:
            self._report_ends(infos, surprise, executed, verdicts, terminated | truncated)
        else:
            self._begin(begun)
            self._report(infos, surprise, executed, verdicts, np.ones(self.num_envs, bool))
            self._ended = terminated | truncated
        self._observations = observations
        return observations, rewards, terminated, truncated, infos

    def _executed(self, actions: Any) -> NDArray[np.float32]:
        """(n, A) what is done."""
        chosen = np.array(actions, dtype=np.float32)
        if any(a.overriding for a in self._arbiters):
            observed = iterate(self.observation_space, self._observations)
            for i, (arbiter, observation) in enumerate(zip(self._arbiters, observed, strict=True)):
                chosen[i] = arbiter.executed(chosen[i], observation)
        return chosen

    def _rows(
        self, observations: Any, executed: NDArray[np.float32], infos: dict[str, Any], last: Mask
    ) -> NDArray[np.float32]:
        """(n, D) what was sensed in this step; of episodes that were in their ``last`` one, before they began anew."""
        n = self.num_envs
        if self._own_stream:
            rows: NDArray[np.float32] = infos["stream"].copy()
            if last.any():
                rows[last] = infos["final_info"]["stream"][last]
            return rows
        sensed = np.array(observations, np.float32).reshape(n, -1)
        for i in np.flatnonzero(last):
            sensed[i] = np.ravel(infos["final_obs"][i])
        return np.concatenate([sensed, executed.reshape(n, -1)], axis=1)

    def _judge(
        self, rows: NDArray[np.float32], executed: NDArray[np.float32], begun: Mask
    ) -> tuple[Surprise, list[Verdict]]:
        """One ``observe`` for all, and who acts next in each; nothing counts where an episode has only ``begun``."""
        self._state, surprise = self.monitor.observe(self._state, rows)
        value = np.where(begun, 0.0, surprise.value)
        surprise = Surprise(value, np.where(begun[:, None], 0.0, surprise.attribution))
        expected: Any = [None] * len(rows)
        if self._recalls:
            expected = self.monitor.expected_action(self._state)  # type: ignore[attr-defined]
        verdicts = [
            NOTHING if begun[i] else arbiter.judge(float(value[i]), rows[i], executed[i], expected=expected[i])
            for i, arbiter in enumerate(self._arbiters)
        ]
        acted_on = np.array([v.acted_on for v in verdicts])
        if acted_on.any() and hasattr(self.monitor, "resynchronise"):
            self._state = choose(acted_on, self.monitor.resynchronise(self._state), self._state)
        return surprise, verdicts

    def _begin(self, begun: Mask) -> None:
        """New episodes."""
        assert self._ended is not None
        self._ended[begun] = self._forced[begun] = False
        self._state = choose(begun, self.monitor.initial_state(batch=self.num_envs), self._state)
        for i in np.flatnonzero(begun):
            self._arbiters[i].reset()

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
        verdicts: list[Verdict],
        ended: Mask,
    ) -> None:
        """What ended is reported in ``final_info``, and what has begun in its place in ``infos``."""
        if ended.any():
            self._report(infos["final_info"], surprise, executed, verdicts, ended)
            self._begin(ended)
            surprise = Surprise(
                np.where(ended, 0.0, surprise.value), np.where(ended[:, None], 0.0, surprise.attribution)
            )
            executed = np.where(ended[:, None], np.float32(np.nan), executed)
            verdicts = [NOTHING if e else v for e, v in zip(ended, verdicts, strict=True)]
        self._report(infos, surprise, executed, verdicts, np.ones(self.num_envs, bool))

    def _report(
        self,
        infos: dict[str, Any],
        surprise: Surprise,
        executed: NDArray[np.float32],
        verdicts: list[Verdict] | None,
        present: Mask,
    ) -> None:
        """Adds ``asm`` and ``cost`` of the environments that are ``present``, with Gymnasium's masks."""
        alarm = ~(surprise.value <= self.threshold)  # what is no number is an alarm
        verdicts = verdicts or [NOTHING] * self.num_envs
        infos["asm"] = {
            "surprise": surprise.value,
            "threshold": np.full(self.num_envs, self.threshold),
            "alarm": alarm,
            "intervened": np.array([v.intervened for v in verdicts]),
            "gave_up": np.array([v.gave_up for v in verdicts]),
            "transition": np.array([v.transition for v in verdicts]),
            "failure": np.array([arbiter.failure for arbiter in self._arbiters]),
            "executed_action": executed,
            "attribution": dict(zip(self.monitor.spec.labels, surprise.attribution.T, strict=True)),
        }
        infos["cost"] = alarm.astype(np.float64)
        infos["_asm"] = infos["_cost"] = present

    def _unsurprised(self) -> Surprise:
        return Surprise(np.zeros(self.num_envs), np.zeros((self.num_envs, self.monitor.spec.size)))

    def _no_actions(self) -> NDArray[np.float32]:
        shape = self.env.single_action_space.shape or ()
        return np.full((self.num_envs, *shape), np.nan, np.float32)
