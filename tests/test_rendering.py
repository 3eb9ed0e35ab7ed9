"""Pictures of a scene whose geometry is known, and the window for humans."""

from __future__ import annotations

import contextlib
import sys
from typing import Any

import mujoco
import mujoco.viewer
import numpy as np
import pytest

from asm_gym.envs.rendering import OffscreenRenderer, Window
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
with_opengl = pytest.mark.skipif(rendering_backend() is None, reason="this machine has no OpenGL to render with")


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
    assert picture[24, 32, 0] > picture[24, 32, 2], "the box, red; the shape above it is for collisions alone"
    assert picture[2, 2, 2] > picture[2, 2, 0], "the floor, blue"


@with_opengl
def test_another_model_is_followed_and_closing_twice_is_harmless(renderer: OffscreenRenderer):
    red = renderer.render(*scene())
    green = renderer.render(*scene("0.1 0.9 0.1"))
    assert green[24, 32, 1] > green[24, 32, 0]
    renderer.close()
    renderer.close()
    np.testing.assert_array_equal(renderer.render(*scene()), red)


class FakeViewer:
    """Stands for MuJoCo's viewer; records the times it shows."""

    def __init__(self, model: mujoco.MjModel, data: mujoco.MjData, **_: Any):
        self.m: Any = model
        self.data = data
        self.shown: list[float] = []
        self.cam, self.opt = mujoco.MjvCamera(), mujoco.MjvOption()

    def is_running(self) -> bool:
        return self.m is not None

    def lock(self) -> contextlib.AbstractContextManager[None]:
        return contextlib.nullcontext()

    def sync(self):
        self.shown.append(self.data.time)

    def close(self):
        self.m = None


@pytest.fixture
def viewers(monkeypatch: pytest.MonkeyPatch) -> list[FakeViewer]:
    opened: list[FakeViewer] = []

    def launch(*args: Any, **kwargs: Any) -> FakeViewer:
        opened.append(FakeViewer(*args, **kwargs))
        return opened[-1]

    monkeypatch.setenv("DISPLAY", ":0")
    monkeypatch.setattr(mujoco.viewer, "launch_passive", launch)
    return opened


def test_a_window_shows_every_state_and_follows_another_model(viewers: list[FakeViewer]):
    window = Window("aslant", 0.0)
    for k in range(2):
        model, data = scene()
        for time in (0.1, 0.2):
            data.time = time
            window.show(model, data)
        assert viewers[k].is_running()
        assert len(viewers) == k + 1
        assert viewers[k].shown == [0.1, 0.2]
        assert viewers[k].data is not data, "what is done in the window must not reach the simulation"
        assert viewers[k].cam.fixedcamid == model.camera("aslant").id
    assert not viewers[0].is_running()
    window.close()
    window.close()
    assert not viewers[1].is_running()


@pytest.mark.skipif(sys.platform != "linux", reason="other systems always have a display")
def test_without_a_display_the_error_says_what_is_missing(monkeypatch: pytest.MonkeyPatch):
    for name in ("DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)
    with pytest.raises(RuntimeError, match="DISPLAY"):
        Window("above", 0.0).show(*scene())
