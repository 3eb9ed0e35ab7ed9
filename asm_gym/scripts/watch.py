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
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import nullcontext
from dataclasses import dataclass
from functools import partial
from itertools import islice
from pathlib import Path
from queue import Queue
from typing import Any

from rich.console import Console

from asm_gym.data.bridging import bridge_of
from asm_gym.data.dds_topics import publisher
from asm_gym.data.live_sources import lines_from, live_source
from asm_gym.data.logs import read_logs
from asm_gym.data.reader_notes import noted
from asm_gym.data.schema import LogSchema
from asm_gym.detection.conformal import hourly_promise
from asm_gym.detection.following_threshold import FollowingThreshold
from asm_gym.evaluation import recorded_alarms
from asm_gym.evaluation.recorded_alarms import HEADINGS, TO_READ
from asm_gym.evaluation.tables import Table, plain_cell
from asm_gym.extras import needed_for
from asm_gym.files import writable, write_text
from asm_gym.guard.alarm_outlets import AlarmOutlets, LineWriter, say_aside
from asm_gym.guard.live_events import LiveEvent, hold_by_hook, run_hook
from asm_gym.guard.live_watch import follow
from asm_gym.guard.operator_orders import Orders, taken_from, without_orders
from asm_gym.guard.watch_settings import WatchSettings
from asm_gym.guard.watchdog import Watchdog
from asm_gym.monitors import NeuralASM, load_monitor
from asm_gym.rollouts.progress import stage
from asm_gym.scripts.command import BAD_NEWS, DONE, REFUSED, option, origin, run
from asm_gym.scripts.log_options import LogOptions, exit_code_of_reading
from asm_gym.scripts.recording_review import Review, say_events, say_table
from asm_gym.validation import check_number
from asm_gym.wrappers.live_view import LiveView, check_where

INCIDENTS = "incidents"  # folder of the rows around alarms
AT_ONCE = 64  # episodes scored side by side
# Options of a live source.
LIVE_ONLY = ("until_alarm", "hook", "topic", "watchdog", "policy", "acknowledge", "keep", "rerun")
RECORDED_ONLY = ("rate", "channels", "ignore", "label", "columns")  # options of a recording


@dataclass(frozen=True, kw_only=True)
class Args(LogOptions):
    """Watches a recording, or rows as they come."""

    source: str = option(positional=True, metavar="SOURCE")
    """A log, folder or dataset, as for asm-gym fit; or a live source: -, tail:FILE, udp:PORT or dds:/TOPIC."""
    monitor: Path = option(metavar="FILE.asm")
    """The memory, written by asm-gym fit."""
    out: Path = option(Path("runs/watch"), metavar="FOLDER")
    """Folder of the table, the figures and the report of a recording, and of the rows around each alarm."""
    bridge: float | None = option(
        None, check=partial(check_number, "bridge", low=0.0), metavar="SECONDS"
    )
    """Longest gap without an alarm, by default two rows; rows in a gap are not judged."""
    wait: float = option(600.0, check=partial(check_number, "wait", low=0), metavar="SECONDS")
    """How long to wait for the first row of a live source, or for UDP or ROS 2 that died to return."""
    until_alarm: bool = False
    """End at the first alarm of a live source, with exit code 1: asm-gym watch ... --until-alarm || stop."""
    json: bool = False
    """Print events as JSON lines: kind, time, text, stamp, date, log, reason, channel, thresholds, latency_ms,
    cause, remedy, incident, group, sign, sensed, expected, plus_minus, unit, evidence."""
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
    acknowledge: tuple[str, ...] = option((), metavar="CHANNEL")
    """Channels of a live source, or all: the level shift of an open alarm is learned as soon as it is steady. By hand:
    the key a in a terminal, or the line 'acknowledge [ALARM]' on standard input; s, or 'snooze [SECONDS [ALARM]]',
    keeps an alarm silent for a time, 600 s by default. Both end with the run."""
    rerun: str | None = option(None, check=check_where, metavar="view|FILE.rrd|URL")
    """Show a live source in Rerun's viewer: view opens it, FILE.rrd is a recording for it, and
    rerun+http://HOST:PORT/proxy a viewer that runs elsewhere."""
    keep: Path | None = option(None, metavar="FILE.asm")
    """File to write the memory to, with the level shifts that were acknowledged."""
    follow_threshold: Path | None = option(None, metavar="FILE.json")
    """Let the threshold follow slow change, a step a minute; the file keeps it from run to run."""


