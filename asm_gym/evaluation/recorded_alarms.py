"""Alarms of recordings without labels: when, on which channel, how far over the threshold."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from datetime import UTC, datetime
from functools import partial
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from asm_gym.data.alarm_reasons import SURPRISING, thresholds_shown
from asm_gym.data.bridging import bridged
from asm_gym.data.clock import date_of
from asm_gym.data.episode import Episode
from asm_gym.data.logs import Log
from asm_gym.data.schema import LOG_ORIGIN, LogSchema
from asm_gym.detection.alarm_rule import rows_excused
from asm_gym.detection.following_threshold import FollowingThreshold
from asm_gym.detection.incidents import Incident, IncidentBook, power_of, rows_of_alarm
from asm_gym.evaluation.incident_window import AFTER_S, BEFORE_S, AlarmMoment, IncidentWindow
from asm_gym.evaluation.scored_episode import ScoredEpisode
from asm_gym.evaluation.tables import Table
from asm_gym.monitors import named_causes
from asm_gym.monitors.blame import REMEMBERED
from asm_gym.monitors.expectation import (
    Expectation,
    Expected,
    shift_of_columns,
    shifts_kept_in,
)
from asm_gym.monitors.named_causes import CauseNamer, NamedCause
from asm_gym.readings import spans

HEADINGS = (
    *("log", "from [s]", "to [s]", "channel", "why", "thresholds", "date"),
    *("sensed", "expected", "±", "unit", "rows around it", "cause", "what to do"),
)
TO_READ = (
    *("from", "lasts", "what happened", "what to do", "channel", "sensed", "expected"),
    *("thresholds", "rows around it", "log"),
)
"""Headings of the alarms in a report."""
Floats = NDArray[np.float64]
MOST_NAMED = 3  # channels that the table of an hour names


class Alarm(NamedTuple):
    """One alarm of a recording: an incident."""

    log: str
    # Stamps of its first and last row [s], by the log; without a clock, the ends of their steps.
    start: float
    end: float
    # The channel that blame points to at its first row; empty where a whole row was missing.
    channel: str
    why: str  # surprise, missing data, or not finite
    excess: float  # surprise of the worst row, in thresholds
    has_stamps: bool = False  # the log has a clock
    row: int = 0  # index of its first row
    column: int | None = None  # of the channel
    group: str = ""  # of the channel
    beside: Expected | None = None  # the channel in its first row beside what was expected
    evidence: str = ""  # file of the rows around it
    cause: str = ""  # in words; empty where none was looked for
    cause_name: str = ""  # one of ``named_causes.REMEDIES``, likewise
    remedy: str = ""  # what to do about it
    moment: AlarmMoment | None = None  # the channel around its first row

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

    def shown(self, time: float) -> str:
        """Return a time of the log for a reader: the date, where its clock has one, else seconds."""
        date = ""
        if self.has_stamps:
            date = date_of(time)
        if date:
            return f"{date[:10]} {date[11:23]}"
        return f"{time:.3f} s"

    def in_words(self) -> str:
        """Return what happened, in some sentences."""
        if self.why != SURPRISING:
            text = f"{self.channel or 'the whole row'}: {self.why}"
        elif self.beside is None:
            text = f"{self.channel} is not what the other numbers let expect"
        else:
            text = self.beside.sentence(self.channel)
        if self.why == SURPRISING:
            text += f" ({thresholds_shown(self.excess)} thresholds)"
        if self.cause:
            to_do = f"{self.remedy[:1].upper()}{self.remedy[1:]}"
            text = f"{self.cause}. {text}. {to_do}"
        return f"{self.log}, {self.shown(self.start)}: {text}."

    def line(self) -> tuple[str, ...]:
        """Format for a report, under ``TO_READ``."""
        sensed = ""
        expected = ""
        if self.beside is not None:
            unit = self.beside.unit
            sensed = f"{self.beside.sensed:.4g} {unit}"
            expected = f"{self.beside.expected:.4g} ± {self.beside.plus_minus:.2g} {unit}"
        return (
            *(self.shown(self.start), f"{self.end - self.start:.3g} s"),
            *(self.cause or self.why, self.remedy, self.channel, sensed, expected),
            *(thresholds_shown(self.excess), self.evidence, self.log),
        )

    def cells(self, to_read: bool = False) -> tuple[str, ...]:
        """Format for a table, under ``HEADINGS``; ``to_read`` caps the surprise."""
        excess = f"{self.excess:.2f}"
        if to_read:
            excess = thresholds_shown(self.excess)
        times = (f"{self.start:.3f}", f"{self.end:.3f}")
        beside = ("", "", "", "")
        if self.beside is not None:
            sensed, expected, plus_minus, unit = self.beside
            beside = (f"{sensed:.5g}", f"{expected:.5g}", f"{plus_minus:.2g}", unit)
        return (
            *(self.log, *times, self.channel, self.why, excess, self.date),
            *(*beside, self.evidence, self.cause, self.remedy),
        )


def alarms_of(trace: ScoredEpisode, expectation: Expectation | None = None) -> list[Alarm]:
    """Return every incident of an episode, in order, see ``asm_gym.detection.incidents``.

    Args:
        trace: the scored episode.
        expectation: what channels should read.
    """
    assert trace.attribution is not None
    assert trace.stream is not None
    book = IncidentBook(trace.power)
    incidents = []  # they grow as long as rows follow
    for row in rows_of_alarm(
        surprise=trace.surprise,
        shares_of=trace.raw_shares,
        stream=trace.stream,
        threshold=trace.threshold,
        dt=trace.dt,
        blame_of=partial(blamed_in, trace),
    ):
        opened = book.follow(row)
        if opened is not None:
            incidents.append(opened)
    alarms = []
    for incident in incidents:
        alarm = _alarm(trace, incident)
        if expectation is not None:
            rows = trace.stream[max(alarm.row - 1, 0) : alarm.row + 1]
            alarm = alarm._replace(beside=expectation.at_end(rows, incident.column))
        if incident.reason == SURPRISING and trace.namer is not None:
            cause = cause_of(trace, incident, trace.namer)
            in_words = cause.in_words(trace.channels, trace.units)
            alarm = alarm._replace(cause=in_words, cause_name=cause.name, remedy=cause.remedy)
        alarms.append(alarm)
    return alarms


def blamed_in(trace: ScoredEpisode, row: int) -> tuple[int, ...]:
    """Return what blame points to in a row; empty where the monitor cannot blame."""
    if trace.blame is None or trace.recentred is None:
        return ()
    rows = trace.recentred[max(0, row + 1 - REMEMBERED) : row + 1]
    return trace.blame(rows, trace.raw_shares(row))


def cause_of(trace: ScoredEpisode, incident: Incident, namer: CauseNamer) -> NamedCause:
    """Return the cause of an incident."""
    assert trace.recentred is not None
    first = _first_row(trace, incident)
    start = max(0, first - round(named_causes.BEFORE_S / trace.dt))
    stop = first + round(named_causes.AFTER_S / trace.dt) + 1
    return namer(trace.recentred[start:stop], first - start, incident.blamed)


def _first_row(trace: ScoredEpisode, incident: Incident) -> int:
    """Return the index of the first row of an incident."""
    return round(incident.start / trace.dt) - 1


def _alarm(trace: ScoredEpisode, incident: Incident) -> Alarm:
    """Return an incident as an alarm of a recording."""
    first = _first_row(trace, incident)
    last = round(incident.last / trace.dt) - 1
    alarm = Alarm(
        log=trace.kind,
        start=float(trace.times[first]),
        end=float(trace.times[last]),
        channel="",
        why=incident.reason,
        excess=incident.excess,
        has_stamps=trace.origin is not None,
        row=first,
        column=incident.column,
    )
    if incident.column is None:
        return alarm
    alarm = alarm._replace(channel=trace.channels[incident.column])
    if trace.groups:
        alarm = alarm._replace(group=trace.groups[incident.column])
    return alarm


def window_of(trace: ScoredEpisode, alarm: Alarm) -> IncidentWindow:
    """Return the rows around an alarm of an episode."""
    assert trace.stream is not None
    first = max(alarm.row - round(BEFORE_S / trace.dt), 0)
    stop = min(alarm.row + round(AFTER_S / trace.dt) + 1, len(trace))
    return IncidentWindow(
        times=trace.times[first:stop].tolist(),
        rows=trace.stream[first:stop],
        surprise=(trace.surprise[first:stop] / trace.threshold).tolist(),
        labels=trace.channels,
        column=alarm.column,
    )


def by_hour(alarms: Sequence[Alarm], hours: float) -> Table:
    """Return how many alarms began in each hour: of the day where the log has dates, else of the log.

    Args:
        alarms: of recordings.
        hours: duration of all recordings [h].
    """
    counts: dict[str, Counter[str]] = {}
    for alarm in sorted(alarms, key=lambda each: each.start):
        hour = f"hour {int(alarm.start // 3600)} of the log"
        if alarm.date:
            hour = f"{datetime.fromtimestamp(alarm.start, UTC).hour:02d}:00 UTC"
        counts.setdefault(hour, Counter())[alarm.channel or alarm.why] += 1
    rows = []
    for hour, channels in counts.items():
        names = ", ".join(f"{count} {name}" for name, count in channels.most_common(MOST_NAMED))
        rows.append((hour, str(channels.total()), names))
    caption = f"Alarms by hour: {len(alarms)} in {hours:.3g} hours"
    if hours > 0:
        caption += f", {len(alarms) / hours:.3g} an hour"
    return Table(caption, ("from", "alarms", "channels"), rows)


def sensed_peak(trace: ScoredEpisode) -> float:
    """Return the largest surprise of an episode in rows that lack nothing: missing data are no degree of surprise."""
    return float(trace.surprise[~trace.missing].max(initial=0.0))


def traces_of(logs: Sequence[Log], monitor: Any, bridge: float = 0.0) -> list[ScoredEpisode]:
    """Score logs; rows that lack a number for at most ``bridge`` seconds are not judged."""
    dt = monitor.spec.dt
    about = getattr(monitor, "about", {})
    names = LogSchema.kept_in(about, monitor.spec).names_in_logs
    shift = shift_of_columns(monitor.spec, shifts_kept_in(about))
    as_judged = [recentred(log.episode, shift) for log in logs]
    surprises = monitor.score_episodes(as_judged)
    blame = getattr(monitor, "blame_", None)
    namer = getattr(monitor, "cause_namer_", None)
    traces = []
    for (name, episode), as_scored, surprise in zip(logs, as_judged, surprises, strict=True):
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
            groups=monitor.spec.groups,
            power=power_of(monitor),
            fault=fault,
            stream=episode.stream,
            origin=episode.info.get(LOG_ORIGIN),
            namer=namer,
            blame=blame,
            recentred=as_scored.stream,
            units=monitor.spec.units,
        )
        traces.append(trace)
    return traces


def recentred(episode: Episode, shift: Floats) -> Episode:
    """Return an episode without a level shift (D,) that was acknowledged."""
    if not shift.any():
        return episode
    return replace(episode, stream=(episode.stream - shift).astype(np.float32))


def followed(trace: ScoredEpisode, following: FollowingThreshold) -> ScoredEpisode:
    """Return an episode with its surprise relative to a threshold that follows, which it moves on."""
    assert trace.attribution is not None
    relative = following.relative(trace.surprise) * trace.threshold
    factor = np.ones(len(trace))
    usual = np.isfinite(relative) & (trace.surprise > 0)
    np.divide(relative, trace.surprise, out=factor, where=usual)
    return replace(
        trace,
        surprise=relative,
        attribution=trace.attribution * factor[:, None],
        top_channel="",
    )


def excused_in(trace: ScoredEpisode) -> dict[str, int]:
    """Count how often each benign event alone kept surprise from being an alarm."""
    return {
        event: len(spans(rows_excused(raw, trace.surprise, trace.threshold)))
        for event, raw in trace.excused.items()
    }
