"""A window that shows the simulation to a human, for render mode ``human``."""

from __future__ import annotations

import sys
import time
import warnings
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from copy import copy
from functools import cache
from typing import Any, cast

import mujoco

from asm_gym.envs.rendering import camera_id, close_at_exit


class HumanViewer:
    """A window on a display, which mouse and keyboard turn; follows a model's replacement with a new window.

    It shows a copy of the simulation's state, so that looking changes nothing. Once its user has closed it, it stays
    closed. The speed of the show is the caller's.

    Args:
        camera: where it looks from at first; a free camera where None.
    """

    def __init__(self, camera: str | None = None) -> None:
        self.camera = camera
        self._model: mujoco.MjModel | None = None
        self._viewer: Any = None

    @property
    def is_open(self) -> bool:
        """False before the first ``show``, and after the window was closed by whomever."""
        return self._viewer is not None and bool(self._viewer.is_running())

    def show(self, model: mujoco.MjModel, data: mujoco.MjData) -> None:
        """Brings the window up to date.

        Raises:
            ValueError: the model has no such camera.
            RuntimeError: there is no display to open a window on.
        """
        if self._model is not model:
            self._open(model, data)
        elif self.is_open:
            mujoco.mj_copyData(self._data, model, data)
            self._viewer.sync()

    def _open(self, model: mujoco.MjModel, data: mujoco.MjData) -> None:
        self.close()
        camera = None if self.camera is None else camera_id(model, self.camera)
        launch = _window_launcher()
        self._data = copy(data)
        self._viewer = launch(model, self._data, show_left_ui=False, show_right_ui=False)
        close_at_exit(self)
        with self._viewer.lock():
            self._viewer.opt.geomgroup[0] = 0  # collision shapes
            if camera is not None:
                self._viewer.cam.type = mujoco.mjtCamera.mjCAMERA_FIXED
                self._viewer.cam.fixedcamid = camera
        self._viewer.sync()
        self._model = model

    def close(self) -> None:
        """Closes the window; may be called more than once."""
        if self._viewer is not None:
            self._viewer.close()
            # Its thread must be done before another window opens: GLFW serves one thread at a time.
            deadline = time.monotonic() + 5.0
            with suppress(mujoco.UnexpectedError):
                while self._viewer.m is not None and time.monotonic() < deadline:
                    time.sleep(0.01)
        self._viewer = self._model = None


@cache
def _window_launcher() -> Callable[..., Any]:
    """MuJoCo's own, once it is known to work: it waits for ever for a window that cannot be opened.

    Raises:
        RuntimeError: no window can be opened on this machine.
    """
    try:
        import glfw
        from mujoco.viewer import launch_passive
    except ImportError as error:
        raise RuntimeError(f"no window for render_mode='human': {error}") from error
    if sys.platform != "darwin":  # there MuJoCo says itself what it needs
        # In a thread of its own: one that has an offscreen context current cannot make a window's current.
        with ThreadPoolExecutor(1) as thread:
            complaint = thread.submit(_complaint_about_windows, glfw).result()
        if complaint:
            raise RuntimeError(
                f"no window for render_mode='human': {complaint}. It needs a display with OpenGL, which the "
                "environment variable DISPLAY or WAYLAND_DISPLAY names; render_mode='rgb_array' needs none."
            )
    return cast(Callable[..., Any], launch_passive)


def _complaint_about_windows(glfw: Any) -> str:
    """Why no window can be opened; empty where one can."""
    with warnings.catch_warnings(record=True) as complaints:
        warnings.simplefilter("always")
        if glfw.init():
            glfw.window_hint(glfw.VISIBLE, False)
            window = glfw.create_window(64, 64, "", None, None)
            glfw.default_window_hints()
            if window:
                glfw.destroy_window(window)
                return ""
    return "; ".join(str(complaint.message) for complaint in complaints) or "GLFW does not say why"
