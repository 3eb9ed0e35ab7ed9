"""Alarms of recordings without labels: when, on which channel, how far over the threshold."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from asm_gym.data.clock import date_of
from asm_gym.data.episode import spans
from asm_gym.data.logs import Log
from asm_gym.data.timing import TOGETHER_S, blamed, bridged, reason
from asm_gym.detection.alarm_rule import rows_excused
from asm_gym.evaluation.scored_episode import ScoredEpisode
from asm_gym.spec import StreamSpec


class Alarm(NamedTuple):
    """One alarm of a recording."""

    log: str
    start: float  # [s] at the end of its first row
    end: float  # [s]
    channel: str  # the most surprising number when the alarm was raised; empty where a whole row was missing
    why: str  # surprise, missing data, or not finite
    excess: float  # surprise of the worst row, in thresholds
    stamp: float | None = None  # of its first row, by the robot's own clock [s]

    def cells(self) -> tuple[str, ...]:
        """Format for a table."""
        return (
            self.log,
            f"{self.start:.3f}",
            f"{self.end:.3f}",
            self.channel,
            self.why,
            f"{self.excess:.2f}",
            "" if self.stamp is None else f"{self.stamp:.3f}",
            "" if self.stamp is None else date_of(self.stamp),
        )


FORMULA = "=+-@\t\r"  # what a cell that a spreadsheet takes for a formula begins with


def plain_cell(text: str) -> str:
    """Return a cell of CSV that no spreadsheet takes for a formula: a name that looks like one is quoted."""
    return f"'{text}" if text[:1] in FORMULA and text else text


HEADINGS = ("log", "from [s]", "to [s]", "channel", "why", "thresholds", "clock [s]", "date")


def alarms_of(trace: ScoredEpisode, origin: float | None = None) -> list[Alarm]:
    """Return every alarm of an episode, in order; those of one kind that are TOGETHER_S apart are one.

    Args:
        trace: the scored episode.
        origin: stamp of its first row, by the robot's own clock; None without one [s].
    """
    assert trace.attribution is not None
    assert trace.stream is not None
    found: list[Alarm] = []
    newest: dict[str, int] = {}  # place of the newest alarm in ``found``, by its reason
    for first, stop in spans(trace.alarm):
        row = trace.stream[first]
        why = reason(row)
        start = (first + 1) * trace.dt
        excess = float(trace.surprise[first:stop].max() / trace.threshold)
        before = found[newest[why]] if why in newest else None
        if before is not None and start - before.end <= TOGETHER_S:
            found[newest[why]] = before._replace(
                end=stop * trace.dt, excess=max(excess, before.excess)
            )
            continue
        newest[why] = len(found)
        column = blamed(row, trace.attribution[first])
        found.append(
            Alarm(
                log=trace.kind,
                start=start,
                end=stop * trace.dt,
                channel="" if column is None else trace.channels[column],
                why=why,
                excess=excess,
                stamp=None if origin is None else origin + first * trace.dt,
            )
        )
    return found


def sensed_peak(trace: ScoredEpisode) -> float:
    """Return the largest surprise of an episode in rows that lack nothing: missing data are no degree of surprise."""
    return float(trace.surprise[~trace.missing].max(initial=0.0))


def traces_of(logs: Sequence[Log], monitor: Any, bridge: float = 0.0) -> list[ScoredEpisode]:
    """Score logs; rows that lack a number for at most ``bridge`` seconds are not judged."""
    spec: StreamSpec = monitor.spec
    traces = []
    for (name, episode), surprise in zip(
        logs, monitor.score_episodes([log.episode for log in logs]), strict=True
    ):
        fault = (
            episode.faults
            if len(episode.faults) == len(episode)
            else np.zeros(len(episode), np.bool_)
        )
        judged = surprise.silenced(bridged(episode.stream, spec.dt, bridge))
        trace = ScoredEpisode(
            name, 0, spec.dt, monitor.threshold, judged.value, excused=judged.excused_by_event
        )
        shares, labels = judged.attribution, spec.labels
        traces.append(
            replace(trace, attribution=shares, channels=labels, fault=fault, stream=episode.stream)
        )
    return traces


def excused_in(trace: ScoredEpisode) -> dict[str, int]:
    """Count how often a knock, and a stop, alone kept surprise from being an alarm."""
    return {
        event: len(spans(rows_excused(raw, trace.surprise, trace.threshold)))
        for event, raw in trace.excused.items()
    }
