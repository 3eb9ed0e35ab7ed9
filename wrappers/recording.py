"""Any environment's sensorimotor stream, and a recorder that keeps it."""

from __future__ import annotations

from typing import Any, SupportsFloat

import gymnasium as gym
import numpy as np
from gymnasium.utils import RecordConstructorArgs
from gymnasium.wrappers import NormalizeObservation
from numpy.typing import NDArray

from asm_gym.checks import as_float32
from asm_gym.episodes import Episode
from asm_gym.stream import StreamSpec, control_period, flat


class StreamSource:
    """Where an environment's stream comes from: ``info["stream"]``, or else its observation and the action.

    Attributes:
        own: the environment has a stream of its own.

    Raises:
        TypeError: the environment has no stream, and its spaces cannot be read as rows of numbers.
        ValueError: it has none, and a wrapper inside changes what it makes of the same sense as it goes on.
    """

    def __init__(self, env: gym.Env[Any, Any]) -> None:
        self._env, self.own = env, env.has_wrapper_attr("stream_spec")
        if not self.own:
            _refuse_running_statistics(env)
            self._spaces = StreamSpec.from_spaces(env.observation_space, env.action_space, control_period(env))

    @property
    def spec(self) -> StreamSpec:
        """Names the numbers of a row; whoever makes the stream run faster changes it."""
        spec: StreamSpec = self._env.get_wrapper_attr("stream_spec") if self.own else self._spaces
        return spec

    @property
    def rows_per_step(self) -> int:
        """How many rows a control step has."""
        return max(1, round(control_period(self._env) / self.spec.dt)) if self.own else 1

    def row(self, observation: Any, action: Any, info: dict[str, Any]) -> NDArray[np.float32]:
        """(D,) what was sensed after ``action``, and the action."""
        if self.own:
            if "stream" not in info:
                raise KeyError('info has no "stream"')
            row: NDArray[np.float32] = info["stream"]
            return row
        spaces = self._env.observation_space, self._env.action_space
        parts = [flat(space, value) for space, value in zip(spaces, (observation, action), strict=True)]
        return as_float32(np.concatenate(parts))

    def first(self, observation: Any, info: dict[str, Any]) -> NDArray[np.float32]:
        """(D,) what was sensed after ``reset``, when nothing had been commanded."""
        if self.own:
            return self.row(observation, None, info)
        sensed = flat(self._env.observation_space, observation)
        row: NDArray[np.float32] = np.concatenate([sensed, np.zeros(self._spaces.size - len(sensed))]).astype(
            np.float32
        )
        return row

    def rows(self, observation: Any, action: Any, info: dict[str, Any]) -> NDArray[np.float32]:
        """(n, D) all that was sensed since the last step; n is 1 unless the stream runs faster than control."""
        found: NDArray[np.float32] = info["streams"] if "streams" in info else self.row(observation, action, info)[None]
        return found


def _refuse_running_statistics(env: gym.Env[Any, Any]) -> None:
    """Raises ValueError for a wrapper by which the same sense reads differently the longer it runs."""
    while isinstance(env, gym.Wrapper):
        if isinstance(env, NormalizeObservation) and env.update_running_mean:
            raise ValueError(
                "NormalizeObservation changes what it makes of the same sense as it goes on: put it outside, as in "
                "NormalizeObservation(NeuralASMSafety(env, monitor)), or set its update_running_mean to False"
            )
        env = env.env


class StreamRecorder(gym.Wrapper[Any, Any, Any, Any], RecordConstructorArgs):
    """Keeps every finished episode in ``episodes``, and gives environments without a stream one.

    ``info["stream"]`` and ``stream_spec`` exist on the wrapped environment whatever it is. Where the stream runs faster
    than control, an episode has several rows of it for each action. An episode of an environment whose ``info`` says
    nothing of ``"success"`` or ``"is_success"`` counts as one.

    Args:
        env: an environment with a stream, or with spaces that can be read as numbers.
    """

    def __init__(self, env: gym.Env[Any, Any]) -> None:
        RecordConstructorArgs.__init__(self)
        gym.Wrapper.__init__(self, env)
        self._source = StreamSource(env)
        self.episodes: list[Episode] = []
        """What was recorded; an episode that was cut short by ``reset`` is kept too."""
        self._clear(None)

    @property
    def stream_spec(self) -> StreamSpec:
        """Names the numbers of a row."""
        return self._source.spec

    def _clear(self, seed: int | None) -> None:
        self._seed = seed
        self._observations: list[Any] = []
        self._actions: list[NDArray[np.float32]] = []
        self._rewards: list[float] = []
        self._rows: list[NDArray[np.float32]] = []
        self._faults: list[bool] = []
        self._success: bool | None = None  # nobody has said yet
        self._terminated = False

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        self._finish()
        observation, info = self.env.reset(seed=seed, options=options)
        self._clear(seed)
        self._observations.append(observation)
        info["stream"] = self._source.first(observation, info)
        return observation, info

    def step(self, action: Any) -> tuple[Any, SupportsFloat, bool, bool, dict[str, Any]]:
        observation, reward, terminated, truncated, info = self.env.step(action)
        info["stream"] = self._source.row(observation, action, info)
        self._observations.append(observation)
        self._actions.append(np.atleast_1d(as_float32(action)))
        self._rewards.append(float(reward))
        rows = self._source.rows(observation, action, info)
        self._rows += list(rows)
        self._faults += [bool(info.get("fault"))] * len(rows)
        said = info.get("success", info.get("is_success"))
        self._success = self._success if said is None else bool(self._success or said)
        self._terminated = bool(terminated)
        if terminated or truncated:
            self._finish()
        return observation, reward, terminated, truncated, info

    def finish(self) -> Episode:
        """Ends the episode that is being recorded, and hands out the one recorded last; it is not kept.

        Raises:
            ValueError: nothing was recorded.
        """
        self._finish()
        if not self.episodes:
            raise ValueError("no step was recorded yet")
        return self.episodes.pop()

    def close(self) -> None:
        self._finish()
        super().close()

    def _finish(self) -> None:
        if self._rows:
            space, own = self.env.observation_space, self._source.own
            kept = [] if own and isinstance(space, gym.spaces.Dict) else [flat(space, o) for o in self._observations]
            self.episodes.append(
                Episode(
                    stream=np.stack(self._rows),
                    spec=self.stream_spec,
                    success=self._success is not False,
                    seed=self._seed,
                    actions=np.stack(self._actions),
                    observations=np.stack(kept) if kept else np.zeros((0, 0), np.float32),
                    rewards=np.asarray(self._rewards, np.float32),
                    faults=np.asarray(self._faults),
                    info={"terminated": self._terminated},
                )
            )
        self._clear(None)
