"""The overlay's pixels, over a scripted environment."""

from __future__ import annotations

from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from numpy.typing import NDArray
from PIL import ImageColor

from asm_gym.wrappers import overlay
from asm_gym.wrappers.overlay import Step, SurpriseOverlay, strip_chart

RED, ORANGE, CURVE, INK = (
    np.array(ImageColor.getrgb(c)) for c in (overlay.ALARM, overlay.FAULT, overlay.CURVE, overlay.INK)
)
GREY = np.full((120, 200, 3), 128, np.uint8)


def has(picture: NDArray[np.uint8], colour: NDArray[Any]) -> NDArray[np.bool_]:
    """(H, W) where the picture has exactly this colour."""
    return (picture == colour).all(axis=-1)


def chart(ratios, alarm=(), fault=(), shown=10):
    """A chart in whose steps of ``alarm`` and ``fault`` these were active."""
    return strip_chart(200, 120, [Step(r, k in alarm, k in fault) for k, r in enumerate(ratios)], shown)


def height_of_curve(picture: NDArray[np.uint8]) -> float:
    """[px] mean row of the curve in the rightmost quarter."""
    return float(np.nonzero(has(picture[:, -50:], CURVE))[0].mean())


def test_the_curve_at_the_threshold_lies_on_the_dashes_and_one_without_bounds_in_the_chart():
    dashes = np.nonzero(has(chart([])[:, 150:], INK).any(axis=1))[0]
    at_threshold = height_of_curve(chart([1.0] * 10))
    assert at_threshold == pytest.approx(dashes.mean(), abs=1.0)
    top, bottom = (height_of_curve(chart([1, x, x, x], shown=4)) for x in (np.inf, 0))
    assert 0 < top < at_threshold < bottom < 120
    assert height_of_curve(chart([1, np.nan, np.nan, np.nan], shown=4)) == top


def test_bars_stand_where_fault_and_alarm_were():
    picture = chart([1] * 10, alarm=(8, 9), fault=(5, 6, 7))
    for colour, first, last in ((ORANGE, 100, 159), (RED, 160, 199)):  # each step is 20 px wide
        columns = np.flatnonzero(has(picture, colour).any(axis=0))
        assert (columns.min(), columns.max()) == pytest.approx((first, last), abs=1)
    assert not has(chart([1] * 10), ORANGE).any()


class ScriptedEnv(gym.Env[Any, Any]):
    """Reports what it is told to report, step by step: dicts of info."""

    metadata = {"render_modes": ["rgb_array", "human"], "render_fps": 10}  # noqa: RUF012
    dt = 0.1
    observation_space = gym.spaces.Box(-1, 1, (1,), np.float32)
    action_space = gym.spaces.Box(-1, 1, (1,), np.float32)

    def __init__(self, script: list[dict[str, Any]] | None = None, render_mode: str | None = "rgb_array") -> None:
        self.script = script or []
        self.render_mode = render_mode

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        super().reset(seed=seed)
        self.left = list(self.script)
        return np.zeros(1, np.float32), {}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        return np.zeros(1, np.float32), 1.5, False, False, self.left.pop(0)

    def render(self) -> NDArray[np.uint8]:  # type: ignore[override]
        return GREY.copy()


def report(surprise: float = 1.0, alarm: bool = False, fault: Any = None, **more: Any) -> dict[str, Any]:
    asm = {"surprise": surprise, "threshold": 4.0, "alarm": alarm, "intervened": alarm} | more
    return {"asm": asm} if fault is None else {"asm": asm, "fault": fault}


def played(script: list[dict[str, Any]], **arguments: Any) -> SurpriseOverlay:
    env = SurpriseOverlay(ScriptedEnv(script), **arguments)
    env.reset(seed=0)
    for _ in script:
        env.step(np.zeros(1, np.float32))
    return env


def test_a_rendered_frame_shows_alarm_and_fault():
    calm = played([report()] * 5).render()
    faulty = played([report()] * 4 + [report(9.0, True, fault=("push",))]).render()
    assert calm.shape == faulty.shape == (192, 200, 3)
    assert not has(calm, RED).any()
    assert not has(calm, ORANGE).any()
    assert has(faulty[:120], RED)[0].all()  # a border
    assert has(faulty[90:115, 100:195], np.zeros(3)).sum() > 50  # a word in black on red
    assert has(faulty[120:], ORANGE).any()


@pytest.mark.parametrize(
    ("family", "probability", "named"),
    [("contact", 0.95, True), ("contact", 0.85, False), ("unknown", 0.95, False)],
)
def test_a_cause_is_named_only_where_it_is_sure(family: str, probability: float, named: bool):
    line = played([report(9.0, True, cause={"family": family, "part": "body", "probability": probability})]).line()
    assert ("contact body" in line) is named
    assert "unknown" not in line


def test_the_chart_is_in_units_of_the_threshold_and_five_seconds_long():
    env = played([report(8.0)] * 80)
    assert np.array_equal(env.render()[120:], strip_chart(200, 72, [Step(2.0, False, False)] * 50, 50))


def test_reset_clears_every_trace_of_the_last_episode():
    env = played([report(9.0, True, fault=("push",))] * 5, caption="push")
    fresh = SurpriseOverlay(ScriptedEnv(), caption="push")
    fresh.reset()
    env.reset()
    assert np.array_equal(env.render(), fresh.render())


def test_the_step_passes_through_untouched():
    env = SurpriseOverlay(ScriptedEnv([info := report(2.0, fault=("push",))]))
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
