"""Precision, recall and delay in one number: the area under the front of precision and penalised detection time.

    PDT(q)      mean over faults of the share of the window that had passed at the alarm; 1 where there was none
    P(q)        R / (R + F): of as many faulty episodes as nominal ones; F the nominal ones in alarm at q
    AUCPDT      ∫_0^1 min { PDT(q) : P(q) >= p } dp, and 1 where no threshold is so precise; the lower the better

Source: VLA-FAIL (arXiv 2606.21386, 2026), whose definition was to be had at second hand only: the time of the first
detection in a failed episode, 1 if it is missed, integrated over the front of precision and earliness. Theirs counts
from the beginning of an episode, here it is from the onset of the fault to the end of the window.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from asm_gym.evaluation.scored_episode import ScoredEpisode, window_steps


def aucpdt(faulty: Sequence[ScoredEpisode], nominal: Sequence[ScoredEpisode], window_s: float) -> float:
    """The area; NaN without faults or nominal episodes. What surprised before the onset is left to the nominal ones."""
    raised = []
    for trace in faulty:
        if trace.onset is not None:
            width = window_steps(window_s, trace.dt)
            seen = np.maximum.accumulate(trace.surprise[trace.window(window_s)])
            if len(seen):
                raised.append(np.pad(seen, (0, width - len(seen)), "edge"))  # an episode that ended: nothing more comes
    if not raised or not nominal:
        return math.nan
    rows = np.array(raised)  # (F, W) the threshold below which an alarm is up after so many rows
    peaks = np.sort([float(trace.surprise.max()) for trace in nominal])
    levels = np.unique(np.concatenate([[-math.inf], rows.ravel(), peaks]))  # between two nothing changes
    pooled, last = np.sort(rows.ravel()), np.sort(rows[:, -1])
    late = np.searchsorted(pooled, levels, "right") / len(pooled)  # PDT
    recall = 1.0 - np.searchsorted(last, levels, "right") / len(last)
    alarms = 1.0 - np.searchsorted(peaks, levels, "right") / len(peaks)
    told = recall > 0
    precision, late = (recall[told] / (recall + alarms)[told]), late[told]
    order = np.argsort(-precision, kind="stable")
    best = np.minimum.accumulate(late[order])  # of all that are at least so precise
    edges = np.append(precision[order], 0.0)
    return float(1.0 - edges[0] + (best * (edges[:-1] - edges[1:])).sum())
