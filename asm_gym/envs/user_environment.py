"""An environment class of robosuite that is not this package's, as a Gymnasium environment with a named stream."""

from __future__ import annotations

from typing import Any

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

from asm_gym.envs.backend import import_robosuite, reseed
from asm_gym.spec import MOTOR, Channel, StreamSpec

UNITS = {
    "_cos": "1",
    "_sin": "1",
    "joint_pos": "rad",
    "joint_vel": "rad/s",
    "joint_acc": "rad/s2",
    "_pos": "m",
}
"""Of what robosuite senses, by what its name holds; the first that fits."""


class OwnRobosuite(gym.Env[NDArray[np.float32], NDArray[np.float32]]):
    """``make(robots=…, …)``, observed by all that it senses; what the robots sense, and the action, are its stream."""

    metadata: dict[str, Any] = {"render_modes": []}  # noqa: RUF012 (as Gymnasium has it)

    def __init__(self, make: type[Any], **arguments: Any) -> None:
        import_robosuite()  # which fits it to MuJoCo
        headless = dict.fromkeys(
            ("has_renderer", "has_offscreen_renderer", "use_camera_obs"), False
        )
        self.robosuite_env: Any = make(
            **{"ignore_done": True, "control_freq": 20, **headless, **arguments}
        )
        self.dt = 1.0 / self.robosuite_env.control_freq
        self._seeded = False
        sensed = self.robosuite_env._get_observations(force_update=True)
        numbers = {
            k: np.size(v) for k, v in sensed.items() if not k.endswith("-state") and np.size(v)
        }
        own = tuple(robot.robot_model.naming_prefix for robot in self.robosuite_env.robots)
        self._all, self._own = tuple(numbers), tuple(k for k in numbers if k.startswith(own))
        self.observation_space = gym.spaces.Box(
            -np.inf, np.inf, (sum(numbers.values()),), np.float32
        )
        low, high = self.robosuite_env.action_spec
        self.action_space = gym.spaces.Box(
            low.astype(np.float32), high.astype(np.float32), dtype=np.float32
        )
        channels = [
            Channel(k, numbers[k], _unit(k), group="joint" if "joint" in k else "sense")
            for k in self._own
        ]
        action = Channel("action", len(low), group=MOTOR)
        robots = "+".join(robot.name for robot in self.robosuite_env.robots)
        self.stream_spec = StreamSpec((*channels, action), self.dt, robots)

    @property
    def action_means(self) -> str | None:
        """``"delta"`` where all controllers of the arms take changes of pose or angles; else None."""
        parts = [(robot, arm) for robot in self.robosuite_env.robots for arm in robot.arms]
        controllers = [robot.composite_controller.part_controllers[arm] for robot, arm in parts]
        return (
            "delta" if all(getattr(c, "input_type", "") == "delta" for c in controllers) else None
        )

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        super().reset(seed=seed)
        if seed is not None or not self._seeded:
            reseed(self.robosuite_env, self.np_random)
            self._seeded = True
        sensed = self.robosuite_env.reset()
        return _row(sensed, self._all), self._info(
            sensed, np.zeros(self.action_space.shape or (), np.float32)
        )

    def step(
        self, action: NDArray[np.float32]
    ) -> tuple[NDArray[np.float32], float, bool, bool, dict[str, Any]]:
        sensed, reward, _, _ = self.robosuite_env.step(np.asarray(action, np.float64))
        return _row(sensed, self._all), float(reward), False, False, self._info(sensed, action)

    def close(self) -> None:
        self.robosuite_env.close()

    def _info(self, sensed: dict[str, Any], action: NDArray[np.float32]) -> dict[str, Any]:
        stream = np.concatenate([_row(sensed, self._own), np.asarray(action, np.float32)])
        return {"stream": stream, "success": bool(self.robosuite_env._check_success())}


def _row(sensed: dict[str, Any], names: tuple[str, ...]) -> NDArray[np.float32]:
    return np.asarray(np.concatenate([np.ravel(sensed[name]) for name in names]), np.float32)


def _unit(name: str) -> str:
    return next((unit for part, unit in UNITS.items() if part in name), "1")
