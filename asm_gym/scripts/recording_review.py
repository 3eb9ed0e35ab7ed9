"""Alarms of recordings, reviewed log by log: what is counted, written around each alarm, and printed."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from asm_gym.data.alarm_reasons import SURPRISING, thresholds_shown
from asm_gym.data.bridging import bridged
from asm_gym.data.logs import Log
from asm_gym.data.reader_notes import note
from asm_gym.detection.drift import WearCounter, blocks_of
from asm_gym.detection.following_threshold import FollowingThreshold
from asm_gym.evaluation import recorded_alarms
from asm_gym.evaluation.incident_window import IncidentWindow
from asm_gym.evaluation.recorded_alarms import HEADINGS, Alarm
from asm_gym.evaluation.scored_episode import ScoredEpisode
from asm_gym.files import write_text
from asm_gym.guard.live_events import ALARM, NOTE, SUMMARY, LiveEvent, counted
from asm_gym.monitors.expectation import Expectation

MOST_PRINTED = 20  # alarms of a recording; the file holds them all
DRAWN_EPISODES = 4  # episodes in the report, the most surprising ones
PRINTED = 7  # columns of the table that are printed


@dataclass
class Review:
    """Alarms in the recordings that were scored up to now."""

    alarms: list[Alarm] = field(default_factory=list)
    # the ``DRAWN_EPISODES`` with the greatest surprise, the greatest first
    worst: list[ScoredEpisode] = field(default_factory=list)
    episodes: int = 0
    excused: Counter[str] = field(default_factory=Counter)  # events that were no alarms
    bridged_rows: int = 0
    hours: float = 0.0
    # Its file is moved on by these recordings; None for a fixed threshold.
    following: FollowingThreshold | None = None
    wear: WearCounter | None = None  # from episode to episode

    def add(self, logs: Sequence[Log], monitor: Any, bridge: float, folder: Path) -> None:
        """Score some recordings, and write the rows around each alarm.

        Args:
            logs: recordings.
            monitor: a calibrated monitor.
            bridge: longest gap that is not judged [s].
            folder: of the files.
        """
        expectation = Expectation(monitor)
        traces = recorded_alarms.traces_of(logs, monitor, bridge)
        if self.following is not None:
            traces = [recorded_alarms.followed(trace, self.following) for trace in traces]
        for log, trace in zip(logs, traces, strict=True):
            is_bridged = bridged(log.episode.stream, monitor.spec.dt, bridge)  # (T,)
            self.bridged_rows += int(is_bridged.sum())
            for alarm in recorded_alarms.alarms_of(trace, expectation):
                window = recorded_alarms.window_of(trace, alarm)
                path = folder / f"{len(self.alarms) + 1:04d}.csv"
                evidence = self._written(path, window, expectation)
                moment = window.moment(alarm.start, expectation)
                self.alarms.append(alarm._replace(evidence=evidence, moment=moment))
            self.hours += len(trace) * trace.dt / 3600
            self.excused.update(recorded_alarms.excused_in(trace))
            if self.wear is not None and not trace.alarm.any():
                for block in blocks_of(log.episode.stream, monitor.spec.dt):
                    self.wear.follow(block, monitor.spec.dt)
            self.worst.append(trace)
        self.worst.sort(key=lambda trace: -recorded_alarms.sensed_peak(trace))
        del self.worst[DRAWN_EPISODES:]
        self.episodes += len(logs)

    def summary(self) -> str:
        """Return how many alarms there were, and how many events that were none."""
        logs = len({alarm.log for alarm in self.alarms})
        parts = [f"{counted(len(self.alarms), 'alarm')} in {logs} of {self.episodes} episodes"]
        parts += [counted(count, event) for event, count in self.excused.items() if count]
        if self.wear is not None and self.wear.worn:
            parts.append(str(self.wear.worn[0]))
        return ", ".join(parts)

    def largest(self) -> list[Alarm]:
        """Return the largest alarms, ``MOST_PRINTED`` at most, missing data last."""
        ordered = sorted(self.alarms, key=lambda alarm: (alarm.why != SURPRISING, -alarm.excess))
        return ordered[:MOST_PRINTED]

    def _written(self, path: Path, window: IncidentWindow, expectation: Expectation) -> str:
        """Write the rows around an alarm; return the file as the report names it, empty if it cannot be written."""
        try:
            write_text(path, window.to_csv(expectation))
        except (OSError, ValueError) as error:
            note(f"the rows around an alarm cannot be written: {error}")
            return ""
        return f"{path.parent.name}/{path.name}"


def say_events(reviewed: Review, notes: Sequence[str], say: Callable[[str], None]) -> None:
    """Print notes, alarms and the summary of recordings as JSON lines."""
    for line in notes:
        say(LiveEvent(kind=NOTE, time=0.0, text=line).to_json())
    for alarm in reviewed.alarms:
        say(event_of(alarm).to_json())
    say(LiveEvent(kind=SUMMARY, time=0.0, text=reviewed.summary()).to_json())


def event_of(alarm: Alarm) -> LiveEvent:
    """Return an alarm of a recording as the event that a live watch makes of it."""
    return LiveEvent(
        kind=ALARM,
        time=alarm.start,
        text=f"{thresholds_shown(alarm.excess)} thresholds up to {alarm.end:.3f} s",
        reason=alarm.why,
        channel=alarm.channel,
        thresholds=alarm.excess,
        stamp=alarm.stamp,
        date=alarm.date,
        log=alarm.log,
        group=alarm.group,
        evidence=alarm.evidence,
        cause=alarm.cause,
        remedy=alarm.remedy,
        **beside_of(alarm),
    )


def beside_of(alarm: Alarm) -> dict[str, Any]:
    """Return the fields of an event that say what the channel of an alarm read, and what was expected."""
    if alarm.beside is None:
        return {}
    return alarm.beside._asdict() | {"sign": alarm.beside.sign}


def say_table(
    reviewed: Review, notes: Sequence[str], bridge: float, say: Callable[[str], None]
) -> None:
    """Print notes, the summary and the largest alarms of recordings, missing data last."""
    for line in notes:
        say(f"Note: {line}.")
    if reviewed.bridged_rows:
        say(
            f"Bridged {reviewed.bridged_rows} rows that lack a number, in gaps of at most "
            f"{bridge:.3g} s: they are not judged."
        )
    printed = reviewed.largest()
    summary = reviewed.summary()
    if len(printed) < len(reviewed.alarms):
        summary += f"; the {MOST_PRINTED} largest:"
    say(summary)
    if not printed:
        return
    width = max(len(alarm.channel) for alarm in printed)
    lines_of_cells = [HEADINGS, *(alarm.cells(to_read=True) for alarm in printed)]
    for cells in lines_of_cells:
        log, start, end, channel, why, excess, _ = cells[:PRINTED]
        say(f"{start:>10} {end:>10} {excess:>11}  {channel:<{width}}  {why:<12}  {log}")
    for alarm in printed:
        if alarm.cause:
            say(f"{alarm.start:>10.3f}  {alarm.cause}; {alarm.remedy}")
