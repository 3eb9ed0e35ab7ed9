"""What a robot should not do: how hard it touches its surroundings, and how near its motors are to their limits."""

from __future__ import annotations

from typing import Any, SupportsFloat

import gymnasium as gym
import numpy as np
from gymnasium.utils import RecordConstructorArgs

from asm_gym.envs.compiled_substeps import MOTOR


class TorqueWatch(gym.Wrapper[Any, Any, Any, Any], RecordConstructorArgs):
    """Adds to ``info`` how much of their torque the joints of an ``asm_gym`` environment use.

    ``torque_share`` is the largest share of its limit that a joint's motor gave on average over the control step: 1
    where one stood at its limit throughout. ``torque_peak_share`` is the same of its largest torque within the step,
    which a jump of the set-point brings to 1 for a moment.

    Args:
        env: whose ``unwrapped`` is this package's.
    """

    def __init__(self, env: gym.Env[Any, Any]) -> None:
        RecordConstructorArgs.__init__(self)
        gym.Wrapper.__init__(self, env)

    def step(self, action: Any) -> tuple[Any, SupportsFloat, bool, bool, dict[str, Any]]:
        observation, reward, terminated, truncated, info = self.env.step(action)
        simulation: Any = self.env.unwrapped.simulation  # type: ignore[attr-defined]
        limits = np.abs(simulation.model.actuator_ctrlrange[simulation.motors]).max(axis=1)
        sensed = simulation.proprioception
        for name, samples in (("torque_share", sensed.mean), ("torque_peak_share", sensed.peak)):
            # Arms with fewer joints than there is room for leave the rest at 0.
            torques = samples[:, MOTOR][:, : len(limits) // len(samples)].ravel()
            info[name] = float((np.abs(torques) / limits).max())
        return observation, reward, terminated, truncated, info
