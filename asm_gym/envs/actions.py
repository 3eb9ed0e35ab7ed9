"""Actions of one environment: their bounds, the action that changes nothing, and those that turn joints."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from asm_gym.detection.contact_limits import ContactLimits
from asm_gym.envs.robots import CHANGES, SLOWED, gripper_actions
from asm_gym.envs.simulation import Simulation
from asm_gym.validation import as_float32

BESIDE = 0.3  # nearer to the axis of its own base a hand goes half as fast, for its mount is hard [m]


class Actions:
    """The actions of robosuite's environment of a task, under a controller by name."""

    def __init__(self, env: Any, task: str, controller: str) -> None:
        self._task, self._controller = task, controller
        low, high = env.action_spec
        self._middle, self._half = 0.5 * (high + low), 0.5 * (high - low)
        self.space = spaces.Box(-1.0, 1.0, low.shape, np.float32)
        self.size = int(low.size)
        self.grippers = gripper_actions(env.robots)  # indices of the numbers that command grippers

    def checked(self, action: NDArray[np.float32]) -> NDArray[np.float32]:
        """Return the action (A,) clipped to [-1, 1]; raise ValueError for another shape, or one that is not finite."""
        action = as_float32(action, "the action")
        if action.shape != self.space.shape:
            raise ValueError(f"{self._task} takes an action of shape {self.space.shape}, got {action.shape}")
        if not np.isfinite(action).all():
            raise ValueError(f"the action must be finite, got {action}")
        return np.minimum(np.maximum(action, -1.0, dtype=np.float32), 1.0, dtype=np.float32)

    def scaled(self, action: NDArray[np.float32]) -> NDArray[np.float64]:
        """Return the action (A,) in the units of robosuite's controllers, which for most are the same."""
        return self._middle + self._half * action

    def slowed(self, simulation: Simulation, action: NDArray[np.float32], limits: ContactLimits) -> NDArray[np.float32]:
        """Return the action (A,) scaled along its own direction so that no point of a hand goes faster than it may.

        A controller that is asked for a change Δx of pose again and again comes to the velocity Kp/Kd Δx. Where actions
        mean something else they are left as they are, and the arm is braked beneath its controller once it is too fast.
        """
        slow, rest, scaled = action, None, self.scaled(action)
        for a, (controller, part) in enumerate(zip(simulation.controllers, simulation.moves, strict=True)):
            views, arms = simulation.views, simulation.arms
            place, base = views.site_xpos[arms.site[a]], views.xpos[arms.root[a]]
            beside = math.dist(place[:2], base[:2]) < BESIDE
            own = limits.stricter(1.0, limits.hand_speed / 2) if beside else limits
            simulation.speed_limits[a] = own.hand_speed
            if controller.name not in SLOWED or controller.input_type != "delta":
                continue
            least, most, middle, scale, offset = simulation.arms.scaling[a, :, : part.stop - part.start]
            delta = (np.minimum(np.maximum(scaled[part], least), most) - middle) * scale + offset
            delta = delta * (controller.kp / controller.kd)[: len(delta)]
            asked = simulation.hand_twist(a, delta, in_joints=controller.name == "JOINT_POSITION")
            twists = np.stack((asked, simulation.hand_twist(a)))
            speeds = simulation.hand_speeds(twists)
            share, now = own.shares(a, place, twists, speeds, simulation.hand_momenta(a, twists))
            most = min(speeds[0] * share, speeds[1] * now if now < 1.0 else np.inf)
            simulation.speed_limits[a] = max(own.hand_speed, most)
            if share < 1.0:
                rest = self.resting(simulation, action) if rest is None else rest
                slow = slow.copy()
                slow[part] = rest[part] + np.float32(share) * (action[part] - rest[part])
        return slow

    def turning(self, simulation: Simulation, turns: NDArray[np.float64]) -> NDArray[np.float32]:
        """Return the action (A,) that turns the arms' joints by ``turns`` (J,) [rad], as nearly as one step can."""
        if self._controller not in CHANGES:
            raise ValueError(f"actions of {' and '.join(CHANGES)} are changes, those of {self._controller} are not")
        action, joint = np.zeros(self.size, np.float32), 0
        for a, (controller, part) in enumerate(zip(simulation.controllers, simulation.moves, strict=True)):
            n = int(simulation.arms.joints[a])
            move = turns[joint : joint + n]
            if controller.name != "JOINT_POSITION":
                hand = simulation.hand_jacobian(a) @ move
                base = int(simulation.arms.base[a])
                frame = np.eye(3) if base < 0 else simulation.data.site_xmat[base].reshape(3, 3)
                move = np.concatenate([frame.T @ hand[:3], frame.T @ hand[3:]])
            middle, half = (f(controller.output_max, controller.output_min) / 2 for f in (np.add, np.subtract))
            action[part] = np.clip((move - middle) / half, -1.0, 1.0)
            joint += n
        return action

    def resting(self, simulation: Simulation, last: NDArray[np.float32]) -> NDArray[np.float32]:
        """Return the action (A,) that changes nothing, where there is one, with the grippers as in ``last``."""
        still = np.zeros(len(simulation.motors))
        action = self.turning(simulation, still) if simulation.compiled else np.zeros(self.size, np.float32)
        grippers = list(self.grippers)
        action[grippers] = last[grippers]
        return action
