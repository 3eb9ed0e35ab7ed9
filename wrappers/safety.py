"""Watches a policy's every step, and takes over or stops when what the robot feels is not what it expected."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, SupportsFloat

import gymnasium as gym
import numpy as np
from gymnasium.utils import RecordConstructorArgs
from numpy.typing import NDArray

from asm_gym.monitors import Monitor, Surprise
from asm_gym.policies.base import Policy
from asm_gym.policies.reflexes import Comply, Graded, Hold, Retract
from asm_gym.wrappers.arbitration import Arbiter, Patience
from asm_gym.wrappers.stream_recorder import StreamSource

REFLEXES: dict[str, Callable[[gym.Env[Any, Any]], Policy]] = {
    "hold": Hold,
    "retract": Retract,
    "comply": Comply,
    "graded": Graded,
}
"""Reflexes by name: policies that act from the step after an alarm."""
ON_ALARM = ("monitor", *REFLEXES, "terminate")
"""Names that ``on_alarm`` takes."""


class NeuralASMSafety(gym.Wrapper[Any, Any, Any, Any], RecordConstructorArgs):
    """A safety layer around any environment with a Box action space, under any policy.

    After each step the monitor compares what was sensed with what it expected. From the step after an alarm on, a
    reflex acts in the policy's place, until surprise has stayed under ``release_below`` of the threshold for
    ``release_after`` steps; what has alarmed is not counted again, so that a nudge costs a pause and not the task.

    ``info["asm"]`` holds ``surprise``, ``threshold``, ``alarm`` (surprise is over the threshold now), ``intervened``
    (the reflex acted in this step), ``gave_up`` (it has acted for ``max_override`` steps, and the episode ends),
    ``executed_action``, and ``attribution``: what each number of the stream adds to the surprise. ``info["cost"]`` is
    1.0 on every step spent in alarm and 0.0 otherwise, as safe-RL libraries expect.

    Args:
        env: any Gymnasium environment; where ``info`` has no ``"stream"``, observation and action are the stream.
        monitor: a fitted and calibrated monitor.
        on_alarm: ``"monitor"`` only reports; ``"hold"`` stays and keeps the grip; ``"retract"`` goes back along the
            path; ``"comply"`` yields to what presses; ``"graded"`` stays, and yields to what keeps pressing;
            ``"terminate"`` ends the episode; any other policy acts itself.
        release_after: control steps of quiet after which control is handed back.
        release_below: share of the threshold, in (0, 1], that surprise must be under to count as quiet.
        max_override: control steps for which a reflex may act at a stretch, after which the episode ends; None for as
            many as it takes.
        truncate: an episode that is ended by an alarm is truncated rather than terminated.
        learning_rate: above 0 the monitor goes on learning from steps that do not surprise it, by its ``adapt``, which
            changes it for all who watch with it: for a robot that slowly wears.

    Raises:
        ValueError: an unknown ``on_alarm``, or a monitor fitted for another stream (the message names the channels).
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
        truncate: bool = False,
        learning_rate: float = 0.0,
    ) -> None:
        RecordConstructorArgs.__init__(
            self,
            monitor=monitor,
            on_alarm=on_alarm,
            release_after=release_after,
            release_below=release_below,
            max_override=max_override,
            truncate=truncate,
            learning_rate=learning_rate,
        )
        gym.Wrapper.__init__(self, env)
        if not isinstance(env.action_space, gym.spaces.Box):
            raise TypeError(f"NeuralASMSafety needs a Box action space, got {env.action_space}")
        patience = Patience(release_after, release_below, max_override)
        if not 0.0 <= learning_rate <= 1.0:
            raise ValueError(f"learning_rate must be in [0, 1], got {learning_rate}")
        if learning_rate > 0 and not hasattr(monitor, "adapt"):
            raise ValueError(f"{type(monitor).__name__} cannot learn on the job: learning_rate must be 0")
        self._source = StreamSource(env)
        monitor.spec.require(self._source.spec, "the monitor")
        self.monitor = monitor
        self.threshold, self.learning_rate = monitor.threshold, learning_rate
        self._ends = "truncated" if truncate else "terminated"
        self._on_alarm = on_alarm if isinstance(on_alarm, str) else "policy"
        self._arbiter = Arbiter(make_reflex(on_alarm, env), self.threshold, patience)
        self._ended = True

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        observation, info = self.env.reset(seed=seed, options=options)
        self._state = self.monitor.initial_state(batch=1)
        self._observation = observation
        self._arbiter.reset()
        self._ended = False
        none = np.zeros((1, self.monitor.spec.size))
        return observation, self._report(info, Surprise(np.zeros(1), none), None, False)

    def step(self, action: Any) -> tuple[Any, SupportsFloat, bool, bool, dict[str, Any]]:
        if self._ended:
            raise gym.error.ResetNeeded("call reset() before step(): no episode is running")
        executed = self._arbiter.executed(action, self._observation)
        observation, reward, terminated, truncated, info = self.env.step(executed)
        self._observation = observation
        row = self._source.row(observation, executed, info)
        before = self._state
        self._state, surprise = self.monitor.observe(before, row[None])
        verdict = self._arbiter.judge(float(surprise.value[0]), row, executed)
        if self.learning_rate > 0 and not verdict.intervened:
            self.monitor.adapt(before, row[None], surprise, self.learning_rate)  # type: ignore[attr-defined]
        if verdict.acted_on and hasattr(self.monitor, "resynchronise"):
            self._state = self.monitor.resynchronise(self._state)
        self._report(info, surprise, executed, verdict.intervened)["asm"]["gave_up"] = verdict.gave_up
        if verdict.gave_up or (verdict.alarm and self._on_alarm == "terminate"):
            terminated, truncated = terminated or self._ends == "terminated", truncated or self._ends == "truncated"
        self._ended = bool(terminated or truncated)
        return observation, reward, terminated, truncated, info

    def _report(
        self, info: dict[str, Any], surprise: Surprise, executed: NDArray[np.float32] | None, intervened: bool
    ) -> dict[str, Any]:
        value = float(surprise.value[0])
        alarm = value > self.threshold
        info["asm"] = {
            "surprise": value,
            "threshold": self.threshold,
            "alarm": alarm,
            "intervened": intervened,
            "gave_up": False,
            "executed_action": executed,
            "attribution": dict(zip(self.monitor.spec.labels, surprise.attribution[0].tolist(), strict=True)),
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
