"""Draw a strip chart of surprise under every rendered picture.

The latest step stands at the right edge. The vertical axis is logarithmic and in units of the threshold.
"""

from __future__ import annotations

from functools import lru_cache
from pathlib import Path
from typing import Any, NamedTuple, SupportsFloat

import gymnasium as gym
import matplotlib as mpl
import numpy as np
from gymnasium.utils import RecordConstructorArgs
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont

from asm_gym.data.episode import spans
from asm_gym.spec import control_period
from asm_gym.validation import check_text

SURE = 0.9  # least probability at which a cause is named

PAPER, INK, FAINT, RULE = "#14171c", "#f2f2f2", "#a0a8b2", "#343a42"
CURVE, ALARM, FAULT = "#56B4E9", "#FF4B3E", "#E69F00"

SECONDS = 5.0  # time that the chart shows [s]
LOW, HIGH = 0.03, 30.0  # the vertical axis, in thresholds
LEVELS = ((10.0, "× 10", RULE, FAINT), (1.0, "threshold", INK, INK), (0.1, "× 0.1", RULE, FAINT))  # its marks


class Step(NamedTuple):
    """What is drawn of a control step; ``ratio`` is surprise in thresholds, and may be infinite."""

    ratio: float
    alarm: bool
    fault: bool


