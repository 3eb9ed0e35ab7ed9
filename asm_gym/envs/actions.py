"""Actions of one environment: their bounds, the action that changes nothing, and those that turn joints."""

from __future__ import annotations

from typing import Any

import numpy as np
from gymnasium import spaces

from asm_gym.detection.contact_limits import ContactLimits
from asm_gym.envs.arms import CHANGES, gripper_actions, unit_change
from asm_gym.envs.mujoco_views import Floats
from asm_gym.envs.simulation import Simulation
from asm_gym.envs.speed_limit import Action, SpeedLimiter
from asm_gym.validation import as_float32


class Actions:
    """The actions of robosuite's environment of a task, under a controller by name."""

    def __init__(self, env: Any, task: str, controller: str) -> None:
        self._task = task
        self._controller = controller
        low, high = env.action_spec
        self._middle = 0.5 * (high + low)
        self._half = 0.5 * (high - low)
        self.space = spaces.Box(-1.0, 1.0, low.shape, np.float32)
        self.size = int(low.size)
        self.grippers = gripper_actions(env.robots)  # indices of the numbers that command grippers
        self._grippers = list(self.grippers)

    def begin_episode(self, simulation: Simulation) -> None:
        """Take up the controllers of an episode."""
        self._simulation = simulation
        self._rest = np.zeros(self.size, np.float32)
        if simulation.compiled:
            self._rest = self.turning(np.zeros(len(simulation.motors)))
        self._limiter = SpeedLimiter(
            views=simulation.views,
            arms=simulation.arms,
            rest=self._rest,
            brake_speeds=simulation.speed_limits,
            ahead=simulation.ahead,
        )

    def checked(self, action: Action) -> Action:
        """Return the action (A,) clipped to [-1, 1]; raise ValueError for another shape, or one that is not finite."""
        action = as_float32(action, "the action")
        if action.shape != self.space.shape:
            raise ValueError(
                f"{self._task} takes an action of shape {self.space.shape}, got {action.shape}"
            )
        if not np.isfinite(action).all():
            raise ValueError(f"the action must be finite, got {action}")
        return np.minimum(np.maximum(action, -1.0, dtype=np.float32), 1.0, dtype=np.float32)

    def scaled(self, action: Action) -> Floats:
        """Return the action (A,) in the units of robosuite's controllers, which for most are the same."""
        return self._middle + self._half * action

    def slowed(self, action: Action, limits: ContactLimits) -> Action:
        """Return the action (A,) scaled along its own direction so that no point of a hand goes faster than it may."""
        self._simulation.limit_motion(limits)
        return self._limiter.slowed(action, self._simulation.motion_limits)

    def resting(self, last: Action) -> Action:
        """Return the action (A,) that changes nothing, where there is one, with the grippers as in ``last``."""
        action = self._rest.copy()
        action[self._grippers] = last[self._grippers]
        return action

    def turning(self, turns: Floats) -> Action:
        """Return the action (A,) that turns the arms' joints by ``turns`` (J,) [rad].

        It does so as nearly as one step can.
        """
        if self._controller not in CHANGES:
            raise ValueError(
                f"actions of {' and '.join(CHANGES)} are changes, "
                f"those of {self._controller} are not"
            )
        action = np.zeros(self.size, np.float32)
        first = 0
        for a, part in enumerate(self._simulation.moves):
            joints = int(self._simulation.arms[a].joint_count)
            action[part] = self._turning(a, turns[first : first + joints])
            first += joints
        return action

    def _turning(self, a: int, turns: Floats) -> Floats:
        """Return the part of the action that turns the joints of arm ``a``."""
        controller = self._simulation.controllers[a]
        change = turns
        if controller.name != "JOINT_POSITION":
            change = self._simulation.hand_change(a, turns)
        middle = (controller.output_max + controller.output_min) / 2
        return np.clip((change - middle) / unit_change(controller), -1.0, 1.0)
