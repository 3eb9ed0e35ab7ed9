"""Alarms of recordings without labels: when, on which channel, how far over the threshold."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from asm_gym.data.alarm_reasons import TOGETHER_S, blamed, reason
from asm_gym.data.bridging import bridged
from asm_gym.data.clock import date_of
from asm_gym.data.logs import Log
from asm_gym.data.schema import LOG_ORIGIN, LogSchema
from asm_gym.detection.alarm_rule import rows_excused
from asm_gym.evaluation.scored_episode import ScoredEpisode
from asm_gym.monitors.blame import reattribute_alarms
from asm_gym.readings import spans

HEADINGS = ("log", "from [s]", "to [s]", "channel", "why", "thresholds", "date")
FORMULA = "=+-@\t\r"  # what a cell that a spreadsheet takes for a formula begins with


class Alarm(NamedTuple):
    """One alarm of a recording."""

    log: str
    # Stamps of its first and last row, by the log's own clock; without one, the ends of their steps [s].
    start: float
    end: float
    # The most surprising number when the alarm was raised; empty where a whole row was missing.
    channel: str
    why: str  # surprise, missing data, or not finite
    excess: float  # surprise of the worst row, in thresholds
    has_stamps: bool = False  # the log has a clock

    @property
    def stamp(self) -> float | None:
        """Stamp of its first row, by the log's own clock; None without one [s]."""
        if self.has_stamps:
            return self.start
        return None

    @property
    def date(self) -> str:
        """Date of its first row in ISO 8601; empty where the log's clock counts from elsewhere."""
        if self.has_stamps:
            return date_of(self.start)
        return ""

    def cells(self) -> tuple[str, ...]:
        """Format for a table, under ``HEADINGS``."""
        times = (f"{self.start:.3f}", f"{self.end:.3f}")
        return (self.log, *times, self.channel, self.why, f"{self.excess:.2f}", self.date)


def plain_cell(text: str) -> str:
    """Return a cell of CSV that no spreadsheet takes for a formula: a name that looks like one is quoted."""
    if text.startswith(tuple(FORMULA)):
        return f"'{text}"
    return text


def alarms_of(trace: ScoredEpisode) -> list[Alarm]:
    """Return every alarm of an episode, in order; those of one kind that are TOGETHER_S apart are one."""
    assert trace.attribution is not None
    assert trace.stream is not None
    alarms: list[Alarm] = []
    times = trace.times
    newest: dict[str, int] = {}  # index of the newest alarm, by its reason
    for first, stop in spans(trace.alarm):
        row = trace.stream[first]
        why = reason(row)
        start = float(times[first])
        end = float(times[stop - 1])
        excess = float(trace.surprise[first:stop].max() / trace.threshold)

        index = newest.get(why)
        if index is not None and start - alarms[index].end <= TOGETHER_S:
            excess = max(excess, alarms[index].excess)
            alarms[index] = alarms[index]._replace(end=end, excess=excess)
            continue

        newest[why] = len(alarms)
        alarm = Alarm(
            log=trace.kind,
            start=start,
            end=end,
            channel="",
            why=why,
            excess=excess,
            has_stamps=trace.origin is not None,
        )
        column = blamed(row, trace.attribution[first])
        if column is not None:
            alarm = alarm._replace(channel=trace.channels[column])
        alarms.append(alarm)
    return alarms


def sensed_peak(trace: ScoredEpisode) -> float:
    """Return the largest surprise of an episode in rows that lack nothing: missing data are no degree of surprise."""
    return float(trace.surprise[~trace.missing].max(initial=0.0))


def traces_of(logs: Sequence[Log], monitor: Any, bridge: float = 0.0) -> list[ScoredEpisode]:
    """Score logs; rows that lack a number for at most ``bridge`` seconds are not judged."""
    dt = monitor.spec.dt
    names = LogSchema.kept_in(getattr(monitor, "about", {}), monitor.spec).names_in_logs
    surprises = monitor.score_episodes([log.episode for log in logs])
    traces = []
    for (name, episode), surprise in zip(logs, surprises, strict=True):
        fault = episode.faults
        if len(fault) != len(episode):
            fault = np.zeros(len(episode), np.bool_)
        judged = surprise.silenced(bridged(episode.stream, dt, bridge))
        trace = ScoredEpisode(
            kind=name,
            seed=0,
            dt=dt,
            threshold=monitor.threshold,
            surprise=judged.value,
            excused=judged.excused_by_event,
            attribution=judged.attribution,
            channels=names,
            fault=fault,
            stream=episode.stream,
            origin=episode.info.get(LOG_ORIGIN),
        )
        blame = getattr(monitor, "blame_", None)
        reattribute_alarms(blame, episode.stream, trace.alarms, trace.attribution)
        traces.append(trace)
    return traces


def excused_in(trace: ScoredEpisode) -> dict[str, int]:
    """Count how often a knock, and a stop, alone kept surprise from being an alarm."""
    return {
        event: len(spans(rows_excused(raw, trace.surprise, trace.threshold)))
        for event, raw in trace.excused.items()
    }
