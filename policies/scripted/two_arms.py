"""What experts with two arms share: where the hands are, and commands in the world for arms that stand turned."""

from __future__ import annotations

from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np

from asm_gym.policies.scripted.base import ObservationReader, Vector, move, rotation

ARMS = 2


class Hand(NamedTuple):
    """One arm's hand as it is observed."""

    at: Vector  # (3,) [m]
    turned: Vector  # (3, 3)


class Hands:
    """The hands of an environment with two arms.

    Args:
        env: tells where the hands are in the observation, and how the arms stand in the room.
    """

    def __init__(self, env: gym.Env[Any, Any]) -> None:
        self._env = env
        self._read = ObservationReader(env)

    def look(self, observation: Any) -> tuple[Hand, Hand]:
        """Where both are."""
        first, second = (
            Hand(
                self._read(observation, f"robot{i}_hand_position"),
                rotation(self._read(observation, f"robot{i}_hand_orientation")),
            )
            for i in range(ARMS)
        )
        return first, second

    def bases(self) -> Vector:
        """(2, 3, 3) how the arms stand in the room: their controllers take commands in the frames of their bases."""
        robots = self._env.unwrapped.robosuite_env.robots  # type: ignore[attr-defined]
        return np.stack([np.array(robot.base_ori, np.float64) for robot in robots])

    def places(self) -> Vector:
        """(2, 3) where the arms' bases are [m]."""
        robots = self._env.unwrapped.robosuite_env.robots  # type: ignore[attr-defined]
        return np.stack([np.array(robot.base_pos, np.float64) for robot in robots])


def move_arm(base: Vector, hand: Hand, target: Vector, turned: Vector, speed: float, gain: float = 1.0) -> Vector:
    """(6,) the command, in the frame of its ``base`` (3, 3), that moves a hand towards a pose in the world."""
    command = move(hand.at, target, hand.turned, turned, speed, gain)
    return np.concatenate([base.T @ command[:3], base.T @ command[3:]])
