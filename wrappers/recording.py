"""A recorder that keeps any environment's sensorimotor stream."""

from __future__ import annotations

from copy import deepcopy
from typing import Any, SupportsFloat

import gymnasium as gym
import numpy as np
from gymnasium.utils import RecordConstructorArgs
from numpy.typing import NDArray

from asm_gym.episode import Episode
from asm_gym.spec import StreamSpec, flat
from asm_gym.stream_source import StreamSource
from asm_gym.validation import as_float32


class StreamRecorder(gym.Wrapper[Any, Any, Any, Any], RecordConstructorArgs):
    """Keeps every finished episode in ``episodes``, and gives environments without a stream one.

    ``info["stream"]`` and ``stream_spec`` exist on the wrapped environment whatever it is. Where the stream runs faster
    than control, an episode has several rows of it for each action. An episode of an environment whose ``info`` says
    nothing of ``"success"`` or ``"is_success"`` counts as one.

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
        info = dict(info)
        self._observations.append(deepcopy(observation))
        info["stream"] = self._source.first(observation, info)
        return observation, info

    def step(self, action: Any) -> tuple[Any, SupportsFloat, bool, bool, dict[str, Any]]:
        observation, reward, terminated, truncated, info = self.env.step(action)
        # Copies: an environment, a driver or a policy may use its arrays again.
        info = dict(info)
        info["stream"] = self._source.row(observation, action, info)
        self._observations.append(deepcopy(observation))
        self._actions.append(np.array(np.atleast_1d(as_float32(action))))
        self._rewards.append(float(reward))
        rows = self._source.rows(observation, action, info)
        self._rows += list(np.array(rows))
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
