"""Faults of the sensors: what is measured changes, what happens does not. Stream and observation alike see them."""

from __future__ import annotations

from collections.abc import Generator
from dataclasses import dataclass
from typing import Any

from numpy.typing import NDArray

from asm_gym.envs.robosuite_env import RobosuiteEnv
from asm_gym.faults.base import Fault, check_joint


@dataclass(frozen=True, kw_only=True)
class FrozenEncoder(Fault):
    """A joint's encoder keeps saying what it said last: the same position, to the last digit, and no velocity.

    The arm's own controller is closer to the motors than the encoder's bus and is not affected.

    Args:
        joint: counted from the base, 0 first.
    """

    joint: int = 3

    def check(self, env: RobosuiteEnv) -> None:
        check_joint(env, self.joint)

    def inject(self, env: RobosuiteEnv) -> Generator[None, None, None]:
        slices = env.measured_spec.slices
        position = slices["joint_position"].start + self.joint
        velocity = slices["joint_velocity"].start + self.joint
        stuck_at = env.measured[position]

        def freeze(row: NDArray[Any]) -> None:
            row[position], row[velocity] = stuck_at, 0.0

        env.corruptions.append(freeze)
        try:
            while True:
                yield
        finally:
            env.corruptions.remove(freeze)

    def labels(self, env: RobosuiteEnv) -> frozenset[str]:
        return frozenset({f"joint_position[{self.joint}]", f"joint_velocity[{self.joint}]"})
