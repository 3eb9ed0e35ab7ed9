"""The strip chart's pixels, and the wrapper over a scripted environment."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from numpy.typing import NDArray
from PIL import ImageColor

from asm_gym import FaultInjection
from asm_gym.faults import Push
from asm_gym.wrappers import chart as drawing
from asm_gym.wrappers.chart import StripChart, arrow, compose, project
from asm_gym.wrappers.overlay import SurpriseOverlay

RED, ORANGE, CURVE = (np.array(ImageColor.getrgb(c)) for c in (drawing._ALARM, drawing._FAULT, drawing._CURVE))
GREY = np.full((120, 200, 3), 128, np.uint8)


def has(picture: NDArray[np.uint8], colour: NDArray[Any]) -> NDArray[np.bool_]:
    """(H, W) where the picture has exactly this colour."""
    return (picture == colour).all(axis=-1)


def height_of_curve(picture: NDArray[np.uint8]) -> float:
    """[px] mean row of the curve in the rightmost quarter."""
    rows, _ = np.nonzero(has(picture[:, -50:], CURVE))
    return float(rows.mean())


def test_the_curve_at_the_threshold_lies_on_the_dashes():
    chart = StripChart(200, 120, steps=10)
    empty = chart.draw([], [], [])
    dashes = np.nonzero(has(empty[:, 150:], np.array(ImageColor.getrgb(drawing._INK))).any(axis=1))[0]
    curve = height_of_curve(chart.draw([1.0] * 10, [False] * 10, [False] * 10))
    assert curve == pytest.approx(dashes.mean(), abs=1.0)


def test_surprise_without_bounds_stays_in_the_chart():
    chart = StripChart(200, 120, steps=4)
    top = height_of_curve(chart.draw([1, np.inf, np.inf, np.inf], [False] * 4, [False] * 4))
    bottom = height_of_curve(chart.draw([1, 0, 0, 0], [False] * 4, [False] * 4))
    assert 0 < top < bottom < 120
    assert height_of_curve(chart.draw([1, np.nan, np.nan, np.nan], [False] * 4, [False] * 4)) == top


def test_bars_stand_where_fault_and_alarm_were():
    chart = StripChart(200, 120, steps=10)
    picture = chart.draw([1] * 10, [False] * 8 + [True] * 2, [False] * 5 + [True] * 3 + [False] * 2)
    columns = np.flatnonzero(has(picture, ORANGE).any(axis=0))
    assert (columns.min(), columns.max()) == pytest.approx((100, 159), abs=1)  # steps 5 to 7, of 20 px each
    columns = np.flatnonzero(has(picture, RED).any(axis=0))
    assert (columns.min(), columns.max()) == pytest.approx((160, 199), abs=1)
    assert not has(chart.draw([1] * 10, [False] * 10, [False] * 10), ORANGE).any()


def test_an_alarm_is_a_border_and_a_word_on_the_picture():
    chart = StripChart(200, 40).draw([], [], [])
    calm, alarmed = compose(GREY, chart, alarm=False), compose(GREY, chart, alarm=True)
    assert calm.shape == alarmed.shape == (160, 200, 3)
    assert np.array_equal(calm[:120], GREY)
    assert np.array_equal(calm[120:], chart)
    border = has(alarmed[:120], RED)
    assert border[0].all()
    assert border[:, 0].all()
    word = alarmed[90:115, 100:195]
    assert has(word, np.zeros(3)).sum() > 50  # black letters on red


def test_points_are_seen_where_a_pinhole_camera_sees_them():
    axes = np.array([[0, 0, 1], [1, 0, 0], [0, 1, 0]], float)  # at x = 2, looking back along x; z is up
    points = np.array([[0, 0, 0], [0, 1, 0], [0, 0, 1.0]])
    seen = project(points, np.array([2.0, 0, 0]), axes, 90.0, (100, 200))
    np.testing.assert_allclose(seen, [[100, 50], [125, 50], [100, 25]])


def test_an_arrow_is_drawn_from_its_label_to_its_tip():
    plain = np.zeros((120, 240, 3), np.uint8)
    drawn = arrow(plain, np.array([[60.0, 80.0], [180.0, 80.0]]), "20 N")
    inked = np.flatnonzero(drawn[80].any(axis=1))
    assert 55 <= inked.min() <= 62
    assert 175 <= inked.max() <= 181
    assert not plain.any()


def test_what_cannot_be_drawn_is_refused():
    for width, steps in ((10, 10), (100, 1)):
        with pytest.raises(ValueError, match="needs 64 x 32 px and 2 steps at least"):
            StripChart(width, steps=steps)


class ScriptedEnv(gym.Env[Any, Any]):
    """Says what it is told to say, step by step: dicts of info."""

    metadata = {"render_modes": ["rgb_array", "human"], "render_fps": 20}  # noqa: RUF012
    observation_space = gym.spaces.Box(-1, 1, (1,), np.float32)
    action_space = gym.spaces.Box(-1, 1, (1,), np.float32)

    def __init__(self, script: list[dict[str, Any]] | None = None, render_mode: str | None = "rgb_array") -> None:
        self.script = script or []
        self.render_mode = render_mode
        self.stream_spec = SimpleNamespace(dt=0.1)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        super().reset(seed=seed)
        self.left = list(self.script)
        return np.zeros(1, np.float32), {}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        return np.zeros(1, np.float32), 1.5, False, False, self.left.pop(0)

    def render(self) -> NDArray[np.uint8]:  # type: ignore[override]
        return GREY.copy()


def says(surprise: float = 1.0, alarm: bool = False, fault: Any = None, intervened: bool = False) -> dict[str, Any]:
    asm = {"surprise": surprise, "threshold": 4.0, "alarm": alarm, "intervened": intervened}
    return {"asm": asm} if fault is None else {"asm": asm, "fault": fault}


class AddSays(gym.Wrapper[Any, Any, Any, Any]):
    """Any environment, watched by nobody."""

    def step(self, action: Any) -> Any:
        *out, info = self.env.step(action)
        return *out, info | says()


def played(script: list[dict[str, Any]], **arguments: Any) -> SurpriseOverlay:
    env = SurpriseOverlay(ScriptedEnv(script), **arguments)
    env.reset(seed=0)
    for _ in script:
        env.step(np.zeros(1, np.float32))
    return env


def test_a_rendered_frame_shows_alarm_and_fault():
    calm = played([says()] * 5).render()
    faulty = played([says()] * 4 + [says(9.0, True, fault=("push",))]).render()
    assert calm.shape == faulty.shape == (192, 200, 3)
    assert not has(calm, RED).any()
    assert not has(calm, ORANGE).any()
    assert has(faulty[:120], RED)[0].all()
    assert has(faulty[120:], ORANGE).any()


@pytest.mark.parametrize(
    ("family", "probability", "named"),
    [("contact", 0.95, True), ("contact", 0.85, False), ("unknown", 0.95, False)],
)
def test_a_cause_is_named_only_where_it_is_sure(family: str, probability: float, named: bool):
    said = says(9.0, True)
    said["asm"]["cause"] = {"family": family, "part": "body", "probability": probability}
    assert ("contact body" in played([said])._line()) is named
    assert "unknown" not in played([said])._line()


def test_a_push_is_an_arrow_while_it_acts_and_no_longer():
    push = Push(newtons=20, onset=2, duration=2)
    env = gym.make("asm_gym/Lift-v0", render_mode="rgb_array", render_size=(192, 240), camera="frontview")
    with SurpriseOverlay(AddSays(FaultInjection(env, [push])), camera="frontview") as watched:
        watched.reset(seed=0)
        seen = []
        for _ in range(6):
            watched.step(np.zeros(7, np.float32))
            seen.append(has(watched.render()[:192], ORANGE).any())
    assert seen == [False, False, True, True, False, False]


def test_the_chart_is_in_units_of_the_threshold_and_as_long_as_asked():
    env = played([says(8.0)] * 40, seconds=2.0)
    strip = StripChart(200, 72, steps=20).draw([2.0] * 20, [False] * 20, [False] * 20)
    assert np.array_equal(env.render()[120:], strip)


def test_reset_clears_every_trace_of_the_last_episode():
    env = played([says(9.0, True, fault=("push",), intervened=True)] * 5, caption="push")
    fresh = SurpriseOverlay(ScriptedEnv(), caption="push")
    fresh.reset()
    env.reset()
    assert np.array_equal(env.render(), fresh.render())


def test_the_step_passes_through_untouched():
    env = SurpriseOverlay(ScriptedEnv([info := says(2.0, fault=("push",))]))
    env.reset()
    before = {**info, "asm": dict(info["asm"])}
    _, reward, terminated, truncated, after = env.step(np.zeros(1, np.float32))
    assert (reward, terminated, truncated) == (1.5, False, False)
    assert after is info
    assert after == before


@pytest.mark.parametrize("mode", [None, "human"])
def test_it_needs_pictures(mode: str | None):
    with pytest.raises(ValueError, match=f'needs render_mode="rgb_array", got {mode!r}'):
        SurpriseOverlay(ScriptedEnv(render_mode=mode))


def test_it_needs_a_monitor_underneath():
    env = SurpriseOverlay(ScriptedEnv([{}]))
    env.reset()
    with pytest.raises(KeyError, match="put it over NeuralASMSafety"):
        env.step(np.zeros(1, np.float32))


def test_the_spec_makes_it_again():
    gym.register("asm_gym_test/Scripted-v0", entry_point=ScriptedEnv)
    try:
        env = SurpriseOverlay(
            gym.make("asm_gym_test/Scripted-v0", render_mode="rgb_array"), caption="push", seconds=3.0
        )
        assert env.spec is not None
        again = gym.make(env.spec)
        assert isinstance(again, SurpriseOverlay)
        assert again.spec == env.spec
        assert again.caption == "push"
    finally:
        del gym.registry["asm_gym_test/Scripted-v0"]
