"""The scenes in which the study of learning trains agents."""

from __future__ import annotations

import math
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.vector import AutoresetMode, VectorEnv, VectorWrapper

from asm_gym.detection.contact_limits import ContactLimits
from asm_gym.envs.vector import ThreadedVectorEnv
from asm_gym.tasks import env_id
from asm_gym.wrappers.env_attributes import askable

REACH = "Reach"
TASKS = ("Lift", "Door", "Stack", REACH)
REACHED = 0.03  # a hand so near to the cube has reached it [m]


class Reach(gym.Wrapper[Any, Any, Any, Any]):
    """Lift's scene, in which the hand is to move to the cube and needs to lift nothing."""

    def step(self, action: Any) -> Any:
        observation, _, terminated, truncated, info = self.env.step(action)
        arm: Any = self.unwrapped
        scene = arm.robosuite_env
        distance = scene._gripper_to_target(
            gripper=scene.robots[0].gripper,
            target=scene.cube.root_body,
            target_type="body",
            return_distance=True,
        )
        info["success"] = bool(distance < REACHED)
        reward = 1.0 - np.tanh(10.0 * distance)
        return observation, float(reward), terminated, truncated, info


class SpeedLimited(VectorWrapper):
    """A fixed limit of the hands' speed, which neither a memory nor a force lowers.

    Args:
        env: a vector of this package's environments.
        hand_speed: the limit [m/s].
    """

    def __init__(self, env: VectorEnv[Any, Any, Any], hand_speed: float) -> None:
        super().__init__(env)
        self._limits = ContactLimits(
            wrist_force=math.inf,
            external_torque=math.inf,
            hand_speed=hand_speed,
            stays=False,
        )

    def reset(self, *, seed: Any = None, options: dict[str, Any] | None = None) -> Any:
        result = self.env.reset(seed=seed, options=options)
        named_limits = [("speed limit", self._limits)] * self.num_envs
        askable(self.env).set_attr("limits_of_guard", named_limits)
        return result


def member(task: str, robot: str) -> gym.Env[Any, Any]:
    """Return one environment of a task of this study."""
    if task == REACH:
        return Reach(gym.make(env_id("Lift"), robot=robot))
    return gym.make(env_id(task), robot=robot)


@contextmanager
def vector(task: str, robot: str, count: int, threads: int) -> Iterator[ThreadedVectorEnv]:
    """Make a vector of a task, and close it when the block ends."""
    make = partial(member, task, robot)
    envs = ThreadedVectorEnv([make] * count, threads, AutoresetMode.DISABLED)
    try:
        yield envs
    finally:
        envs.close()
