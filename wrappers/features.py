"""Further senses in an environment's stream: what is made of each step, as of a camera's picture."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any, SupportsFloat

import gymnasium as gym
import numpy as np
from gymnasium.utils import RecordConstructorArgs
from numpy.typing import NDArray

from asm_gym.spec import Channel, StreamSpec
from asm_gym.stream_source import StreamSource
from asm_gym.validation import as_float32

Features = Callable[[Any, dict[str, Any]], Any]
"""The numbers of one step, from its observation and its ``info``."""


class StreamFeatures(gym.Wrapper[Any, Any, Any, Any], RecordConstructorArgs):
    """Appends a channel to the stream, for a memory to learn beside the others. Put it inside recorder and guard.

    Args:
        env: with one row of the stream a control step.
        channel: names the numbers; its group is predicted from the others.
        features: makes them, ``channel.size`` a step; what is not finite is an alarm.

    Raises:
        ValueError: the stream runs faster than control, or has a channel of that name.

    Example:
        >>> import gymnasium as gym
        >>> from asm_gym import Channel, StreamRecorder
        >>> from asm_gym.wrappers import StreamFeatures
        >>> bright = Channel("brightness", 1, group="camera")
        >>> env = gym.make("Pendulum-v1", render_mode="rgb_array")
        >>> env = StreamFeatures(env, bright, lambda observation, info: [observation[0]])  # or a network of a picture
        >>> StreamRecorder(env).stream_spec.labels
        ('observation[0]', 'observation[1]', 'observation[2]', 'action', 'brightness')
    """

    def __init__(self, env: gym.Env[Any, Any], channel: Channel, features: Features) -> None:
        RecordConstructorArgs.__init__(self, channel=channel, features=features)
        gym.Wrapper.__init__(self, env)
        self._source, self._channel, self._features = StreamSource(env), channel, features
        if self._source.rows_per_step != 1:
            raise ValueError(f"features come once a control step, the stream {self._source.rows_per_step} times in it")
        self.stream_spec: StreamSpec = replace(self._source.spec, channels=(*self._source.spec.channels, channel))

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        observation, info = self.env.reset(seed=seed, options=options)
        return observation, self._longer(self._source.first(observation, info), observation, info)

    def step(self, action: Any) -> tuple[Any, SupportsFloat, bool, bool, dict[str, Any]]:
        observation, reward, terminated, truncated, info = self.env.step(action)
        info = self._longer(self._source.row(observation, action, info), observation, info)
        return observation, reward, terminated, truncated, info

    def _longer(self, row: NDArray[np.float32], observation: Any, info: dict[str, Any]) -> dict[str, Any]:
        made = as_float32(np.ravel(self._features(observation, info)))
        if len(made) != self._channel.size:
            raise ValueError(f"{self._channel.name} has {self._channel.size} numbers, got {len(made)}")
        return {**info, "stream": np.concatenate([row, made])}
