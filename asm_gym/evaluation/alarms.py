"""Alarms of recordings that nobody has labelled: when, how long, on which channel, how far over the threshold."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from asm_gym.data.logs import Log
from asm_gym.evaluation import figures
from asm_gym.evaluation.scored import ScoredEpisode, TraceDetail
from asm_gym.spec import StreamSpec


class Alarm(NamedTuple):
    """One alarm of a recording.

    Attributes:
        log: in which.
        start, end: from when to when [s]; a row is known at the end of its step.
        channel: which number surprised most when it was raised.
        excess: how surprising its worst row was, in thresholds; infinite where it was not finite.
    """

    log: str
    start: float
    end: float
    channel: str
    excess: float

    def cells(self) -> tuple[str, ...]:
        """For a table."""
        return self.log, f"{self.start:.3f}", f"{self.end:.3f}", self.channel, f"{self.excess:.2f}"


HEADINGS = ("log", "from [s]", "to [s]", "channel", "thresholds")
"""The last: how surprising the worst row was, in multiples of the threshold."""


def alarms_of(trace: ScoredEpisode) -> list[Alarm]:
    """Every alarm of an episode, in order."""
    detail = trace.detail
    assert detail is not None
    return [
        Alarm(trace.kind, (m.start + 1) * trace.dt, m.stop * trace.dt, detail.channels[m.channel], m.excess)
        for m in figures.moments_of(trace)
    ]


def traces_of(logs: Sequence[Log], monitor: Any) -> list[ScoredEpisode]:
    """What the monitor says of each."""
    spec: StreamSpec = monitor.spec
    traces = []
    for (name, episode), surprise in zip(logs, monitor.score_episodes([log.episode for log in logs]), strict=True):
        fault = episode.faults if len(episode.faults) == len(episode) else np.zeros(len(episode), np.bool_)
        detail = TraceDetail(surprise.attribution, spec.labels, fault, episode.stream)
        traces.append(ScoredEpisode(name, 0, spec.dt, monitor.threshold, surprise.value, detail=detail))
    return traces
