"""Alarms of recordings without labels: when, how long, on which channel, how far over the threshold."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from asm_gym.data.gaps import blamed, bridged, reason
from asm_gym.data.logs import Log
from asm_gym.episode import spans
from asm_gym.evaluation.scored_episode import ScoredEpisode, TraceDetail
from asm_gym.spec import StreamSpec


class Alarm(NamedTuple):
    """One alarm of a recording."""

    log: str
    start: float  # [s] at the end of its first row
    end: float  # [s]
    channel: str  # the most surprising number when the alarm was raised; empty where a whole row was missing
    why: str  # surprise, missing data, or not finite
    excess: float  # surprise of the worst row, in thresholds

    def cells(self) -> tuple[str, ...]:
        """Format for a table."""
        return self.log, f"{self.start:.3f}", f"{self.end:.3f}", self.channel, self.why, f"{self.excess:.2f}"


HEADINGS = ("log", "from [s]", "to [s]", "channel", "why", "thresholds")


def alarms_of(trace: ScoredEpisode) -> list[Alarm]:
    """Return every alarm of an episode, in order."""
    detail = trace.detail
    assert detail is not None
    found = []
    for first, stop in spans(trace.alarm):
        row = np.zeros(len(detail.channels)) if detail.stream is None else detail.stream[first]
        at = blamed(row, detail.attribution[first])
        channel = "" if at is None else detail.channels[at]
        excess = float(trace.surprise[first:stop].max() / trace.threshold)
        found.append(Alarm(trace.kind, (first + 1) * trace.dt, stop * trace.dt, channel, reason(row), excess))
    return found


def traces_of(logs: Sequence[Log], monitor: Any, bridge: float = 0.0) -> list[ScoredEpisode]:
    """Score logs; rows that lack a number for at most ``bridge`` seconds are not judged."""
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
    """Count how often a knock, and a stop, alone kept surprise from being an alarm."""
    return {e: len(spans((raw > trace.threshold) & ~trace.alarm)) for e, raw in trace.excused.items()}
