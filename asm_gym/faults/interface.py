"""Where faults reach environments that are not robosuite's."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, SupportsFloat

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from gymnasium.utils import RecordConstructorArgs
from numpy.typing import NDArray

from asm_gym.spec import MOTOR, StreamSpec, flat
from asm_gym.stream_source import StreamSource
from asm_gym.validation import as_float32


class FaultyInterface(gym.Wrapper[Any, Any, Any, Any], RecordConstructorArgs):
    """Where faults of senses and actions reach an environment that is not robosuite's; an ``Interface`` of theirs.

    What is sensed is the observation, and ``info["stream"]`` where the environment has one, whose senses must then be
    the numbers of the observation. An action that a fault has changed is clipped to its space.

    Args:
        env: takes Box actions, and observes a Box or a dict of such.

    Raises:
        TypeError: other spaces.
    """

    def __init__(self, env: gym.Env[Any, Any]) -> None:
        RecordConstructorArgs.__init__(self)
        gym.Wrapper.__init__(self, env)
        if not isinstance(env.action_space, spaces.Box) or not _boxes(env.observation_space):
            raise TypeError(
                f"faults are injected where actions and senses are Boxes, got {env.action_space} and "
                f"{env.observation_space}"
            )
        self._source = StreamSource(env)
        spec = self._source.spec
        self.measured_spec = StreamSpec(tuple(c for c in spec.channels if c.group != MOTOR), spec.dt, spec.source)
        self.corruptions: list[Callable[[NDArray[np.float64]], None]] = []
        self.deliveries: list[Callable[[NDArray[np.float32]], NDArray[np.float32]]] = []
        self.measured = np.zeros(self.measured_spec.size)
        self.gripper_actions: tuple[int, ...] = ()
        self.horizon = getattr(env.spec, "max_episode_steps", None)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        observation, info = self.env.reset(seed=seed, options=options)
        if self._source.own:
            sensed = np.asarray(info["stream"])[self._source.spec.sensory]
            if not np.allclose(sensed, flat(self.observation_space, observation), equal_nan=True):
                raise ValueError(
                    "the senses in this environment's stream are not its observation: no fault can be both"
                )
        return self._sensed(observation, info), info

    def step(self, action: Any) -> tuple[Any, SupportsFloat, bool, bool, dict[str, Any]]:
        box: Any = self.action_space
        delivered = action
        for deliver in self.deliveries:
            changed = deliver(np.ravel(as_float32(delivered))).reshape(box.shape)
            delivered = np.clip(changed, box.low, box.high)
        observation, reward, terminated, truncated, info = self.env.step(delivered)
        if self._source.own and self.deliveries:
            info["stream"] = np.array(info["stream"])
            info["stream"][self._source.spec.motor] = np.ravel(action)  # as commanded: nobody tells what became of it
        return self._sensed(observation, info), reward, terminated, truncated, info

    def _sensed(self, observation: Any, info: dict[str, Any]) -> Any:
        """What reaches the policy of ``observation``, and ``info``'s stream likewise."""
        row = flat(self.observation_space, observation).astype(np.float64)
        for corrupt in self.corruptions:
            corrupt(row)
        self.measured = row
        if not self.corruptions:
            return observation
        if self._source.own:
            info["stream"] = np.array(info["stream"])
            info["stream"][self._source.spec.sensory] = row
        return spaces.unflatten(self.observation_space, row)


def _boxes(space: gym.Space[Any]) -> bool:
    parts = space.values() if isinstance(space, spaces.Dict) else ()
    return all(map(_boxes, parts)) if parts else isinstance(space, spaces.Box)
