r"""LeRobot's robot type ``guarded``: any other robot, each of whose commands a guard judges before it is sent.

    lerobot-rollout --robot.type=guarded --robot.memory=so101.asm \
                    --robot.arm="{type: so101_follower, port: /dev/ttyACM0}" …

LeRobot imports this module by its name, at the beginning of each of its commands.
Source: LeRobot 0.6, ``lerobot/utils/import_utils.py`` (register_third_party_plugins).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import draccus
from lerobot.robots import Robot, RobotConfig, make_robot_from_config

from asm_gym.wrappers.lerobot import LeRobotGuard


@RobotConfig.register_subclass("guarded")
@dataclass(kw_only=True)
class GuardedRobotConfig(RobotConfig):
    """Any robot behind a guard."""

    # A config of a robot, or its fields. No nested ``RobotConfig``: draccus unrolls each robot type in each other.
    arm: dict[str, Any]
    """The robot within: ``--robot.arm="{type: so101_follower, port: /dev/ttyACM0}"``."""
    memory: str
    """File of the memory, from ``asm-gym fit DATASET``."""
    on_alarm: str = "hold"
    """``hold`` until surprise is low, ``stop`` until the robot is connected anew, or ``monitor``."""
    release_s: float = 1.0
    """Time of low surprise after which the policy acts again [s]."""


class GuardedRobot(Robot):
    """Send a robot what its guard lets pass, or a hold.

    A dataset that it records is one of the robot within, with the commands that were sent. Cameras,
    motors and calibration are those of the robot within.

    Args:
        config: of the guard, and of the robot within.

    Example:
        >>> robot = make_robot_from_config(GuardedRobotConfig(arm=arm, memory="so101.asm"))  # doctest: +SKIP
    """

    config_class = GuardedRobotConfig
    name = "guarded"

    def __init__(self, config: GuardedRobotConfig) -> None:
        self.config = config
        arm: Any = config.arm
        if isinstance(arm, dict):
            arm = draccus.decode(RobotConfig, arm)
        self.arm = make_robot_from_config(arm)
        self.guard = LeRobotGuard(config.memory, config.on_alarm, config.release_s)
        self.name = self.arm.name
        self.robot_type = self.arm.name
        self._observation: dict[str, Any] | None = None  # read since the newest command

    def __getattr__(self, name: str) -> Any:
        if name == "arm":  # its construction failed
            raise AttributeError(name)
        return getattr(self.arm, name)

    def __str__(self) -> str:
        return f"guarded {self.arm}"

    @property
    def observation_features(self) -> dict[str, Any]:
        return self.arm.observation_features

    @property
    def action_features(self) -> dict[str, Any]:
        return self.arm.action_features

    @property
    def is_connected(self) -> bool:
        return self.arm.is_connected

    @property
    def is_calibrated(self) -> bool:
        return self.arm.is_calibrated

    def connect(self, calibrate: bool = True) -> None:
        self.arm.connect(calibrate)
        self.guard.reset()
        self._observation = None

    def calibrate(self) -> None:
        self.arm.calibrate()

    def configure(self) -> None:
        self.arm.configure()

    def get_observation(self) -> dict[str, Any]:
        self._observation = self.arm.get_observation()
        return self._observation

    def send_action(self, action: dict[str, Any]) -> dict[str, Any]:
        """Judge a command beside a reading that is newer than the last command, and send what passes.

        Returns:
            What was sent; empty in an alarm while no position is known.
        """
        observation = self._observation
        if observation is None:
            observation = self.arm.get_observation()
        self._observation = None
        command = self.guard.guarded(observation, action)
        if not command:
            return {}
        return self.arm.send_action(command)

    def disconnect(self) -> None:
        self.arm.disconnect()
