"""Record any environment's sensorimotor stream.

T control steps ► Episode: stream (k T, D), actions (T, A), observations (T + 1, O), rewards (T,)
"""

from __future__ import annotations

import warnings
from copy import deepcopy
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.utils import RecordConstructorArgs
from numpy.typing import NDArray

from asm_gym.control_period import PeriodWarning
from asm_gym.data.episode import CONTROLLER, Episode
from asm_gym.spec import StreamSpec, flat
from asm_gym.stream_source import StepResult, StreamSource
from asm_gym.validation import as_float32


class StreamRecorder(gym.Wrapper[Any, Any, Any, Any], RecordConstructorArgs):
    """Keep every finished episode in ``episodes``.

    Without ``info["stream"]``, observation and action form the stream. A stream that is faster than
    control has several rows for each action. Without ``info["success"]`` and ``info["is_success"]``
    an episode counts as a success.

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
        self._begin(None, [])

    @property
    def stream_spec(self) -> StreamSpec:
        return self._source.spec

    def _begin(self, seed: int | None, observations: list[Any]) -> None:
        """Begin an episode with the observation of ``reset``, if there is one."""
        self._seed = seed
        self._observations = observations
        self._actions: list[NDArray[np.float32]] = []  # (A,) each
        self._rewards: list[float] = []
        self._rows: list[NDArray[np.float32]] = []  # (k, D) each
        self._faults: list[bool] = []  # a fault was active, of each row
        self._success: bool | None = None  # None: nothing was reported yet

    def reset(
        self,
        *,
        seed: int | None = None,
        options: dict[str, Any] | None = None,
    ) -> tuple[Any, dict[str, Any]]:
        self._finish()
        observation, info = self.env.reset(seed=seed, options=options)
        self._begin(seed, [deepcopy(observation)])
        return observation, {**info, "stream": self._source.first(observation, info)}

    def step(self, action: Any) -> StepResult:
        observation, reward, terminated, truncated, info = self._stepped(action)
        info = {**info, "stream": self._source.row(observation, action, info)}

        # Copies: an environment, a driver or a policy may use its arrays again.
        rows = np.array(self._source.rows(observation, action, info))
        self._rows.append(rows)
        self._faults += [bool(info.get("fault"))] * len(rows)
        self._observations.append(deepcopy(observation))
        self._actions.append(self._numbers(action))
        self._rewards.append(float(reward))

        success = info.get("success", info.get("is_success"))
        if success is not None:
            self._success = bool(self._success or success)
        if terminated or truncated:
            self._finish(bool(terminated))
        return observation, reward, terminated, truncated, info

    def _stepped(self, action: Any) -> StepResult:
        """Step the environment; warn if the simulator's clock shows another control period."""
        expected = self._source.period
        result = self._source.step(action)
        measured = self._source.period
        if measured != expected:
            message = f"a control step takes {measured:g} s and not {expected:g} s"
            advice = "by the simulator's clock: the recorded stream has the measured period"
            warnings.warn(f"{message} {advice}", PeriodWarning, stacklevel=3)
        return result

    def finish(self) -> Episode:
        """End the running episode; remove the last episode and return it.

        Raises:
            ValueError: there is none.
        """
        self._finish()
        if not self.episodes:
            raise ValueError("no step was recorded yet")
        return self.episodes.pop()

    def close(self) -> None:
        self._finish()
        super().close()

    def _numbers(self, action: Any) -> NDArray[np.float32]:
        """Return a copy (A,) of an action."""
        space = self.env.action_space
        if isinstance(space, gym.spaces.Dict | gym.spaces.Tuple):
            action = flat(space, action)
        return np.array(as_float32(action), ndmin=1)

    def _finish(self, terminated: bool = False) -> None:
        """Keep the running episode, if it has a step."""
        if not self._rows:
            return
        space = self.env.observation_space
        observations = np.zeros((0, 0), np.float32)
        if not (self._source.own and isinstance(space, gym.spaces.Dict)):
            observations = np.stack([flat(space, each) for each in self._observations])
        controller = getattr(self.env.unwrapped, CONTROLLER, "")
        episode = Episode(
            stream=np.concatenate(self._rows),
            spec=self.stream_spec,
            success=self._success is not False,
            seed=self._seed,
            actions=np.stack(self._actions),
            observations=observations,
            rewards=np.asarray(self._rewards, np.float32),
            faults=np.array(self._faults),
            info={"terminated": terminated, CONTROLLER: controller},
        )
        self.episodes.append(episode)
        self._begin(None, [])
