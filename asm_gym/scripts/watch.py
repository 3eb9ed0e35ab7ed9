"""Watch recorded logs or live rows with a fitted memory, and print each alarm with its time, channel and reason.

For a recording it writes a table, figures and a report. Live sources: - (standard input), tail:FILE (a growing file),
udp:PORT (datagrams from this machine; udp:PORT@ADDRESS:PORT from one sender), dds:/joint_states (ROS 2). They send JSON
lines (a list of numbers, or an object with a key for each channel) or CSV with a header, one row a line. Every alarm is
printed at once; a line that cannot be read is an alarm too.

Exit codes: 0 no alarm, 1 alarms, 2 an error, a file in a folder that cannot be read, or standard output that cannot be
written: then hook and topic are told, and the watch goes on.
"""

from __future__ import annotations

import csv
import io
import math
import sys
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import nullcontext
from dataclasses import dataclass, field
from functools import partial
from itertools import islice
from pathlib import Path
from typing import Any

from rich.console import Console

from asm_gym.data.alarm_reasons import SURPRISING
from asm_gym.data.bridging import bridge_of, bridged
from asm_gym.data.dds_topics import publisher
from asm_gym.data.live_sources import lines_from, live_source
from asm_gym.data.logs import Log, read_logs
from asm_gym.data.reader_notes import noted
from asm_gym.data.schema import LogSchema
from asm_gym.evaluation import recorded_alarms
from asm_gym.evaluation.recorded_alarms import HEADINGS, Alarm
from asm_gym.evaluation.scored_episode import ScoredEpisode
from asm_gym.evaluation.tables import Table
from asm_gym.extras import needed_for
from asm_gym.files import writable, write_text
from asm_gym.guard.alarm_outlets import AlarmOutlets, LineWriter, say_aside
from asm_gym.guard.live_events import (
    ALARM,
    NOTE,
    SUMMARY,
    LiveEvent,
    hold_by_hook,
    run_hook,
)
from asm_gym.guard.live_watch import WatchSettings, counted, follow
from asm_gym.guard.watchdog import Watchdog
from asm_gym.monitors import load_monitor
from asm_gym.rollouts.progress import stage
from asm_gym.scripts.command import BAD_NEWS, DONE, REFUSED, option, origin, run
from asm_gym.scripts.log_options import LogOptions, exit_code_of_reading
from asm_gym.validation import check_number

AT_ONCE = 64  # episodes scored side by side
LIVE_ONLY = ("until_alarm", "hook", "topic", "watchdog", "policy")  # options of a live source
RECORDED_ONLY = ("rate", "channels", "ignore", "label", "columns")  # options of a recording
MOST_PRINTED = 20  # alarms of a recording; the file holds them all
DRAWN_EPISODES = 4  # episodes in the report, the most surprising ones


@dataclass(frozen=True, kw_only=True)
class Args(LogOptions):
    """Watches a recording, or rows as they come."""

    source: str = option(positional=True, metavar="SOURCE")
    """A log, folder or dataset, as for asm-gym fit; or a live source: -, tail:FILE, udp:PORT or dds:/TOPIC."""
    monitor: Path = option(metavar="FILE.asm")
    """The memory, written by asm-gym fit."""
    out: Path = option(Path("runs/watch"), metavar="FOLDER")
    """Folder of the table, the figures and the report of a recording."""
    bridge: float | None = option(
        None, check=partial(check_number, "bridge", low=0.0), metavar="SECONDS"
    )
    """Longest gap without an alarm, by default two rows; rows in a gap are not judged."""
    wait: float = option(600.0, check=partial(check_number, "wait", low=0), metavar="SECONDS")
    """How long to wait for the first row of a live source, or for UDP or ROS 2 that died to return."""
    until_alarm: bool = False
    """End at the first alarm of a live source, with exit code 1: asm-gym watch ... --until-alarm || stop."""
    json: bool = False
    """Print events as JSON lines: kind, time, text, stamp, date, log, reason, channel, thresholds, latency_ms."""
    hook: str | None = option(None, metavar="COMMAND")
    """Shell command to run at every alarm of a live source; it gets the alarm as JSON on its standard input."""
    topic: str = option("", metavar="TOPIC")
    """Topic of ROS 2 on which every alarm of a live source is published, as JSON in a std_msgs/String."""
    watchdog: float | None = option(
        None, check=partial(check_number, "watchdog", above=0.0), metavar="SECONDS"
    )
    """Also run the hook from a second process: after this time without a row, and if this process dies."""
    policy: int | None = option(None, least=1, metavar="PID")
    """Process id of the policy; the watchdog treats its death as an alarm."""
    silence: float = option(2.0, check=partial(check_number, "silence", above=0), metavar="SECONDS")
    """Time without a row after which a live source counts as dead, which is an alarm."""


