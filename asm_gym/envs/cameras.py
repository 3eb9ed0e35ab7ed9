"""What an environment shows: frames for people, and camera images for a policy."""

from __future__ import annotations

import time
from collections.abc import Sequence
from typing import Any

import gymnasium as gym
import mujoco
import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from asm_gym.envs.rendering import OffscreenRenderer
from asm_gym.envs.viewer import HumanViewer

RENDER_MODES = ("rgb_array", "depth_array", "human")


class Pictures:
    """Draws one environment, lazily: one that never shows anything never touches OpenGL.

    Args:
        mode: None or one of ``RENDER_MODES``.
        camera, size: what ``frame`` shows, and its (height, width) [pixels].
        cameras, camera_size: the same for ``images``.
        dt: real time between two frames for people [s].
    """

    def __init__(
        self,
        mode: str | None,
        camera: str,
        size: tuple[int, int],
        cameras: Sequence[str],
        camera_size: tuple[int, int],
        dt: float,
    ) -> None:
        self._mode, self._cameras, self._camera_size, self._dt = mode, tuple(cameras), camera_size, dt
        self._renderer = OffscreenRenderer(camera, size[1], size[0])
        self._viewer = HumanViewer(camera)
        self._next = 0.0

    @property
    def spaces(self) -> dict[str, spaces.Space[Any]]:
        """Of ``images``."""
        return {f"{name}_image": spaces.Box(0, 255, (*self._camera_size, 3), np.uint8) for name in self._cameras}

    def images(self, model: mujoco.MjModel, data: mujoco.MjData) -> dict[str, NDArray[np.uint8]]:
        """(height, width, 3) uint8 from each camera, as ``<camera>_image``."""
        return {f"{n}_image": self._renderer.render(model, data, n, self._camera_size) for n in self._cameras}

    def frame(self, model: mujoco.MjModel, data: mujoco.MjData) -> NDArray[Any] | None:
        """The picture that the mode asks for; ``human`` shows it, and waits until it is due."""
        if self._mode == "rgb_array":
            return self._renderer.render(model, data)
        if self._mode == "depth_array":
            return self._renderer.depth(model, data)
        if self._mode == "human":
            self._viewer.show(model, data)
            self._next = max(self._next + self._dt, time.perf_counter())
            time.sleep(max(0.0, self._next - time.perf_counter()))
        else:
            gym.logger.warn("render() does nothing without a render_mode: gym.make(…, render_mode='rgb_array')")
        return None

    def close(self) -> None:
        """Frees what was opened; may be called more than once."""
        self._renderer.close()
        self._viewer.close()
