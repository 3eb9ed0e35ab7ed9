"""Record any environment's sensorimotor stream."""

from __future__ import annotations

from copy import deepcopy
from typing import Any, SupportsFloat

import gymnasium as gym
import numpy as np
from gymnasium.utils import RecordConstructorArgs
from numpy.typing import NDArray

from asm_gym.data.episode import CONTROLLER, Episode
from asm_gym.spec import StreamSpec, flat
from asm_gym.stream_source import StreamSource, stepped
from asm_gym.validation import as_float32


class StreamRecorder(gym.Wrapper[Any, Any, Any, Any], RecordConstructorArgs):
    """Keep every finished episode in ``episodes``.

    Without ``info["stream"]``, observation and action form the stream. A stream that is faster than control has several
    rows for each action. Without ``info["success"]`` and ``info["is_success"]`` an episode counts as a success.

    Args:
        env: an environment with a stream, or with spaces that can be read as numbers.

    Example:
        >>> import gymnasium as gym
        >>> from asm_gym import StreamRecorder
        >>> env = StreamRecorder(gym.make("Pendulum-v1", max_episode_steps=30))
        >>> observation, info = env.reset(seed=0)
        >>> for _ in range(30):
        ...     *_, info = env.step(env.action_space.sample())
        >>> env.episodes[0].stream.shape, len(env.stream_spec.labels)
        ((30, 4), 4)
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
        return self._source.spec

    def _clear(self, seed: int | None, *first: Any) -> None:
        """Begin an episode of ``seed`` with its ``first`` observation, if there is one."""
        self._seed, self._observations = seed, list(first)
        self._steps: list[tuple[NDArray[np.float32], float, NDArray[np.float32], list[bool]]] = []
        self._success: bool | None = None  # nothing was reported yet
        self._terminated = False

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        self._finish()
        observation, info = self.env.reset(seed=seed, options=options)
        self._clear(seed, deepcopy(observation))
        return observation, {**info, "stream": self._source.first(observation, info)}

    def step(self, action: Any) -> tuple[Any, SupportsFloat, bool, bool, dict[str, Any]]:
        observation, reward, terminated, truncated, info = stepped(self.env, action)
        info = {**info, "stream": self._source.row(observation, action, info)}
        # Copies: an environment, a driver or a policy may use its arrays again.
        rows = np.array(self._source.rows(observation, action, info))
        faults = [bool(info.get("fault"))] * len(rows)
        self._observations.append(deepcopy(observation))
        space = self.env.action_space
        numbers = flat(space, action) if isinstance(space, gym.spaces.Dict | gym.spaces.Tuple) else action
        self._steps.append((np.array(np.atleast_1d(as_float32(numbers))), float(reward), rows, faults))
        success = info.get("success", info.get("is_success"))
        self._success = self._success if success is None else bool(self._success or success)
        self._terminated = bool(terminated)
        if terminated or truncated:
            self._finish()
        return observation, reward, terminated, truncated, info

    def finish(self) -> Episode:
        """End the running episode; remove the last episode and return it. Raises ValueError if there is none."""
        self._finish()
        if not self.episodes:
            raise ValueError("no step was recorded yet")
        return self.episodes.pop()

    def close(self) -> None:
        self._finish()
        super().close()

    def _finish(self) -> None:
        if not self._steps:
            return
        space, own = self.env.observation_space, self._source.own
        kept = [] if own and isinstance(space, gym.spaces.Dict) else [flat(space, o) for o in self._observations]
        actions, rewards, rows, faults = zip(*self._steps, strict=True)
        episode = Episode(
            stream=np.concatenate(rows),
            spec=self.stream_spec,
            success=self._success is not False,
            seed=self._seed,
            actions=np.stack(actions),
            observations=np.stack(kept) if kept else np.zeros((0, 0), np.float32),
            rewards=np.asarray(rewards, np.float32),
            faults=np.concatenate(faults),
            info={"terminated": self._terminated, CONTROLLER: getattr(self.env.unwrapped, CONTROLLER, "")},
        )
        self.episodes.append(episode)
        self._clear(None)