class SurpriseOverlay(gym.Wrapper[Any, Any, Any, Any], RecordConstructorArgs):
    """Draw surprise, threshold, alarm and ground-truth fault under the pictures of a guarded environment.

    Put it over ``NeuralASMSafety``, and under ``RecordVideo``. It changes nothing but what ``render`` returns.

    Args:
        env: an environment with ``render_mode="rgb_array"``.
        caption: a name for the episode, such as the condition.
    """

    def __init__(self, env: gym.Env[Any, Any], caption: str = "") -> None:
        RecordConstructorArgs.__init__(self, caption=caption)
        gym.Wrapper.__init__(self, env)
        if env.render_mode != "rgb_array":
            raise ValueError(
                f'SurpriseOverlay draws on pictures and needs render_mode="rgb_array", got {env.render_mode!r}: '
                'make the environment with gym.make(..., render_mode="rgb_array")'
            )
        self.caption = caption if isinstance(caption, str) and not caption else check_text("caption", caption)
        self._dt = control_period(env)
        self._shown = max(2, round(SECONDS / self._dt))  # steps
        self._clear()

    def _clear(self) -> None:
        self._steps: list[Step] = []
        self._intervened = False
        self._cause = self._completed = ""

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        observation, info = self.env.reset(seed=seed, options=options)
        self._clear()
        return observation, info

    def step(self, action: Any) -> tuple[Any, SupportsFloat, bool, bool, dict[str, Any]]:
        observation, reward, terminated, truncated, info = self.env.step(action)
        asm = info.get("asm")
        if asm is None:
            raise KeyError(
                'SurpriseOverlay found no info["asm"]: put it over NeuralASMSafety, '
                f"as in SurpriseOverlay(NeuralASMSafety(env, monitor)); it is over {self.env}"
            )
        ratio = float(asm["surprise"]) / float(asm["threshold"])
        self._steps.append(Step(ratio, bool(asm["alarm"]), bool(info.get("fault"))))
        self._intervened = bool(asm["intervened"])
        cause = asm.get("cause") or {}
        if cause.get("family"):
            sure = cause["family"] != "unknown" and cause["probability"] >= SURE
            self._cause = " ".join(filter(None, (cause["family"], cause["part"]))) if sure else ""
        completed = asm.get("completed") or ()
        self._completed = f"{', '.join(completed)} completed" if completed else ""
        return observation, reward, terminated, truncated, info

    def render(self) -> NDArray[np.uint8]:
        """Return the picture with the chart under it, (H + H/4, W, 3) uint8."""
        frame = np.asarray(self.env.render())
        height, width = frame.shape[:2]
        chart = strip_chart(width, max(72, height // 4), self._steps[-self._shown :], self._shown)
        picture = np.concatenate([frame, chart])
        return annotated(picture, height, self.line(), bool(self._steps and self._steps[-1].alarm))

    def line(self) -> str:
        """Return the line of text at the top of the picture."""
        time = f"{len(self._steps) * self._dt:.2f} s"
        acting = "override acting" if self._intervened else "policy acting"
        return "   ".join(part for part in (self.caption, time, acting, self._completed or self._cause) if part)


def strip_chart(width: int, height: int, history: list[Step], shown: int) -> NDArray[np.uint8]:
    """Return a chart (height, width, 3) of the last steps, of which ``shown`` go from edge to edge; sizes in [px]."""
    bar = max(12, height // 7)  # [px] height of the fault's bar, and of the alarm's
    top, bottom = bar + 3, height - bar - 3

    def y(ratio: Any) -> Any:
        """[px] of a surprise in thresholds; NaN at the top."""
        ratio = np.clip(np.where(np.isnan(ratio), HIGH, ratio), LOW, HIGH)
        return bottom - (bottom - top) * np.log(ratio / LOW) / np.log(HIGH / LOW)

    image = Image.new("RGB", (width, height), PAPER)
    pen = ImageDraw.Draw(image)
    for level, _, line, _ in LEVELS:
        pen.line([(0, y(level)), (width, y(level))], fill=line)
    edges = width * (1.0 - (len(history) - np.arange(len(history) + 1)) / shown)  # [px] of each step
    for name, above, colour in (("fault", 0, FAULT), ("alarm", height - bar, ALARM)):
        for start, stop in spans(np.array([getattr(step, name) for step in history], bool)):
            pen.rectangle((edges[start], above, edges[stop] - 1, above + bar - 1), fill=colour)
    if len(history) > 1:
        points = np.column_stack([edges[1:], y(np.array([step.ratio for step in history]))])
        pen.line(points.ravel().tolist(), fill=CURVE, width=2, joint="curve")
    for level, text, _, ink in LEVELS:
        _paste(image, _text(text, max(10, bar - 3), ink), 3, float(y(level)))
    return np.asarray(image)


def annotated(picture: NDArray[np.uint8], height: int, line: str, alarm: bool) -> NDArray[np.uint8]:
    """Return a picture with a line of text at its top; in alarm, its first ``height`` rows [px] get a red border."""
    image, width = Image.fromarray(picture), picture.shape[1]
    size, margin = max(11, min(18, width // 32)), max(4, width // 100)  # [px]
    while len(line) > 1 and _font(size).getlength(line) > width - 5 * margin:
        line = line[:-2].rstrip() + "…"
    text = _text(line, size, INK)
    _paste(image, text, 2 * margin, 2 * margin + text.height / 2)
    if alarm:
        ImageDraw.Draw(image).rectangle((0, 0, width - 1, height - 1), outline=ALARM, width=margin)
        word = _text("ALARM", 2 * size, "#000000", ALARM)
        _paste(image, word, width - word.width, height - word.height / 2)
    return np.asarray(image)


@lru_cache(maxsize=64)
def _text(text: str, size: int, ink: str, paper: str = PAPER) -> Image.Image:
    """Return one line on a background of its own, readable on any picture."""
    font = _font(size)
    ascent, descent = font.getmetrics()
    image = Image.new("RGB", (round(font.getlength(text)) + size // 2, ascent + descent // 2 + 1), paper)
    ImageDraw.Draw(image).text((size // 4, ascent), text, font=font, fill=ink, anchor="ls")
    return image


def _paste(image: Image.Image, text: Image.Image, left: float, middle: float) -> None:
    image.paste(text, (round(left), round(middle - text.height / 2)))


@lru_cache(maxsize=16)
def _font(size: int) -> ImageFont.FreeTypeFont:
    """Return DejaVu Sans at this size [px]: it comes with matplotlib, and unlike Pillow's own font has Greek and ×."""
    return ImageFont.truetype(str(Path(mpl.get_data_path()) / "fonts/ttf/DejaVuSans.ttf"), size)
