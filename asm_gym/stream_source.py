"""Where any environment's sensorimotor stream comes from."""

from __future__ import annotations

from dataclasses import replace
from math import isclose
from typing import Any, SupportsFloat

import gymnasium as gym
import numpy as np
from gymnasium.wrappers import NormalizeObservation
from gymnasium.wrappers.vector import NormalizeObservation as VectorNormalizeObservation
from numpy.typing import NDArray

from asm_gym.control_period import PeriodCheck, control_period, stream_provider
from asm_gym.control_period import layers as layers
from asm_gym.exceptions import UnsupportedEnvironment
from asm_gym.spec import StreamSpec, flat
from asm_gym.validation import as_float32

StepResult = tuple[Any, SupportsFloat, bool, bool, dict[str, Any]]


class StreamSource:
    """Where an environment's stream comes from: ``info["stream"]`` of its ``own``, or else observation and action.

    Raises:
        TypeError: its spaces cannot be read as rows of numbers.
        UnsupportedEnvironment: a wrapper changes how the same sense reads over time, or repeats the steps of a
            stream that is faster than control.
    """

    def __init__(self, env: gym.Env[Any, Any]) -> None:
        self._env = env
        self.own = env.has_wrapper_attr("stream_spec")
        self._check = PeriodCheck(env, control_period(env))
        if self.own:
            self._refuse_lost_rows()
            return
        refuse_running_statistics(env)
        self._spaces = StreamSpec.from_spaces(env.observation_space, env.action_space, self.period)

    @property
    def period(self) -> float:
        """Control period [s]; ``step`` corrects it by the simulator's clock."""
        return self._check.period

    @property
    def spec(self) -> StreamSpec:
        """Names the numbers of a row; whoever makes the stream run faster changes it."""
        spec = self._stated_spec
        dt = self.period / self.rows_per_step
        if isclose(dt, spec.dt):
            return spec
        return replace(spec, dt=dt)

    @property
    def rows_per_step(self) -> int:
        """How many rows a control step has."""
        if not self.own:
            return 1
        inner = control_period(stream_provider(self._env))
        return max(1, round(inner / self._stated_spec.dt))

    @property
    def _stated_spec(self) -> StreamSpec:
        """The spec whose period may be that of a step inside a wrapper that repeats actions."""
        if self.own:
            return self._env.get_wrapper_attr("stream_spec")
        return self._spaces

    def _refuse_lost_rows(self) -> None:
        """Raise UnsupportedEnvironment for a wrapper that repeats steps of several rows each."""
        rows = self.rows_per_step
        if rows > 1 and not isclose(self.spec.dt, self._stated_spec.dt):
            raise UnsupportedEnvironment(
                f"the stream has {rows} rows in each step of the robot, and a wrapper that repeats "
                "actions hides all but those of the last",
                advice="put that wrapper outside",
            )

    def step(self, action: Any) -> StepResult:
        """Step the environment as ``stepped`` does; correct ``period`` if its clock shows another."""
        expected = self.period
        self._check.begin()
        result = stepped(self._env, action)
        self._check.end(bool(result[2] or result[3]))
        if self.own and self.period != expected:
            self._refuse_lost_rows()
        return result

    def row(self, observation: Any, action: Any, info: dict[str, Any]) -> NDArray[np.float32]:
        """(D,) what was sensed after ``action``, and the action."""
        if self.own:
            if "stream" not in info:
                raise KeyError('info has no "stream"')
            return info["stream"]
        sensed = flat(self._env.observation_space, observation)
        commanded = flat(self._env.action_space, action)
        return as_float32(np.concatenate([sensed, commanded]))

    def first(self, observation: Any, info: dict[str, Any]) -> NDArray[np.float32]:
        """(D,) what was sensed after ``reset``, when nothing had been commanded."""
        if self.own:
            return self.row(observation, None, info)
        sensed = flat(self._env.observation_space, observation)
        nothing = np.zeros(self._spaces.size - len(sensed))
        return as_float32(np.concatenate([sensed, nothing]))

    def rows(self, observation: Any, action: Any, info: dict[str, Any]) -> NDArray[np.float32]:
        """(n, D) all that was sensed since the last step; n is 1 unless the stream runs faster than control."""
        if "streams" in info:
            return info["streams"]
        return self.row(observation, action, info)[None]


def stepped(env: gym.Env[Any, Any], action: Any) -> StepResult:
    """Return what a step of an environment returns.

    Raises TypeError unless it is the five values of Gymnasium.
    """
    result: Any = env.step(action)
    if isinstance(result, tuple) and len(result) == 5:
        return result
    size = 1
    advice = ""
    if isinstance(result, tuple):
        size = len(result)
    if size == 6:
        advice = (
            "; of Safety-Gymnasium, "
            "safety_gymnasium.wrappers.SafetyGymnasium2Gymnasium(env) makes them"
        )
    raise TypeError(
        f"step of {type(env.unwrapped).__name__} returns {size} values, and Gymnasium's "
        f"returns observation, reward, terminated, truncated, info{advice}"
    )


def refuse_running_statistics(env: Any, guard: str = "NeuralASMSafety") -> None:
    """Raise UnsupportedEnvironment for a wrapper by which a sense reads differently the longer it runs."""
    kinds = NormalizeObservation | VectorNormalizeObservation
    for layer in layers(env):
        if isinstance(layer, kinds) and layer.update_running_mean:
            raise UnsupportedEnvironment(
                "NormalizeObservation inside the guard changes its scaling over time",
                advice=f"put it outside, as in NormalizeObservation({guard}(env, monitor)), "
                "or set its update_running_mean to False",
            )