@dataclass
class Review:
    """Alarms in the recordings that were scored up to now."""

    alarms: list[Alarm] = field(default_factory=list)
    # the ``DRAWN_EPISODES`` with the greatest surprise, the greatest first
    worst: list[ScoredEpisode] = field(default_factory=list)
    episodes: int = 0
    excused: Counter[str] = field(default_factory=Counter)  # events that were no alarms
    bridged_rows: int = 0

    def add(self, logs: Sequence[Log], monitor: Any, bridge: float) -> None:
        """Score some recordings; gaps of at most ``bridge`` [s] are not judged."""
        traces = recorded_alarms.traces_of(logs, monitor, bridge)
        for log, trace in zip(logs, traces, strict=True):
            is_bridged = bridged(log.episode.stream, monitor.spec.dt, bridge)  # (T,)
            self.bridged_rows += int(is_bridged.sum())
            self.alarms += recorded_alarms.alarms_of(trace)
            self.excused.update(recorded_alarms.excused_in(trace))
            self.worst.append(trace)
        self.worst.sort(key=lambda trace: -recorded_alarms.sensed_peak(trace))
        del self.worst[DRAWN_EPISODES:]
        self.episodes += len(logs)

    def summary(self) -> str:
        """Return how many alarms there were, and how many events that were none."""
        logs = len({alarm.log for alarm in self.alarms})
        parts = [f"{counted(len(self.alarms), 'alarm')} in {logs} of {self.episodes} episodes"]
        parts += [counted(count, event) for event, count in self.excused.items() if count]
        return ", ".join(parts)


def review(args: Args, monitor: Any, console: Console) -> int:
    """Score a recording, write its alarms and a report, and print the alarms."""
    reviewed = Review()
    bridge = bridge_of(args.bridge, monitor.spec.dt)
    writable(args.out / "alarms.csv")
    progress_console = console
    if args.json:
        progress_console = Console(stderr=True)
    with stage("watching", progress_console) as progress, noted() as notes:
        logs = iter(read_logs(args.source, args.hints(), schema_of(args, monitor)))
        while group := list(islice(logs, AT_ONCE)):  # a folder may be larger than memory
            reviewed.add(group, monitor, bridge)
            progress(reviewed.episodes, reviewed.episodes)

    table = io.StringIO(newline="")
    rows = [map(recorded_alarms.plain_cell, alarm.cells()) for alarm in reviewed.alarms]
    csv.writer(table).writerows([HEADINGS, *rows])
    write_text(args.out / "alarms.csv", table.getvalue())
    written = write_figures_and_report(args, reviewed)
    say = partial(console.print, soft_wrap=True, highlight=False, markup=False)
    if args.json:
        say_events(reviewed, notes, say)
    else:
        say_table(reviewed, notes, bridge, say)
        say(written)
    if reviewed.alarms:
        return exit_code_of_reading(notes, BAD_NEWS)
    return exit_code_of_reading(notes)


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
        text=f"{alarm.excess:.2f} thresholds up to {alarm.end:.3f} s",
        reason=alarm.why,
        channel=alarm.channel,
        thresholds=alarm.excess,
        stamp=alarm.stamp,
        date=alarm.date,
        log=alarm.log,
    )


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
    alarms = sorted(reviewed.alarms, key=lambda alarm: (alarm.why != SURPRISING, -alarm.excess))
    printed = alarms[:MOST_PRINTED]
    summary = reviewed.summary()
    if len(printed) < len(alarms):
        summary += f"; the {MOST_PRINTED} largest:"
    say(summary)
    if not printed:
        return
    width = max(len(alarm.channel) for alarm in printed)
    lines_of_cells = [HEADINGS, *(alarm.cells() for alarm in printed)]
    for cells in lines_of_cells:
        log, start, end, channel, why, excess, _ = cells
        say(f"{start:>10} {end:>10} {excess:>11}  {channel:<{width}}  {why:<12}  {log}")


def schema_of(args: Args, monitor: Any) -> LogSchema:
    """Return how logs are read: by --schema, by the schema that the memory keeps, or by its channels.

    Raises:
        ValueError: the schema is of other channels than the memory.
    """
    given = args.given_schema()
    if given is None:
        return LogSchema.kept_in(monitor.about, monitor.spec)
    monitor.spec.require(given.spec, f"the schema {args.schema}")
    return given


