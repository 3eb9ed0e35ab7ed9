"""Pictures of a scene whose geometry is known."""

from __future__ import annotations

from typing import Any

import mujoco
import numpy as np
import pytest

from asm_gym.envs.rendering import OffscreenRenderer
from asm_gym.graphics import rendering_backend

SCENE = """
<mujoco>
  <statistic extent="3"/>
  <visual><map znear="0.01" zfar="30"/></visual>
  <worldbody>
    <light pos="0 0 3"/>
    <camera name="above" pos="0 0 2"/>
    <camera name="aslant" pos="0 -2 1.5" xyaxes="1 0 0 0 0.6 0.8"/>
    <geom type="plane" size="5 5 0.1" group="1" rgba="0.2 0.2 0.8 1"/>
    <geom type="box" size="0.3 0.2 0.25" pos="0 0 0.25" group="1" rgba="{} 1"/>
    <geom type="box" size="1 1 0.1" pos="0 0 1" group="0"/>
  </worldbody>
</mujoco>
"""
with_opengl = pytest.mark.skipif(
    rendering_backend() is None, reason="this machine has no OpenGL to render with"
)


def scene(colour: str = "0.9 0.1 0.1") -> tuple[mujoco.MjModel, mujoco.MjData]:
    model = mujoco.MjModel.from_xml_string(SCENE.format(colour))
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    return model, data


@pytest.fixture
def renderer() -> Any:
    renderer = OffscreenRenderer("above", 64, 48)
    yield renderer
    renderer.close()


@with_opengl
def test_a_picture_shows_the_scene_without_its_collision_shapes(renderer: OffscreenRenderer):
    picture = renderer.render(*scene())
    assert picture.shape == (48, 64, 3)
    assert picture.dtype == np.uint8
    assert picture[24, 32, 0] > picture[24, 32, 2], (
        "the box, red; the shape above it is for collisions alone"
    )
    assert picture[2, 2, 2] > picture[2, 2, 0], "the floor, blue"


@with_opengl
def test_another_model_is_followed_and_closing_twice_is_harmless(renderer: OffscreenRenderer):
    red = renderer.render(*scene())
    green = renderer.render(*scene("0.1 0.9 0.1"))
    assert green[24, 32, 1] > green[24, 32, 0]
    renderer.close()
    renderer.close()
    np.testing.assert_array_equal(renderer.render(*scene()), red)
