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

HEADLESS = {
    "ignore_done": True,
    "control_freq": 20,
    "has_renderer": False,
    "has_offscreen_renderer": False,
    "use_camera_obs": False,
}


class OwnRobosuite(gym.Env[NDArray[np.float32], NDArray[np.float32]]):
    """``make(robots=…, …)``, observed by all that it senses; what the robots sense, and the action, are its stream."""

    metadata: dict[str, Any] = {"render_modes": []}  # noqa: RUF012 (as Gymnasium has it)

    def __init__(self, make: type[Any], **arguments: Any) -> None:
        import_robosuite()  # which fits it to MuJoCo
        self.robosuite_env: Any = make(**(HEADLESS | arguments))
        self.dt = 1.0 / self.robosuite_env.control_freq
        self._seeded = False
        self._all: list[str] = []  # that is observed
        self._own: list[str] = []  # that the robots sense
        prefixes = tuple(robot.robot_model.naming_prefix for robot in self.robosuite_env.robots)
        channels: list[Channel] = []
        sensed = self.robosuite_env._get_observations(force_update=True)
        for name, value in sensed.items():
            if name.endswith("-state") or np.size(value) == 0:
                continue
            self._all.append(name)
            if name.startswith(prefixes):
                self._own.append(name)
                group = "joint" if "joint" in name else "sense"
                channels.append(Channel(name, np.size(value), _unit(name), group=group))

        numbers = _row(sensed, self._all).shape
        self.observation_space = gym.spaces.Box(-np.inf, np.inf, numbers, np.float32)
        low, high = (bound.astype(np.float32) for bound in self.robosuite_env.action_spec)
        self.action_space = gym.spaces.Box(low, high, dtype=np.float32)
        channels.append(Channel("action", len(low), group=MOTOR))
        robots = "+".join(robot.name for robot in self.robosuite_env.robots)
        self.stream_spec = StreamSpec(tuple(channels), self.dt, robots)

    @property
    def action_means(self) -> str | None:
        """``"delta"`` where all controllers of the arms take changes of pose or angles; else None."""
        for robot in self.robosuite_env.robots:
            for arm in robot.arms:
                controller = robot.composite_controller.part_controllers[arm]
                if getattr(controller, "input_type", "") != "delta":
                    return None
        return "delta"

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        super().reset(seed=seed)
        if seed is not None or not self._seeded:
            reseed(self.robosuite_env, self.np_random)
            self._seeded = True
        sensed = self.robosuite_env.reset()
        still = np.zeros(self.stream_spec.channels[-1].size, np.float32)
        return _row(sensed, self._all), self._info(sensed, still)

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


def _row(sensed: dict[str, Any], names: list[str]) -> NDArray[np.float32]:
    return np.concatenate([np.ravel(sensed[name]) for name in names], dtype=np.float32)


def _unit(name: str) -> str:
    for part, unit in UNITS.items():
        if part in name:
            return unit
    return "1"
