"""A strip chart of surprise under a picture: pure drawing, arrays in and arrays out.

The chart scrolls to the left, the latest step at its right edge. Its vertical axis is logarithmic and fixed in units
of the threshold, so that a film does not rescale under the eye. Nothing is told by colour alone: an alarm is a frame
and a word, a fault a bar with its name.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property, lru_cache
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont

from asm_gym.episode import spans

_PAPER, _INK, _FAINT, _RULE = "#14171c", "#f2f2f2", "#a0a8b2", "#343a42"
_CURVE, _ALARM, _FAULT = "#56B4E9", "#FF4B3E", "#E69F00"
_LOW, _HIGH = 0.03, 30.0  # the vertical axis, in thresholds
_SCALE = 2  # curves are drawn at twice the size and averaged down


class StripChart:
    """The chart's size and axes; what it shows is given to :meth:`draw`.

    Args:
        width: [px].
        height: [px].
        steps: control steps shown.
        threshold: what surprise must exceed for an alarm, > 0.
    """

    def __init__(self, width: int, height: int = 96, steps: int = 100, threshold: float = 1.0) -> None:
        if width < 64 or height < 32:
            raise ValueError(f"a strip chart needs at least 64 x 32 pixels, got {width} x {height}")
        if steps < 2:
            raise ValueError(f"steps must be at least 2, got {steps}")
        if not (np.isfinite(threshold) and threshold > 0):
            raise ValueError(f"threshold must be finite and > 0 on a log axis, got {threshold}")
        self.width, self.height, self.steps, self.threshold = width, height, steps, float(threshold)
        self._bar = max(12, height // 7)  # [px] height of the fault's bar, and of the alarm's

    def draw(
        self,
        surprise: Sequence[float] | NDArray[np.floating[Any]],
        alarm: Sequence[bool] | NDArray[np.bool_],
        fault: Sequence[bool] | NDArray[np.bool_],
    ) -> NDArray[np.uint8]:
        """The chart after the last step of the histories.

        Args:
            surprise: (n,) from the first step or later; only the last ``steps`` are drawn. May be infinite.
            alarm: (n,) in alarm.
            fault: (n,) truly faulty.

        Returns:
            (height, width, 3) uint8.
        """
        values = np.asarray(surprise[-self.steps :], np.float64)  # (m,)
        alarms, faults = (np.asarray(a[-self.steps :], np.bool_) for a in (alarm, fault))
        if not len(values) == len(alarms) == len(faults):
            raise ValueError(f"histories differ in length: {len(values)}, {len(alarms)}, {len(faults)}")
        image = self._background.copy()
        pen = ImageDraw.Draw(image)
        for start, stop in spans(faults):
            pen.rectangle(self._box(start, stop, len(values), 0), fill=_FAULT)
        for start, stop in spans(alarms):
            pen.rectangle(self._box(start, stop, len(values), self.height - self._bar), fill=_ALARM)
        ends = self._x(np.arange(len(values)) + 1, len(values))
        points = (np.column_stack([ends, self._y(values / self.threshold)]) * _SCALE).ravel().tolist()
        if len(values) > 1:
            pen.line(points, fill=_CURVE, width=2 * _SCALE, joint="curve")
        image = image.reduce(_SCALE)
        small = max(10, self._bar - 3)
        for ratio, text in ((10.0, "× 10"), (1.0, "threshold"), (0.1, "× 0.1")):
            _paste(image, _text(text, small, _INK if ratio == 1.0 else _FAINT), 3, float(self._y(ratio)))
        for name, runs, top, paper in (
            ("fault", spans(faults), 0, _FAULT),
            ("alarm", spans(alarms), self.height - self._bar, _ALARM),
        ):
            text_image = _text(name, small, "#000000", paper)
            for start, stop in runs:
                left, right = (max(0.0, float(self._x(s, len(values)))) for s in (start, stop))
                if right - left > text_image.width:
                    _paste(image, text_image, left, top + self._bar / 2)
        return np.asarray(image)

    @cached_property
    def _background(self) -> Image.Image:
        """Paper, a line at each decade, dashes at the threshold; at the scale of the curves."""
        image = Image.new("RGB", (self.width * _SCALE, self.height * _SCALE), _PAPER)
        pen = ImageDraw.Draw(image)
        for ratio in (0.1, 10.0):
            y = float(self._y(ratio)) * _SCALE
            pen.line([(0, y), (self.width * _SCALE, y)], fill=_RULE, width=_SCALE)
        y = float(self._y(1.0)) * _SCALE
        for x in range(0, self.width * _SCALE, 10 * _SCALE):
            pen.line([(x, y), (x + 6 * _SCALE, y)], fill=_INK, width=_SCALE)
        return image

    def _x(self, step: Any, shown: int) -> Any:
        """[px] of the beginning of a step, or of an array of them; the ``shown``-th ends at the right edge."""
        return self.width * (1.0 - (shown - step) / self.steps)

    def _y(self, ratio: Any) -> Any:
        """[px] of a surprise in thresholds, or of an array of them, between the two bars; NaN at the top."""
        top, bottom = self._bar + 3, self.height - self._bar - 3
        ratio = np.clip(np.where(np.isnan(ratio), _HIGH, ratio), _LOW, _HIGH)
        return bottom - (bottom - top) * np.log(ratio / _LOW) / np.log(_HIGH / _LOW)

    def _box(self, start: int, stop: int, shown: int, top: int) -> tuple[float, float, float, float]:
        left, right = self._x(start, shown) * _SCALE, self._x(stop, shown) * _SCALE
        return left, top * _SCALE, right, (top + self._bar) * _SCALE - 1


def project(
    points: NDArray[np.floating[Any]],
    position: NDArray[np.floating[Any]],
    axes: NDArray[np.floating[Any]],
    fovy: float,
    size: tuple[int, int],
) -> NDArray[np.float64]:
    """(N, 2) where points (N, 3) of the world are in a picture [px]: columns from the left, rows from the top.

    Args:
        position: (3,) of the camera.
        axes: (3, 3) its axes in columns: right, up, and backwards.
        fovy: vertical angle of view [degrees].
        size: (height, width) of the picture [px].
    """
    right, up, back = ((points - position) @ axes).T
    focal = 0.5 * size[0] / np.tan(0.5 * np.deg2rad(fovy))
    return np.stack([0.5 * size[1] - focal * right / back, 0.5 * size[0] + focal * up / back], axis=1)


def arrow(frame: NDArray[np.uint8], ends: NDArray[np.floating[Any]], label: str) -> NDArray[np.uint8]:
    """The picture (H, W, 3) with an arrow from ``ends[0]`` to ``ends[1]`` [px], and a label where it begins."""
    image = Image.fromarray(frame)
    pen, width = ImageDraw.Draw(image), max(3, frame.shape[1] // 120)
    start, tip = np.asarray(ends, np.float64)
    along = (tip - start) / max(float(np.linalg.norm(tip - start)), 1e-9)
    neck, side = tip - 4 * width * along, 2 * width * np.array([-along[1], along[0]])
    pen.line((*start, *neck), fill=_FAULT, width=width)
    pen.polygon([tuple(p) for p in (tip, neck + side, neck - side)], fill=_FAULT)
    text = _text(label, 4 * width, _INK)
    _paste(image, text, start[0] - text.width / 2, start[1] - text.height)
    return np.asarray(image)


def compose(frame: NDArray[np.uint8], chart: NDArray[np.uint8], alarm: bool, caption: str = "") -> NDArray[np.uint8]:
    """The picture with a caption at its top and the chart under it; in alarm, a red border and the word ALARM.

    Args:
        frame: (H, W, 3) uint8.
        chart: (h, W, 3) uint8, from :meth:`StripChart.draw`.
        alarm: in alarm now.
        caption: one line, cut where it does not fit.

    Returns:
        (H + h, W, 3) uint8.
    """
    if frame.ndim != 3 or frame.shape[2] != 3 or frame.dtype != np.uint8:
        raise ValueError(f"frame must be (H, W, 3) uint8, got {frame.shape} {frame.dtype}")
    if chart.shape[1:] != frame.shape[1:]:
        raise ValueError(f"the chart must be as wide as the picture, {frame.shape[1]} px, got {chart.shape[1]} px")
    image = Image.fromarray(np.concatenate([frame, chart]))
    height, width = frame.shape[:2]
    size, margin = max(11, min(18, width // 32)), max(4, width // 100)  # [px]
    if caption:
        picture = _text(_fit(caption, size, width - 5 * margin), size, _INK)
        _paste(image, picture, 2 * margin, 2 * margin + picture.height / 2)
    if alarm:
        ImageDraw.Draw(image).rectangle((0, 0, width - 1, height - 1), outline=_ALARM, width=margin)
        word = _text("ALARM", 2 * size, "#000000", _ALARM)
        _paste(image, word, width - word.width, height - word.height / 2)
    return np.asarray(image)


@lru_cache(maxsize=64)
def _text(text: str, size: int, ink: str, paper: str = _PAPER) -> Image.Image:
    """One line on a backing of its own, readable on any picture; most are the same from frame to frame."""
    font = _font(size)
    ascent, descent = font.getmetrics()
    image = Image.new("RGB", (round(font.getlength(text)) + size // 2, ascent + descent // 2 + 1), paper)
    ImageDraw.Draw(image).text((size // 4, ascent), text, font=font, fill=ink, anchor="ls")
    return image


def _paste(image: Image.Image, text: Image.Image, left: float, middle: float) -> None:
    image.paste(text, (round(left), round(middle - text.height / 2)))


def _fit(text: str, size: int, width: float) -> str:
    """``text``, or as much of its beginning as fits in ``width`` [px], with an ellipsis."""
    font = _font(size)
    if font.getlength(text) <= width:
        return text
    while text and font.getlength(text + "…") > width:
        text = text[:-1]
    return text.rstrip() + "…"


@lru_cache(maxsize=16)
def _font(size: int) -> ImageFont.FreeTypeFont:
    """DejaVu Sans at this size [px]: it comes with matplotlib, and unlike Pillow's own font has Greek and ×."""
    return ImageFont.truetype(str(Path(mpl.get_data_path()) / "fonts/ttf/DejaVuSans.ttf"), size)
