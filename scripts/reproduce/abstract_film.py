"""The film of ``reproduce abstract``: the arm, the letter it is taken for, how surprised it is, what it does then."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from numpy.typing import NDArray

from asm_gym.evaluation.figures import figure, look
from asm_gym.scripts.reproduce.closed_loop import CUE, EVENT, Course
from asm_gym.scripts.reproduce.handwriting import STEPS
from asm_gym.scripts.reproduce.two_links import DT, LINKS, Floats, joints

SHOWN = {"pushed": "pushed", "stuck, left out": "an encoder sticks"}
"""Which courses are shown, and what happens in them."""

STILL = 20
"""Frames in which the end is shown."""

AREA = ((5.5, 22.5), (4.5, 20.0))
"""What of the plane is seen [cm]: where it writes, and most of the forearm."""


def filmed(courses: Mapping[str, Mapping[str, Course]], truth: Floats) -> list[NDArray[np.uint8]]:
    """A letter (T, 2) written by each dynamics: one frame for each row."""
    names = [name for name in courses if name != "gru"]
    with figure(height=7.2, width=11) as fig:
        canvas = FigureCanvasAgg(fig)
        fig.set_dpi(80)
        panels: list[Any] = []
        for axes, name in zip(fig.subplots(len(names), 3, squeeze=False), names, strict=True):
            panels += [_Arm(ax, name, way, courses[name][way], truth) for ax, way in zip(axes, SHOWN, strict=False)]
            panels.append(_Felt(axes[-1], courses[name]))
        canvas.draw()
        fig.set_layout_engine("none")  # what stands where does not change any more
        frames = []
        for t in range(STEPS):
            for panel in panels:
                panel.at(t)
            canvas.draw()
            frames.append(np.asarray(canvas.buffer_rgba())[..., :3].copy())
    return frames + frames[-1:] * STILL


class _Arm:
    """An arm that writes."""

    def __init__(self, ax: Any, name: str, way: str, course: Course, truth: Floats) -> None:
        self.way, self.course, self.path = way, course, course.path[:, 0]
        ax.plot(*truth.T, color="#cccccc", linewidth=4)
        (self.written,) = ax.plot([], [], color=look(0)[0], linewidth=1.6)
        (self.links,) = ax.plot([], [], "o-", color="#333333", linewidth=2.5, markersize=4)
        self.said = ax.set_title(f"{name}\n")
        self.name = name
        ax.set(aspect="equal", xlim=AREA[0], ylim=AREA[1])

    def at(self, t: int) -> None:
        alarmed = t >= self.course.alarm[0]
        first = joints(self.path[t])[0]
        elbow = LINKS[0] * np.array([np.cos(first), np.sin(first)])
        self.links.set_data(*np.array([np.zeros(2), elbow, self.path[t]]).T)
        self.links.set_color(look(1)[0] if alarmed else "#333333")
        self.written.set_data(*self.path[: t + 1].T)
        doing = "is shown" if t < CUE else "writes"
        happened = "" if t < EVENT else SHOWN[self.way]
        if alarmed:
            blamed = self.course.blamed[0].replace("_", " ")
            happened += f"; {blamed} " + ("is left out" if self.way.endswith("left out") else "alarms")
        self.said.set_text(f"{self.name} {doing} {self.course.named[t]!r}\n{happened}")


class _Felt:
    """Surprise over time."""

    def __init__(self, ax: Any, own: Mapping[str, Course]) -> None:
        self.curves = []
        for i, (way, happens) in enumerate(SHOWN.items()):
            (curve,) = ax.plot([], [], color=look(i)[0], label=happens)
            values = own[way].surprise[:, 0]
            self.curves.append((curve, np.where(np.isfinite(values), values, np.nan)))  # a sense left out is infinite
        highest = max(np.nanmax(values) for _, values in self.curves)
        ax.axvline(DT * EVENT, color="#bbbbbb", linewidth=1)
        ax.axhline(own[next(iter(SHOWN))].threshold, color="#bbbbbb", linewidth=1, linestyle="--")
        ax.set(xlabel="time [s]", title="surprise, and its threshold", xlim=(0, DT * STEPS), ylim=(0, 2 * highest))
        ax.set_yscale("symlog")
        ax.legend(loc="upper left", fontsize=8)

    def at(self, t: int) -> None:
        for curve, values in self.curves:
            curve.set_data(DT * np.arange(t + 1), values[: t + 1])
