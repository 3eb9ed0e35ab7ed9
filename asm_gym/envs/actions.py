"""What an action is to a robot: its bounds, its grippers, the one that changes nothing and those that turn joints."""

from __future__ import annotations

from typing import Any

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from asm_gym.envs.simulation import Simulation
from asm_gym.validation import as_float32

_CHANGES = ("OSC_POSE", "JOINT_POSITION")
"""Controllers whose actions are changes of where the arm is."""


class Actions:
    """The actions of one environment.

    Args:
        env: robosuite's environment.
        task: its name.
        controller: of the arms, by name.
    """

    def __init__(self, env: Any, task: str, controller: str) -> None:
        self._task, self._controller = task, controller
        self._low, high = env.action_spec
        self._half = 0.5 * (high - self._low)
        self.space = spaces.Box(-1.0, 1.0, self._low.shape, np.float32)
        self.size = int(self._low.size)
        self.grippers = _grippers(env.robots)
        """Which numbers of the action command grippers."""

    def checked(self, action: NDArray[np.float32]) -> NDArray[np.float32]:
        """(A,) in [-1, 1], clipped to it.

        Raises:
            ValueError: a wrong shape, or an action that is not finite.
        """
        action = as_float32(action, "the action")
        if action.shape != self.space.shape:
            raise ValueError(f"{self._task} takes an action of shape {self.space.shape}, got {action.shape}")
        if not np.isfinite(action).all():
            raise ValueError(f"the action must be finite, got {action}")
        return np.clip(action, -1.0, 1.0)

    def scaled(self, action: NDArray[np.float32]) -> NDArray[np.float64]:
        """(A,) in the units robosuite's controllers take, which for most are the same."""
        found: NDArray[np.float64] = self._low + self._half * (action.astype(np.float64) + 1.0)
        return found

    def slowed(self, simulation: Simulation, action: NDArray[np.float32], most: float) -> NDArray[np.float32]:
        """(A,) the action at which no hand is commanded to go faster than ``most`` [m/s]; the same where none is."""
        shares = simulation.speeds.slowed(self.scaled(action), most)
        if not shares:
            return action
        slow, rest = action.copy(), self.resting(simulation, action)
        for part, share in shares:
            slow[part] = rest[part] + np.float32(share) * (action[part] - rest[part])
        return slow

    def turning(self, simulation: Simulation, turns: NDArray[np.float64]) -> NDArray[np.float32]:
        """(A,) the action that turns the arms' joints by ``turns`` (J,) [rad], as nearly as one step can.

        Raises:
            ValueError: the controller takes no changes.
        """
        if self._controller not in _CHANGES:
            raise ValueError(f"actions of {' and '.join(_CHANGES)} are changes, those of {self._controller} are not")
        action = np.zeros(self.size, np.float32)
        for part, motion in simulation.motions(turns):
            action[part] = np.clip(motion, -1.0, 1.0)
        return action

    def resting(self, simulation: Simulation, last: NDArray[np.float32]) -> NDArray[np.float32]:
        """(A,) the action that changes nothing, where there is one, with the grippers as ``last`` told them."""
        action = np.zeros(self.size, np.float32)
        if simulation.compiled:
            for part, motion in simulation.motions(np.zeros(len(simulation.motors))):
                action[part] = np.clip(motion, -1.0, 1.0)
        grippers = list(self.grippers)
        action[grippers] = last[grippers]
        return action


def _grippers(robots: list[Any]) -> tuple[int, ...]:
    found: list[int] = []
    start = 0
    for robot in robots:
        for part, (low, high) in robot._action_split_indexes.items():
            if "gripper" in part:
                found += range(start + low, start + high)
        start += robot.action_dim
    return tuple(found)
