"""What to do on an alarm. A reflex is an ordinary policy."""

from __future__ import annotations

from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray


class Hold:
    """Stay, and keep the grip.

    Under robosuite's delta controllers a zero command keeps the arm where it is; the gripper's command is repeated as
    it was last given, so that nothing is dropped.

    Args:
        env: one with a Box action space.
        safe_action: what to do instead, where a zero action does not mean "stay".

    Raises:
        ValueError: ``safe_action`` does not fit the action space.
    """

    def __init__(self, env: gym.Env[Any, Any], safe_action: NDArray[np.float32] | None = None) -> None:
        space = env.action_space
        if not isinstance(space, spaces.Box):
            raise TypeError(f"a reflex needs a Box action space, got {space}")
        rest = np.zeros(space.shape, np.float32) if safe_action is None else np.asarray(safe_action, np.float32)
        if not space.contains(rest):
            raise ValueError(f"safe_action {rest} is not in {space}")
        self._rest = rest
        self._grip = np.asarray(getattr(env.unwrapped, "gripper_actions", ()), dtype=int)
        self._explicit = safe_action is not None

    def begin(self, executed: NDArray[np.float32]) -> NDArray[np.float32]:
        """The state to start from: the action that was executed last (A,), whose grip is kept."""
        return executed

    def predict(
        self,
        observation: Any,
        state: NDArray[np.float32] | None = None,
        episode_start: NDArray[np.bool_] | None = None,
        deterministic: bool = False,
    ) -> tuple[NDArray[np.float32], NDArray[np.float32] | None]:
        """The resting action (A,)."""
        action = self._rest.copy()
        if state is not None and not self._explicit:
            action[self._grip] = state[self._grip]
        return action, state