def write_figures_and_report(args: Args, reviewed: Review) -> str:
    """Write figures of the most surprising episodes and a report; return what was written, or what is missing."""
    try:
        with needed_for("the report"):
            from asm_gym.evaluation import figures
            from asm_gym.evaluation.report_page import write_report
    except ImportError as error:
        return f"Wrote {args.out / 'alarms.csv'}; {error}"
    surprise = figures.surprise_figure(reviewed.worst)
    stream = figures.stream_figure(reviewed.worst[0])
    figures.save(surprise, args.out / "surprise.png")
    figures.save(stream, args.out / "stream.png")
    tables = []
    if reviewed.alarms:
        tables = [Table("Alarms", HEADINGS, [alarm.cells() for alarm in reviewed.alarms])]
    report = args.out / "report.html"
    write_report(
        report,
        title=f"asm-gym watch: {args.source}",
        intro=f"{reviewed.summary()}, as {args.monitor} sees them.",
        tables=tables,
        drawn={
            "Surprise over time, the most surprising episode first": surprise,
            "What its most surprising channels sensed": stream,
        },
        details=origin(),
    )
    return f"Wrote {report} and alarms.csv"


def refuse_options(args: Args, names: Sequence[str], purpose: str, source: str) -> None:
    """Raise ValueError if one of the options ``names`` is given, as the source is of the other kind."""
    for name in names:
        if getattr(args, name):
            option_name = f"--{name.replace('_', '-')}"
            raise ValueError(f"{option_name} {purpose}, and {args.source} is {source}")


def watch(args: Args, console: Console) -> int:
    """Watch a recording or a live source."""
    live = live_source(args.source)
    if live is None:
        refuse_options(args, LIVE_ONLY, "is for a live source", "a recording")
    else:
        refuse_options(args, RECORDED_ONLY, "is for a recording", "a live source")
    monitor: Any = load_monitor(args.monitor)
    if monitor.threshold_ is None or not math.isfinite(monitor.threshold_):
        raise ValueError(f"{args.monitor} has no threshold: calibrate it, as asm-gym fit does")
    if live is None:
        return review(args, monitor, console)
    return watch_live(args, monitor, console, returns=live.returns)


def watch_live(args: Args, monitor: Any, console: Console, returns: bool) -> int:
    """Watch a live source; where it ``returns``, it is opened anew after it has gone silent."""
    # A function of how long the first line may take [s].
    open_lines = partial(lines_from, args.source, sys.stdin, args.silence)
    reopen: Callable[[float], Iterator[str]] | None = None
    if returns:
        reopen = open_lines
    lines = open_lines(max(args.wait, args.silence))
    beat = None
    outlets = outlets_of(args, console)
    with _watchdog(args, monitor.spec.dt) as watchdog:
        announcement = f"watching {args.source}"
        if watchdog is not None:
            announcement += ", guarded by a watchdog"
            beat = watchdog.beat
        say_aside(announcement)
        settings = WatchSettings(
            bridge_s=bridge_of(args.bridge, monitor.spec.dt),
            reopen=reopen,
            wait_s=args.wait,
            until_alarm=args.until_alarm,
            beat=beat,
            clock=args.clock,
            silence_s=args.silence,
            schema=schema_of(args, monitor),
        )
        try:
            alarms = follow(lines, monitor, outlets.say, settings)
        finally:
            outlets.close()
    if outlets.output_failed:
        return REFUSED
    if alarms:
        return BAD_NEWS
    return DONE


def outlets_of(args: Args, console: Console) -> AlarmOutlets:
    """Return the outlets of events: first the hook, then the topic of ROS 2, then standard output."""
    outlets: list[Callable[[LiveEvent], object]] = []
    if args.hook:
        outlets.append(partial(run_hook, args.hook))
    if args.topic:
        publish_text = publisher(args.topic)
        outlets.append(lambda event: publish_text(event.to_json()))
    return AlarmOutlets(outlets, LineWriter(console.file), args.json)


def _watchdog(args: Args, dt: float) -> Watchdog | nullcontext[None]:
    """Return the watchdog that the options ask for, where rows come every ``dt`` [s]; an empty context if none.

    Raises:
        ValueError: it lacks a time or a hook, or its time is not longer than ``dt``.
    """
    if args.watchdog is None and args.policy is None:
        return nullcontext()
    if args.watchdog is None or args.hook is None:
        raise ValueError(
            "a watchdog needs --watchdog SECONDS and --hook COMMAND, which makes the robot hold",
        )
    if args.watchdog <= dt:
        raise ValueError(
            f"--watchdog must be longer than the {dt:g} s between two rows, got {args.watchdog:g}",
        )
    processes = []
    if args.policy is not None:
        processes = [args.policy]
    return Watchdog(partial(hold_by_hook, args.hook), args.watchdog, processes)


main = partial(run, "watch", Args, watch)
