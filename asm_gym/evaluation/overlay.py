"""A strip chart of surprise under a picture: pure drawing, arrays in and arrays out.

The chart scrolls to the left, the latest step at its right edge. Its vertical axis is logarithmic and fixed in units
of the threshold, so that a film does not rescale under the eye. Nothing is told by colour alone: an alarm is a frame
and a word, a fault a bar with its name.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont

from asm_gym.evaluation.trace import spans

_PAPER, _INK, _FAINT = "#14171c", "#f2f2f2", "#8a919c"
_CURVE, _ALARM, _FAULT = "#56B4E9", "#FF4B3E", "#E69F00"
_LOW, _HIGH = 1e-2, 30.0  # the vertical axis, in thresholds
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
        image = Image.new("RGB", (self.width * _SCALE, self.height * _SCALE), _PAPER)
        pen = ImageDraw.Draw(image)
        for start, stop in spans(faults):
            pen.rectangle(self._box(start, stop, len(values), 0), fill=_FAULT)
        for start, stop in spans(alarms):
            pen.rectangle(self._box(start, stop, len(values), self.height - self._bar), fill=_ALARM)
        y = self._y(1.0)
        for x in range(0, self.width, 10):
            pen.line([(x * _SCALE, y * _SCALE), ((x + 6) * _SCALE, y * _SCALE)], fill=_INK, width=_SCALE)
        points = [
            (self._x(i + 1, len(values)) * _SCALE, self._y(v) * _SCALE) for i, v in enumerate(values / self.threshold)
        ]
        if len(points) > 1:
            pen.line(points, fill=_CURVE, width=2 * _SCALE, joint="curve")
        image = image.reduce(_SCALE)
        pen = ImageDraw.Draw(image)
        small = _font(max(10, self._bar - 2))
        _label(pen, (6, y - 2), "threshold", small, _INK, "ls")
        _label(pen, (6, self.height - self._bar - 2), "surprise, log scale", small, _FAINT, "ls")
        for name, runs, top in (("fault", spans(faults), 0), ("alarm", spans(alarms), self.height - self._bar)):
            for start, stop in runs:
                left, right = (max(4.0, self._x(s, len(values))) for s in (start, stop))
                if right - left > small.getlength(name) + 8:
                    pen.text((left + 4, top + self._bar / 2), name, font=small, fill="black", anchor="lm")
        return np.asarray(image)

    def _x(self, step: int, shown: int) -> float:
        """[px] of the beginning of a step, the ``shown``-th ending at the right edge."""
        return self.width * (1.0 - (shown - step) / self.steps)

    def _y(self, ratio: float) -> float:
        """[px] of a surprise in thresholds, between the two bars."""
        top, bottom = self._bar + 3, self.height - self._bar - 3
        height = np.log(np.clip(np.nan_to_num(ratio, nan=_HIGH), _LOW, _HIGH) / _LOW) / np.log(_HIGH / _LOW)
        return float(bottom - (bottom - top) * height)

    def _box(self, start: int, stop: int, shown: int, top: int) -> tuple[float, float, float, float]:
        left, right = self._x(start, shown) * _SCALE, self._x(stop, shown) * _SCALE
        return left, top * _SCALE, right, (top + self._bar) * _SCALE - 1


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
    pen = ImageDraw.Draw(image)
    size = max(11, min(20, width // 30))
    margin = max(4, width // 100)
    font = _font(size)
    if caption:
        text = _fit(caption, font, width - 4 * margin)
        _label(pen, (2 * margin, 2 * margin), text, font, _INK, "la")
    if alarm:
        pen.rectangle((0, 0, width - 1, height - 1), outline=_ALARM, width=margin)
        word = _font(2 * size)
        x, y = width - 3 * margin, height - 3 * margin
        box = pen.textbbox((x, y), "ALARM", font=word, anchor="rs")
        pad = margin
        pen.rectangle((box[0] - pad, box[1] - pad, box[2] + pad, box[3] + pad), fill=_ALARM)
        pen.text((x, y), "ALARM", font=word, fill="black", anchor="rs")
    return np.asarray(image)


def _label(pen: ImageDraw.ImageDraw, at: tuple[float, float], text: str, font: Any, fill: str, anchor: str) -> None:
    """Text on a backing of its own, readable on any picture."""
    left, top, right, bottom = pen.textbbox(at, text, font=font, anchor=anchor)
    pen.rectangle((left - 3, top - 3, right + 3, bottom + 3), fill=_PAPER)
    pen.text(at, text, font=font, fill=fill, anchor=anchor)


def _fit(text: str, font: Any, width: float) -> str:
    """``text``, or as much of its beginning as fits in ``width`` [px], with an ellipsis."""
    if font.getlength(text) <= width:
        return text
    while text and font.getlength(text + "…") > width:
        text = text[:-1]
    return text.rstrip() + "…"


@lru_cache(maxsize=16)
def _font(size: int) -> Any:
    """The font that comes with Pillow, at this size [px]: no file to find."""
    return ImageFont.load_default(size)
