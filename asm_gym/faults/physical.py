"""Faults of the body and its motors."""

from __future__ import annotations

from collections.abc import Generator
from dataclasses import dataclass

import numpy as np

from asm_gym.envs.robosuite_env import RobosuiteEnv
from asm_gym.faults.base import Fault, body_id, check_joint, data_of, edited, model_of


@dataclass(frozen=True, kw_only=True)
class Push(Fault):
    """A steady force on a body of the robot, or of anything else.

    Args:
        body: a body of the model, such as ``robot0_link5``.
        newtons: how hard [N].
        direction: in the world's axes; its length does not matter.
    """

    body: str = "robot0_link5"
    newtons: float = 20.0
    direction: tuple[float, float, float] = (0.0, 1.0, 0.0)

    def __post_init__(self) -> None:
        super().__post_init__()
        if not np.isfinite(self.newtons):
            raise ValueError(f"newtons must be finite, got {self.newtons}")
        if len(self.direction) != 3 or not 0 < np.linalg.norm(self.direction) < np.inf:
            raise ValueError(f"direction must be three finite numbers, not all zero, got {self.direction}")

    def check(self, env: RobosuiteEnv) -> None:
        body_id(env, self.body)

    def inject(self, env: RobosuiteEnv) -> Generator[None, None, None]:
        data, body = data_of(env), body_id(env, self.body)
        force = self.newtons * np.asarray(self.direction) / np.linalg.norm(self.direction)
        # Added, not set: two pushes on one body add up, and undoing one leaves the other.
        data.xfrc_applied[body, :3] += force
        try:
            while True:
                yield
        finally:
            data.xfrc_applied[body, :3] -= force

    def labels(self, env: RobosuiteEnv) -> frozenset[str]:
        groups = ("torque", "wrench")
        return frozenset(label for c in env.stream_spec.channels if c.group in groups for label in c.labels)


@dataclass(frozen=True, kw_only=True)
class WeakJoint(Fault):
    """A joint's motor gives only part of the torque it is told to.

    Args:
        joint: counted from the base, 0 first.
        strength: share of the commanded torque that arrives; 0 is a dead motor.
    """

    joint: int = 3
    strength: float = 0.5

    def __post_init__(self) -> None:
        super().__post_init__()
        if not 0.0 <= self.strength <= 1.0:
            raise ValueError(f"strength must be in [0, 1], got {self.strength}")

    def check(self, env: RobosuiteEnv) -> None:
        check_joint(env, self.joint)

    def inject(self, env: RobosuiteEnv) -> Generator[None, None, None]:
        gear, motor = model_of(env).actuator_gear, env.motors[self.joint]
        with edited(gear, (motor, 0), self.strength * gear[motor, 0]):
            while True:
                yield

    def labels(self, env: RobosuiteEnv) -> frozenset[str]:
        names = ("measured_torque", "commanded_torque", "external_torque", "joint_velocity", "joint_position")
        return frozenset(f"{name}[{self.joint}]" for name in names)
