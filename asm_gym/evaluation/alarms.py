"""Alarms of recordings that nobody has labelled: when, how long, on which channel, how far over the threshold."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from asm_gym.data.gaps import blamed, bridged, reason
from asm_gym.data.logs import Log
from asm_gym.episode import spans
from asm_gym.evaluation.scored_episode import ScoredEpisode, TraceDetail, moments_of
from asm_gym.spec import StreamSpec


class Alarm(NamedTuple):
    """One alarm of a recording.

    Attributes:
        log: in which.
        start, end: from when to when [s]; a row is known at the end of its step.
        channel: which number surprised most when it was raised; empty where a whole row was missing.
        why: surprise, missing data, or not finite.
        excess: how surprising its worst row was, in thresholds; infinite where it was not finite.
    """

    log: str
    start: float
    end: float
    channel: str
    why: str
    excess: float

    def cells(self) -> tuple[str, ...]:
        """For a table."""
        return self.log, f"{self.start:.3f}", f"{self.end:.3f}", self.channel, self.why, f"{self.excess:.2f}"


HEADINGS = ("log", "from [s]", "to [s]", "channel", "why", "thresholds")
"""The last: how surprising the worst row was, in multiples of the threshold."""


def alarms_of(trace: ScoredEpisode) -> list[Alarm]:
    """Every alarm of an episode, in order."""
    detail = trace.detail
    assert detail is not None
    found = []
    for m in moments_of(trace):
        row = np.zeros(len(detail.channels)) if detail.stream is None else detail.stream[m.start]
        at = blamed(row, detail.attribution[m.start])
        channel = "" if at is None else detail.channels[at]
        start, end = (m.start + 1) * trace.dt, m.stop * trace.dt
        found.append(Alarm(trace.kind, start, end, channel, reason(row), m.excess))
    return found


def traces_of(logs: Sequence[Log], monitor: Any, bridge: float = 0.0) -> list[ScoredEpisode]:
    """What the monitor says of each; rows that lack something for at most ``bridge`` seconds are not judged."""
    spec: StreamSpec = monitor.spec
    traces = []
    for (name, episode), surprise in zip(logs, monitor.score_episodes([log.episode for log in logs]), strict=True):
        fault = episode.faults if len(episode.faults) == len(episode) else np.zeros(len(episode), np.bool_)
        over = bridged(episode.stream, spec.dt, bridge)
        shares = np.where(over[:, None], 0.0, surprise.attribution)
        value = np.where(over, 0.0, surprise.value)
        detail = TraceDetail(shares, spec.labels, fault, episode.stream)
        excused = {event: np.where(over, 0.0, raw) for event, raw in surprise.excused_by_event.items()}
        traces.append(ScoredEpisode(name, 0, spec.dt, monitor.threshold, value, excused=excused, detail=detail))
    return traces


def excused_in(trace: ScoredEpisode) -> dict[str, int]:
    """How often a knock, and a stop, was all that kept surprise from being an alarm."""
    return {e: len(spans((raw > trace.threshold) & ~trace.alarm)) for e, raw in trace.excused.items()}
