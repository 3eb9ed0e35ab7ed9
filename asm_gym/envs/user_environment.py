"""A user's own environment class of robosuite as a Gymnasium environment with a named stream, by ``register_task``."""

from __future__ import annotations

from typing import Any

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

from asm_gym.envs.robosuite_backend import import_robosuite, reseed
from asm_gym.spec import MOTOR, Channel, StreamSpec

UNIT_OF = {
    "_cos": "1",
    "_sin": "1",
    "joint_pos": "rad",
    "joint_vel": "rad/s",
    "joint_acc": "rad/s2",
    "_pos": "m",
}
"""Units of robosuite's observables by a part of their name; the first that fits counts."""

HEADLESS = {
    "ignore_done": True,
    "control_freq": 20,
    "has_renderer": False,
    "has_offscreen_renderer": False,
    "use_camera_obs": False,
}


class UserEnvironment(gym.Env[NDArray[np.float32], NDArray[np.float32]]):
    """One environment of a user's class of robosuite.

    The observation is all of its observables, one after another. The stream is those of its robots, then the action.

    Args:
        make: the class.
        arguments: of the class, beside ``HEADLESS``: ``robots="Panda"``, ``controller_configs=…``.
    """

    metadata: dict[str, Any] = {"render_modes": []}  # noqa: RUF012 (as Gymnasium has it)

    def __init__(self, make: type[Any], **arguments: Any) -> None:
        import_robosuite()  # which fits it to MuJoCo
        self.robosuite_env: Any = make(**(HEADLESS | arguments))
        self.dt = 1.0 / self.robosuite_env.control_freq
        self._seeded = False
        self._observables: list[str] = []  # names, in the order of the observation
        self._of_robots: list[str] = []  # those that the stream holds
        prefixes = tuple(robot.robot_model.naming_prefix for robot in self.robosuite_env.robots)
        channels: list[Channel] = []
        sensed = self.robosuite_env._get_observations(force_update=True)
        for name, value in sensed.items():
            if name.endswith("-state") or np.size(value) == 0:
                continue
            self._observables.append(name)
            if name.startswith(prefixes):
                self._of_robots.append(name)
                channels.append(_channel(name, np.size(value)))

        shape = _row(sensed, self._observables).shape
        self.observation_space = gym.spaces.Box(-np.inf, np.inf, shape, np.float32)
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
        no_action = np.zeros(self.stream_spec.channels[-1].size, np.float32)
        return _row(sensed, self._observables), self._info(sensed, no_action)

    def step(
        self, action: NDArray[np.float32]
    ) -> tuple[NDArray[np.float32], float, bool, bool, dict[str, Any]]:
        sensed, reward, _, _ = self.robosuite_env.step(np.asarray(action, np.float64))
        info = self._info(sensed, action)
        return _row(sensed, self._observables), float(reward), False, False, info

    def close(self) -> None:
        self.robosuite_env.close()

    def _info(self, sensed: dict[str, Any], action: NDArray[np.float32]) -> dict[str, Any]:
        row = _row(sensed, self._of_robots)
        stream = np.concatenate([row, np.asarray(action, np.float32)])
        return {"stream": stream, "success": bool(self.robosuite_env._check_success())}


def _row(sensed: dict[str, Any], names: list[str]) -> NDArray[np.float32]:
    return np.concatenate([np.ravel(sensed[name]) for name in names], dtype=np.float32)


def _channel(name: str, size: int) -> Channel:
    """Return the channel of an observable of a robot."""
    group = "sense"
    if "joint" in name:
        group = "joint"
    units = [unit for part, unit in UNIT_OF.items() if part in name]
    return Channel(name, size, unit=next(iter(units), "1"), group=group)
