"""Where any environment's sensorimotor stream comes from."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, SupportsFloat

import gymnasium as gym
import numpy as np
from gymnasium.vector import VectorWrapper
from gymnasium.wrappers import NormalizeObservation
from gymnasium.wrappers.vector import NormalizeObservation as VectorNormalizeObservation
from numpy.typing import NDArray

from asm_gym.spec import StreamSpec, control_period, flat
from asm_gym.validation import as_float32


class StreamSource:
    """Where an environment's stream comes from: ``info["stream"]`` of its ``own``, or else observation and action.

    Without its own, TypeError says that its spaces cannot be read as rows of numbers, and ValueError that a wrapper
    inside changes what it makes of the same sense as it goes on.
    """

    def __init__(self, env: gym.Env[Any, Any]) -> None:
        self._env, self.own = env, env.has_wrapper_attr("stream_spec")
        if not self.own:
            refuse_running_statistics(env)
            self._spaces = StreamSpec.from_spaces(
                env.observation_space, env.action_space, control_period(env)
            )

    @property
    def spec(self) -> StreamSpec:
        """Names the numbers of a row; whoever makes the stream run faster changes it."""
        return self._env.get_wrapper_attr("stream_spec") if self.own else self._spaces

    @property
    def rows_per_step(self) -> int:
        """How many rows a control step has."""
        return max(1, round(control_period(self._env) / self.spec.dt)) if self.own else 1

    def row(self, observation: Any, action: Any, info: dict[str, Any]) -> NDArray[np.float32]:
        """(D,) what was sensed after ``action``, and the action."""
        if self.own:
            if "stream" not in info:
                raise KeyError('info has no "stream"')
            return info["stream"]
        spaces = self._env.observation_space, self._env.action_space
        parts = [
            flat(space, value) for space, value in zip(spaces, (observation, action), strict=True)
        ]
        return as_float32(np.concatenate(parts))

    def first(self, observation: Any, info: dict[str, Any]) -> NDArray[np.float32]:
        """(D,) what was sensed after ``reset``, when nothing had been commanded."""
        if self.own:
            return self.row(observation, None, info)
        sensed = flat(self._env.observation_space, observation)
        return as_float32(np.concatenate([sensed, np.zeros(self._spaces.size - len(sensed))]))

    def rows(self, observation: Any, action: Any, info: dict[str, Any]) -> NDArray[np.float32]:
        """(n, D) all that was sensed since the last step; n is 1 unless the stream runs faster than control."""
        return info["streams"] if "streams" in info else self.row(observation, action, info)[None]


def stepped(
    env: gym.Env[Any, Any], action: Any
) -> tuple[Any, SupportsFloat, bool, bool, dict[str, Any]]:
    """Return what a step of an environment returns. Raises TypeError unless it is the five values of Gymnasium."""
    found: Any = env.step(action)
    if not isinstance(found, tuple) or len(found) != 5:
        size = len(found) if isinstance(found, tuple) else 1
        cost = "; of Safety-Gymnasium, safety_gymnasium.wrappers.SafetyGymnasium2Gymnasium(env) makes them"
        raise TypeError(
            f"step of {type(env.unwrapped).__name__} returns {size} values, and Gymnasium's returns observation, "
            f"reward, terminated, truncated, info{cost if size == 6 else ''}"
        )
    return found


def layers(env: Any) -> Iterator[Any]:
    """Yield the wrappers around an environment, or around many, the outermost first."""
    while isinstance(env, gym.Wrapper | VectorWrapper):
        yield env
        env = env.env


def refuse_running_statistics(env: Any, guard: str = "NeuralASMSafety") -> None:
    """Raise ValueError for a wrapper, of one or many, by which the same sense reads differently the longer it runs."""
    for layer in layers(env):
        if (
            isinstance(layer, NormalizeObservation | VectorNormalizeObservation)
            and layer.update_running_mean
        ):
            raise ValueError(
                "NormalizeObservation inside the guard changes its scaling over time: put it outside, as in "
                f"NormalizeObservation({guard}(env, monitor)), or set its update_running_mean to False"
            )
