"""How alarms of watched episodes began, a panel each, as a strip of film would show them."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from matplotlib.figure import Figure

from asm_gym.episode import spans
from asm_gym.evaluation.figures.style import BLACK, BLUE, VERMILLION, figure, require_some
from asm_gym.evaluation.scored_episode import AlarmMoment

AROUND_S, AROUND_ROWS = 0.5, 10
"""How much is shown before and after [s], and at least how many rows."""

ACROSS = 3
"""Panels side by side."""


def moments_figure(moments: Sequence[AlarmMoment]) -> Figure:
    """What the channel that raised each alarm sensed about its beginning."""
    require_some(moments)
    down = math.ceil(len(moments) / ACROSS)
    with figure(height=0.5 + 1.7 * down) as fig:
        panels = fig.subplots(down, ACROSS, squeeze=False).ravel()
        for ax in panels[len(moments) :]:
            ax.set_visible(False)
        for ax, moment in zip(panels, moments, strict=False):
            trace, detail = moment.trace, moment.trace.detail
            assert detail is not None
            assert detail.stream is not None
            around = max(AROUND_ROWS, round(AROUND_S / trace.dt))
            shown = slice(max(0, moment.start - around), min(len(trace), moment.start + around + 1))
            ax.plot(trace.dt * (np.arange(len(trace))[shown] + 1), detail.stream[shown, moment.channel], color=BLUE)
            for start, stop in spans(trace.alarm[shown]):
                ends = trace.dt * (shown.start + start), trace.dt * (shown.start + stop)
                ax.axvspan(*ends, color=VERMILLION, alpha=0.2, linewidth=0)
            at = trace.dt * (moment.start + 1)
            ax.axvline(at, color=BLACK, linewidth=1, linestyle=(0, (4, 2)))
            ax.set_title(f"{detail.channels[moment.channel]}, {at:.2f} s, {moment.excess:.1f}×", fontsize=9)
            ax.set_xlabel(f"{trace.title} [s]", fontsize=8)
            ax.tick_params(labelsize=8)
    return fig
