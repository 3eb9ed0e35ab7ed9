"""Pictures of the simulation, made lazily: an environment that never renders never touches OpenGL."""

from __future__ import annotations

import atexit
import os
import sys
import weakref
from contextlib import suppress
from importlib import import_module
from importlib.util import find_spec
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

_live: weakref.WeakSet[Any] = weakref.WeakSet()


class OffscreenRenderer:
    """Pictures of ``width`` by ``height`` pixels without a display; follows a model's replacement.

    OpenGL comes from EGL, or from OSMesa where the environment variable ``MUJOCO_GL`` says ``osmesa``. Shadows,
    reflections and multisampling are off: on a CPU they cost three times the rest.
    """

    def __init__(self, camera: str, width: int, height: int) -> None:
        self.camera = camera
        self.width = width
        self.height = height
        self._model: mujoco.MjModel | None = None
        self._gl: Any = None
        self._camera = mujoco.MjvCamera()
        self._camera.type = mujoco.mjtCamera.mjCAMERA_FIXED
        self._options = mujoco.MjvOption()
        self._options.geomgroup[0] = 0  # collision shapes

    def render(self, model: mujoco.MjModel, data: mujoco.MjData) -> NDArray[np.uint8]:
        """Return a picture (height, width, 3) uint8; raise RuntimeError where this machine has no OpenGL."""
        self._camera.fixedcamid = model.camera(self.camera).id
        if self._model is not model:
            self._open(model)
        self._gl.make_current()
        mujoco.mjv_updateScene(
            m=model,
            d=data,
            opt=self._options,
            pert=None,
            cam=self._camera,
            catmask=mujoco.mjtCatBit.mjCAT_ALL.value,
            scn=self._scene,
        )
        viewport = mujoco.MjrRect(0, 0, self.width, self.height)
        mujoco.mjr_render(viewport, self._scene, self._context)
        picture = np.empty((self.height, self.width, 3), np.uint8)
        mujoco.mjr_readPixels(picture, None, viewport, self._context)
        return np.flipud(picture).copy()

    def _open(self, model: mujoco.MjModel) -> None:
        self.close()
        self._gl = _gl_context(self.width, self.height)
        _live.add(self)
        # Before OpenGL is cleaned up: the last function that is registered runs first, and OpenGL
        # has registered its own.
        atexit.unregister(_close_all)
        atexit.register(_close_all)
        self._gl.make_current()
        model.vis.quality.offsamples = 0
        model.vis.global_.offwidth = self.width
        model.vis.global_.offheight = self.height
        self._scene = mujoco.MjvScene(model, maxgeom=10_000)
        for flag in (mujoco.mjtRndFlag.mjRND_SHADOW, mujoco.mjtRndFlag.mjRND_REFLECTION):
            self._scene.flags[flag] = 0
        self._context = mujoco.MjrContext(model, mujoco.mjtFontScale.mjFONTSCALE_150.value)
        mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN.value, self._context)
        self._model = model

    def close(self) -> None:
        """Free the OpenGL context; may be called more than once."""
        if self._gl is not None:
            if self._model is not None:
                self._context.free()
            self._gl.free()
        self._gl = None
        self._model = None


def _close_all() -> None:
    for renderer in list(_live):
        renderer.close()


def _gl_context(width: int, height: int) -> Any:
    """Return an OpenGL context that needs no display.

    Raises RuntimeError where this machine has none.
    """
    # PyTorch's CUDA builds bring triton, whose LLVM ends the process when it is loaded after
    # Mesa's; before it is fine.
    if find_spec("triton") is not None:
        with suppress(ImportError):
            import_module("triton")
    try:
        # mujoco.Renderer would take GLFW here, which needs a display, unless MUJOCO_GL was set
        # before MuJoCo's import.
        if sys.platform == "darwin":
            from mujoco.cgl import GLContext
        elif os.environ.get("MUJOCO_GL", "").lower() == "osmesa":
            from mujoco.osmesa import GLContext
        else:
            from mujoco.egl import GLContext
        return GLContext(width, height)
    except (ImportError, RuntimeError, AttributeError, OSError) as error:
        raise RuntimeError(
            f"no OpenGL for rendering: {error}. `asm-gym doctor` says which "
            "library is missing and how to get it."
        ) from error
