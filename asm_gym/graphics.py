"""Whether this machine can draw without a screen.

Nothing looked for here is imported here: the answer has to come where ``import robosuite`` fails.
"""

from __future__ import annotations

import os
import subprocess
import sys
from functools import cache

BACKENDS = ("egl", "osmesa")  # values of ``MUJOCO_GL``; EGL first: it uses a GPU where there is one
GET_RENDERING = "apt-get install libegl1 libgl1 libgl1-mesa-dri (or libosmesa6)"

# A lit white ball on black: a driver that draws nothing returns a frame of one colour.
ONE_FRAME = """
import mujoco
ball = (
    "<mujoco><worldbody><light pos='0 0 3'/>"
    "<geom size='.1' rgba='1 1 1 1'/></worldbody></mujoco>"
)
model = mujoco.MjModel.from_xml_string(ball)
data = mujoco.MjData(model)
mujoco.mj_forward(model, data)
with mujoco.Renderer(model, 32, 32) as renderer:
    renderer.update_scene(data)
    frame = renderer.render()  # (32, 32, 3) uint8
assert frame.min() < frame.max(), "the frame is one colour"
"""


@cache
def rendering_backend() -> str | None:
    """Return the first backend with which MuJoCo draws a frame here; None where none does."""
    return next((backend for backend in BACKENDS if draws_a_frame(backend)), None)


def draws_a_frame(backend: str) -> bool:
    """Return whether MuJoCo draws one frame with ``MUJOCO_GL=backend``.

    It draws in another process, as no choice can be undone.
    """
    env = os.environ | {"MUJOCO_GL": backend}
    env.pop("PYOPENGL_PLATFORM", None)
    command = [sys.executable, "-c", ONE_FRAME]
    # A driver may wait for a device for ever; a busy machine imports mujoco in tens of seconds.
    try:
        drawn = subprocess.run(command, env=env, capture_output=True, timeout=120, check=False)
    except subprocess.TimeoutExpired:
        return False
    return drawn.returncode == 0
