"""Draw a strip chart of surprise under a picture: arrays in and arrays out.

The chart scrolls to the left, the latest step at its right edge. Its vertical axis is logarithmic and fixed in units
of the threshold, so that a film does not rescale. An alarm is a frame and a word, a fault a bar with its name.
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
    """A chart of the last steps of an episode.

    Args:
        width: [px].
        height: [px].
        steps: control steps shown.
    """

    def __init__(self, width: int, height: int = 96, steps: int = 100) -> None:
        if width < 64 or height < 32 or steps < 2:
            raise ValueError(f"a strip chart needs 64 x 32 px and 2 steps at least, got {width} x {height}, {steps}")
        self.width, self.height, self.steps = width, height, steps
        self._bar = max(12, height // 7)  # [px] height of the fault's bar, and of the alarm's

    def draw(
        self,
        ratio: Sequence[float] | NDArray[np.floating[Any]],
        alarm: Sequence[bool] | NDArray[np.bool_],
        fault: Sequence[bool] | NDArray[np.bool_],
    ) -> NDArray[np.uint8]:
        """Return the chart after the last step, (height, width, 3) uint8.

        Args:
            ratio: (n,) surprise in thresholds; may be infinite.
            alarm: (n,) in alarm.
            fault: (n,) a fault was active.
        """
        values = np.asarray(ratio[-self.steps :], np.float64)  # (m,)
        alarms, faults = (np.asarray(a[-self.steps :], np.bool_) for a in (alarm, fault))
        if not len(values) == len(alarms) == len(faults):
            raise ValueError(f"histories differ in length: {len(values)}, {len(alarms)}, {len(faults)}")
        edges = self.width * (1.0 - (len(values) - np.arange(len(values) + 1)) / self.steps)  # [px] of each step
        image = self._background.copy()
        pen = ImageDraw.Draw(image)
        bars = (("fault", spans(faults), 0, _FAULT), ("alarm", spans(alarms), self.height - self._bar, _ALARM))
        for _, runs, top, colour in bars:
            for start, stop in runs:
                left, right, end = edges[start] * _SCALE, edges[stop] * _SCALE, (top + self._bar) * _SCALE - 1
                pen.rectangle((left, top * _SCALE, right, end), fill=colour)
        if len(values) > 1:
            points = np.column_stack([edges[1:], self._y(values)]) * _SCALE
            pen.line(points.ravel().tolist(), fill=_CURVE, width=2 * _SCALE, joint="curve")
        image = image.reduce(_SCALE)
        small = max(10, self._bar - 3)
        for level, text in ((10.0, "× 10"), (1.0, "threshold"), (0.1, "× 0.1")):
            _paste(image, _text(text, small, _INK if level == 1.0 else _FAINT), 3, float(self._y(level)))
        for name, runs, top, colour in bars:
            word = _text(name, small, "#000000", colour)
            for start, stop in runs:
                if edges[stop] - max(0.0, edges[start]) > word.width:
                    _paste(image, word, max(0.0, edges[start]), top + self._bar / 2)
        return np.asarray(image)

    @cached_property
    def _background(self) -> Image.Image:
        """Paper, a line at each decade, dashes at the threshold; at the scale of the curves."""
        image = Image.new("RGB", (self.width * _SCALE, self.height * _SCALE), _PAPER)
        pen, right = ImageDraw.Draw(image), self.width * _SCALE
        for level, colour, dash in ((0.1, _RULE, right), (10.0, _RULE, right), (1.0, _INK, 6 * _SCALE)):
            y = float(self._y(level)) * _SCALE
            for x in range(0, right, dash * 10 // 6):
                pen.line([(x, y), (x + dash, y)], fill=colour, width=_SCALE)
        return image

    def _y(self, ratio: Any) -> Any:
        """[px] of a surprise in thresholds, or of an array of them, between the two bars; NaN at the top."""
        top, bottom = self._bar + 3, self.height - self._bar - 3
        ratio = np.clip(np.where(np.isnan(ratio), _HIGH, ratio), _LOW, _HIGH)
        return bottom - (bottom - top) * np.log(ratio / _LOW) / np.log(_HIGH / _LOW)


def project(
    points: NDArray[np.floating[Any]],
    position: NDArray[np.floating[Any]],
    axes: NDArray[np.floating[Any]],
    fovy: float,
    size: tuple[int, int],
) -> NDArray[np.float64]:
    """Return where points (N, 3) of the world are in a picture [px], (N, 2): columns from the left, rows from the top.

    Args:
        points: [m].
        position: (3,) of the camera [m].
        axes: (3, 3) its axes in columns: right, up, and backwards.
        fovy: vertical angle of view [degrees].
        size: (height, width) of the picture [px].
    """
    right, up, back = ((points - position) @ axes).T
    focal = 0.5 * size[0] / np.tan(0.5 * np.deg2rad(fovy))
    return np.stack([0.5 * size[1] - focal * right / back, 0.5 * size[0] + focal * up / back], axis=1)


def arrow(frame: NDArray[np.uint8], ends: NDArray[np.floating[Any]], label: str) -> NDArray[np.uint8]:
    """Return the picture (H, W, 3) with an arrow from ``ends[0]`` to ``ends[1]`` [px], and a label where it begins."""
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
    """Return the picture with a caption at its top and the chart under it; in alarm, a red border and the word ALARM.

    Args:
        frame: (H, W, 3) uint8.
        chart: (h, W, 3) uint8, from ``StripChart.draw``.
        alarm: in alarm now.
        caption: one line, cut where it does not fit.
    """
    if frame.ndim != 3 or frame.shape[2] != 3 or frame.dtype != np.uint8:
        raise ValueError(f"frame must be (H, W, 3) uint8, got {frame.shape} {frame.dtype}")
    if chart.shape[1:] != frame.shape[1:]:
        raise ValueError(f"the chart must be as wide as the picture, {frame.shape[1]} px, got {chart.shape[1]} px")
    image = Image.fromarray(np.concatenate([frame, chart]))
    height, width = frame.shape[:2]
    size, margin = max(11, min(18, width // 32)), max(4, width // 100)  # [px]
    if caption:
        fitting = caption
        while len(fitting) > 1 and _font(size).getlength(fitting) > width - 5 * margin:
            fitting = fitting[:-2].rstrip() + "…"
        line = _text(fitting, size, _INK)
        _paste(image, line, 2 * margin, 2 * margin + line.height / 2)
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


@lru_cache(maxsize=16)
def _font(size: int) -> ImageFont.FreeTypeFont:
    """DejaVu Sans at this size [px]: it comes with matplotlib, and unlike Pillow's own font has Greek and ×."""
    return ImageFont.truetype(str(Path(mpl.get_data_path()) / "fonts/ttf/DejaVuSans.ttf"), size)
