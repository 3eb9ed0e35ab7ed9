"""How fast a command would have the hands go."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from asm_gym.envs.mujoco_views import Arms

SURELY = 1.0 - 1e-9
"""Share of a limit of speed below which rounding decides nothing."""


class HandSpeeds:
    """The hands of one loaded model, under the controllers of one episode.

    Args:
        controllers: robosuite's, of each arm.
        moves: where each arm's part of an action stands.
        arms: where they stand in MuJoCo's arrays.
    """

    def __init__(
        self, model: mujoco.MjModel, data: mujoco.MjData, controllers: list[Any], moves: list[slice], arms: Arms
    ) -> None:
        self._model, self._data, self._controllers, self._moves, self._arms = model, data, controllers, moves, arms
        self._told = [_told(controller) for controller in controllers]

    def slowed(self, action: NDArray[np.float64], most: float) -> list[tuple[slice, float]]:
        """For each arm, its part of the action, and what share of it keeps its hand below ``most`` [m/s].

        A controller that is asked for a change Δx of pose again and again, from where it is, comes to the velocity
        Kp/Kd Δx. Actions of controllers that take anything else are left as they are.
        """
        found = []
        for a, (controller, part, told) in enumerate(zip(self._controllers, self._moves, self._told, strict=True)):
            if controller.name not in ("OSC_POSE", "JOINT_POSITION") or controller.input_type != "delta":
                continue
            if told is not None and told(action[part].tolist()) < SURELY * most:
                continue
            delta = np.asarray(controller.scale_action(action[part]), np.float64)
            if controller.name == "JOINT_POSITION":
                jacobian = np.zeros((3, self._model.nv))
                mujoco.mj_jacSite(self._model, self._data, jacobian, None, int(self._arms.site[a]))
                delta = jacobian[:, self._arms.dofs[a, : int(self._arms.joints[a])]] @ delta
            speed = float(np.mean(controller.kp[:3] / controller.kd[:3])) * float(np.linalg.norm(delta[:3]))
            if speed > most:
                found.append((part, most / speed))
        return found


def _told(c: Any) -> Callable[[list[float]], float] | None:
    """What tells the speed of a hand from its command [m/s], to rounding; None but under a fixed OSC_POSE."""
    if c.name != "OSC_POSE" or c.impedance_mode != "fixed":
        return None
    gain = float(np.mean(c.kp[:3] / c.kd[:3]))
    scale = abs(c.output_max - c.output_min) / abs(c.input_max - c.input_min)
    bounds = c.input_min, c.input_max, (c.input_max + c.input_min) / 2, scale, (c.output_max + c.output_min) / 2
    axes = [tuple(float(b[i]) for b in bounds) for i in range(3)]

    def speed(command: list[float]) -> float:
        moves = zip(command, axes, strict=False)
        return gain * math.hypot(*((min(max(x, low), high) - m) * s + o for x, (low, high, m, s, o) in moves))

    return speed