def review(args: Args, monitor: Any, console: Console) -> int:
    """Score a recording, write its alarms and a report, and print the alarms."""
    following = following_of(args, monitor)
    reviewed = Review(following=following)
    if isinstance(monitor, NeuralASM):
        reviewed.wear = monitor.wear_counter()
    bridge = bridge_of(args.bridge, monitor.spec.dt)
    writable(args.out / "alarms.csv")
    with stage("watching") as progress, noted() as notes:
        logs = iter(read_logs(args.source, args.hints(), schema_of(args, monitor)))
        while group := list(islice(logs, AT_ONCE)):  # a folder may be larger than memory
            reviewed.add(group, monitor, bridge, args.out / INCIDENTS)
            progress(reviewed.episodes, reviewed.episodes)

    if following is not None:
        following.save()
    table = io.StringIO(newline="")
    rows = [map(plain_cell, alarm.cells()) for alarm in reviewed.alarms]
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
    tables = [recorded_alarms.by_hour(reviewed.alarms, reviewed.hours)]
    if reviewed.alarms:
        lines = [alarm.line() for alarm in reviewed.alarms]
        tables.append(Table("Alarms", TO_READ, lines))
    cards = {
        alarm.in_words(): figures.alarm_figure(alarm.moment, alarm.channel)
        for alarm in reviewed.largest()
        if alarm.moment is not None
    }
    report = args.out / "report.html"
    write_report(
        report,
        title=f"asm-gym watch: {args.source}",
        intro=f"{reviewed.summary()}, as {args.monitor} sees them.",
        tables=tables,
        cards=cards,
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
    orders: Orders = Queue()
    lines: Iterable[str] = open_lines(max(args.wait, args.silence))
    own_input = sys.stdin
    if args.source == "-":
        lines = without_orders(lines, orders)
        own_input = None
    beat = None
    view = None
    if args.rerun is not None:
        view = LiveView(monitor, args.rerun, schema_of(args, monitor).names_in_logs)
    outlets = outlets_of(args, console, view)
    with _watchdog(args, monitor.spec.dt) as watchdog, taken_from(own_input, orders):
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
            evidence=args.out / INCIDENTS,
            orders=orders,
            acknowledges=args.acknowledge,
            keep=args.keep,
            following=following_of(args, monitor),
            show=None if view is None else view.show_report,
        )
        try:
            alarms = follow(lines, monitor, outlets.say, settings)
        finally:
            outlets.close()
            if view is not None:
                view.close()
    if outlets.output_failed:
        return REFUSED
    if alarms:
        return BAD_NEWS
    return DONE


def following_of(args: Args, monitor: Any) -> FollowingThreshold | None:
    """Return the threshold that follows, where the options ask for it."""
    if args.follow_threshold is None:
        return None
    promise = hourly_promise(monitor.blocks_, monitor.threshold, len(monitor.maxima_))
    return FollowingThreshold.open(
        args.follow_threshold, monitor.threshold, per_hour=promise.rate, dt=monitor.spec.dt
    )


def outlets_of(args: Args, console: Console, view: LiveView | None) -> AlarmOutlets:
    """Return the outlets of events: first the hook, then the topic of ROS 2, the live view, then standard output."""
    outlets: list[Callable[[LiveEvent], object]] = []
    if args.hook:
        outlets.append(partial(run_hook, args.hook))
    if args.topic:
        publish_text = publisher(args.topic)
        outlets.append(lambda event: publish_text(event.to_json()))
    if view is not None:
        outlets.append(view.show_event)
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
