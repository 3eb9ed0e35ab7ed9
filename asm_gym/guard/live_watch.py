"""Watch rows as they come, in constant memory, whatever their source does.

    line ► problem? ► lost rows ► judge ► latency ► watchdog ► alarm or note

Nothing that a line holds ends a watch: a line that cannot be read is an alarm. Rows may be lost or
come at another rate, and a source may die and come back.
"""

from __future__ import annotations

import time
import warnings
from collections import deque
from collections.abc import Callable, Generator, Iterable, Iterator, Sequence
from datetime import UTC, datetime
from functools import partial
from itertools import chain
from typing import Any

import numpy as np
from numpy.typing import NDArray

from asm_gym.data.alarm_reasons import LATE, SURPRISING, thresholds_shown
from asm_gym.data.bridging import Bridge
from asm_gym.data.live_rows import Row, RowReader, SourceDied
from asm_gym.data.schema import LogSchema
from asm_gym.detection.alarm_rule import BENIGN_EVENTS, EVENTS, NO_EVENT
from asm_gym.detection.drift import Wear
from asm_gym.detection.incidents import AlarmRow, Incident, IncidentBook, power_of
from asm_gym.guard.adapter import Adapter, SensedRows
from asm_gym.guard.guard import Guard
from asm_gym.guard.incident_desk import IncidentDesk
from asm_gym.guard.live_causes import LiveCauses
from asm_gym.guard.live_events import (
    ALARM,
    CLOCK,
    DIED,
    NOTE,
    RATE,
    SUMMARY,
    UNREADABLE,
    WATCHDOG,
    LiveEvent,
    counted,
)
from asm_gym.guard.options import GuardOptions
from asm_gym.guard.robot_facts import RobotFacts
from asm_gym.guard.step_info import RowReport
from asm_gym.guard.watch_settings import USUAL, WatchSettings
from asm_gym.monitors.blame import FollowedBlame
from asm_gym.spec import StreamSpec
from asm_gym.validation import as_float32

MOST_LOST = 1000  # lost rows that a bridge is asked about one by one
LATENCIES = 10_000  # newest rows whose latency is kept
RETRY_S = 0.2  # time between two attempts to open a source again [s]
LONGEST_PROBLEM = 200  # characters of an unreadable line's problem in its alarm


def follow(
    lines: Iterable[str],
    monitor: Any,
    say: Callable[[LiveEvent], None],
    settings: WatchSettings = USUAL,
) -> int:
    """Watch a live source until it ends; say each alarm at once, those of one cause as one.

    Args:
        lines: rows as text, as ``asm_gym.data.live_sources.lines_from`` yields them.
        monitor: a calibrated monitor.
        say: called with every event.
        settings: how the source is watched.

    Returns:
        The number of alarms.

    Raises:
        ValueError: no row came, or the first line of a source that cannot be opened anew is no row.
    """
    watch = LiveWatch(monitor, say, settings)
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", ".*rows under this policy alarm")  # each alarm is said
        try:
            for row, arrival in watch.rows_of(lines):
                watch.follow_row(row, arrival)
                if watch.alarms and settings.until_alarm:
                    break
        except KeyboardInterrupt:
            if watch.rows:
                watch.summarise()
            raise
        finally:
            watch.close()
    watch.summarise()
    return watch.alarms


class LiveWatch(Adapter):
    """Judge the rows of a live source, and say what is wrong with them.

    Args:
        monitor: a calibrated monitor.
        say: called with every event.
        settings: how the source is watched.

    Attributes:
        rows: how many rows came or were lost.
        alarms: how many alarms there were.
    """

    def __init__(
        self,
        monitor: Any,
        say: Callable[[LiveEvent], None],
        settings: WatchSettings,
    ) -> None:
        spec: StreamSpec = monitor.spec
        self.rows = 0
        self.alarms = 0
        self._say = say
        self._settings = settings
        self._spec = spec
        schema = settings.schema or LogSchema.kept_in(getattr(monitor, "about", {}), spec)
        names = schema.names_in_logs
        self._reader = RowReader(schema, settings.clock, settings.silence_s)
        options = GuardOptions("monitor", contact_limits=None)
        self._guard = Guard(RobotFacts.unknown(spec), monitor, options, explains=False)
        self._no_action = np.zeros((1, spec.motor.size), np.float32)
        self._beat = settings.beat
        self._stamp: float | None = None  # of the newest row, by the robot's own clock [s]
        self._is_worn = False
        self._latencies: deque[float] = deque(maxlen=LATENCIES)  # [ms]
        self._unreadable_lines = 0
        self._line_book = IncidentBook()  # of unreadable lines, by their arrival
        self._book = IncidentBook(power_of(monitor))  # of all else, by the time of the rows
        self._desk = IncidentDesk(monitor, self._guard, settings, names, self._note)
        self._blame = FollowedBlame(monitor)
        self._causes = LiveCauses(monitor)
        self._names = names
        self._judge(np.zeros(spec.size), is_bridged=False)  # compiles
        self._begin()

    def _begin(self) -> None:
        """Forget the rows before: they are not the past of those that follow."""
        self._guard.begin()
        self._blame.begin()
        self._causes.begin()
        self._bridge = Bridge(self._settings.bridge_s, self._spec.dt, self._spec.size)
        self._was_over = False  # the surprise of the newest row was over its threshold
        self._last_event = NO_EVENT  # of the newest row
        self._desk.begin()

    def rows_of(self, lines: Iterable[str] | None) -> Iterator[tuple[Row, float]]:
        """Yield each row and its arrival [s], of a source and of the same opened anew."""
        settings = self._settings
        while lines is not None:
            try:
                yield from self._reader.rows(lines, max(settings.wait_s, settings.silence_s))
                return
            except SourceDied as error:
                self._alarm(f"the source has died, {error}: an alarm", DIED)
            if isinstance(lines, Generator):
                lines.close()  # the port of a source that died can be opened again
            lines = self._reopened()

    def _reopened(self) -> Iterable[str] | None:
        """Return the lines of the source once it is there again; None where it is not."""
        settings = self._settings
        if settings.reopen is None or settings.until_alarm or not self.rows:
            return None

        start = time.monotonic()
        while (left_s := start + settings.wait_s - time.monotonic()) > 0:
            lines = _opened(settings.reopen, left_s)
            if lines is not None:
                self._reader.begin()
                self._begin()
                self._book.end_all()
                self._note(f"the source is back after {time.monotonic() - start:.1f} s")
                return lines
            time.sleep(min(RETRY_S, left_s))
        self._note(f"the source did not come back within {settings.wait_s:g} s")
        return None

    def follow_row(self, row: Row, arrival: float) -> None:
        """Judge a row that can be read, and say what is wrong with it.

        Args:
            row: as it came.
            arrival: when its line came, by ``time.perf_counter`` [s].

        Raises:
            ValueError: the first line of a source that cannot be opened anew is no row.
        """
        self._stamp = row.stamp
        self._check_reading(row, arrival)
        if not row.read:
            return

        self.rows += 1
        if row.lost:
            self._pass_lost_rows(row.lost)

        report = self._judge(row.numbers, self._bridge.goes_over(np.isnan(row.numbers)))
        self._latencies.append(1e3 * (time.perf_counter() - arrival))
        self._check_watchdog()
        self.report_step([report], row)
        self._desk.after_row(self._now, row, report, self._book)
        if self._settings.show is not None:
            self._settings.show(self._now, row.numbers, report)

    def _check_reading(self, row: Row, arrival: float) -> None:
        """Say what is wrong with the line, the clock or the rate."""
        if row.problem and not self.rows and self._settings.reopen is None:
            raise ValueError(row.problem)
        if row.problem and not row.read:  # the line is no row, or came too late
            self._count_unreadable(row.problem, arrival)
        elif row.problem:  # the clock was set anew
            self._alarm_once(f"{row.problem}: an alarm, and a new beginning", CLOCK)
            self._begin()
        elif row.change and row.read:  # rows come at another rate, and can be judged
            self._note(row.change)
        elif row.change:  # they cannot
            self._alarm_once(f"{row.change}: they are not judged, an alarm", RATE)
            self._begin()

    def _count_unreadable(self, problem: str, arrival: float) -> None:
        """Count a line that cannot be read."""
        self._unreadable_lines += 1
        if self._line_book.note(UNREADABLE, arrival) is not None:
            self._alarm(f"{problem[:LONGEST_PROBLEM]}: an alarm", UNREADABLE)

    def _pass_lost_rows(self, lost: int) -> None:
        """Go on over rows that did not come, as many as the bridge allows."""
        missing = np.full(self._spec.size, np.nan)
        asked = min(lost, MOST_LOST)
        bridged = [self._bridge.goes_over(np.isnan(missing)) for _ in range(asked)]
        is_alarm = not all(bridged)
        passed = asked
        if is_alarm:
            passed = 1
        for _ in range(passed):
            self._judge(missing, is_bridged=True)

        if is_alarm:
            self._alarm_once(f"{counted(lost, 'row')} lost: an alarm ({LATE})", LATE)
        self.rows += lost

    def _judge(self, numbers: NDArray[np.float64], is_bridged: bool) -> RowReport:
        """Return the report of a row (D,); a bridged row raises no alarm."""
        is_active = np.array([not is_bridged])
        return self._guard.judge(self.sense_rows(numbers), self._no_action, active=is_active)

    def _check_watchdog(self) -> None:
        """Tell the watchdog that a row was judged; its death is one alarm."""
        if self._beat is not None and not self._beat():
            self._beat = None
            self._alarm("the watchdog has died: an alarm", WATCHDOG)

    def sense_rows(self, given: NDArray[np.float64]) -> SensedRows:
        """Return the numbers (D,) of a line as the row of one robot."""
        return SensedRows(as_float32(given)[None])

    def send_command(self, command: Any) -> None:
        """Send nothing: a watch commands no robot."""

    def report_step(self, reports: Sequence[RowReport], target: Row) -> None:
        """Say alarms and events of the row that the reports are of."""
        for report in reports:
            cause = self._causes.follow(self._guard.recentred(target.numbers))
            if cause is not None:
                text = f"cause: {cause.in_words(self._names, self._spec.units)}; {cause.remedy}"
                self._note(text, cause=cause.name, remedy=cause.remedy)
            self._report_surprise(report, target.numbers)
            self._report_event(EVENTS[report.robots["event"][0]])
            self._report_wear(report.wear.get(0))

    def _report_surprise(self, report: RowReport, numbers: NDArray[np.float64]) -> None:
        """Raise an alarm where surprise over its threshold opens an incident."""
        robot = report.robots[0]
        self._blame.add(self._guard.recentred(numbers))
        follows = self._was_over
        self._was_over = bool(robot["over"])
        if not self._was_over:
            return
        shares = report.attribution[0]
        row = AlarmRow(
            time=self._now,
            numbers=numbers,
            shares=shares,
            surprise=float(robot["surprise"]),
            threshold=float(robot["threshold"]),
            follows=follows,
            blame=partial(self._blame.columns, shares),
        )
        incident = self._book.follow(row)
        if incident is not None:
            self._alarm_surprise(incident, numbers)
            if incident.reason == SURPRISING:
                self._causes.open(incident.blamed)

    def _alarm_surprise(self, incident: Incident, numbers: NDArray[np.float64]) -> None:
        """Raise the alarm of an incident that a row opens."""
        latency_ms = self._latencies[-1]
        excess = thresholds_shown(incident.excess)
        text = f"{excess} thresholds  {latency_ms:.2f} ms after the row came"
        if incident.reason != SURPRISING:
            text += f"  ({incident.reason})"
        details = self._desk.details(incident, numbers, self.alarms + 1)
        if incident.column is not None:
            text = f"{details.channel}  {text}{details.in_words}"
        self._alarm(
            text,
            incident.reason,
            thresholds=incident.excess,
            latency_ms=latency_ms,
            **details.fields,
        )

    def _alarm_once(self, text: str, reason: str) -> None:
        """Raise an alarm that points to no channel, unless it belongs to an incident that is open."""
        if self._book.note(reason, self._now) is not None:
            self._alarm(text, reason)

    @property
    def _now(self) -> float:
        """Time of the rows up to now [s]."""
        return self.rows * self._spec.dt

    def _report_event(self, event: str) -> None:
        """Note a knock or a stop when it begins."""
        if event in BENIGN_EVENTS and event != self._last_event:
            self._note(f"{event}: no alarm")
        self._last_event = event

    def _report_wear(self, wear: Wear | None) -> None:
        """Note wear when it begins."""
        if wear is not None and not self._is_worn:
            self._note(f"{wear}; no alarm")
        self._is_worn = wear is not None

    def _alarm(self, text: str, reason: str, **details: Any) -> None:
        """Count and say an alarm."""
        self.alarms += 1
        self._note(text, kind=ALARM, reason=reason, incident=self.alarms, **details)

    def _note(self, text: str, kind: str = NOTE, **details: Any) -> None:
        """Say an event of the newest row."""
        event = LiveEvent(
            kind=kind,
            time=self._now,
            text=text,
            stamp=self._stamp,
            date=datetime.now(UTC).isoformat(timespec="milliseconds"),
            **details,
        )
        self._say(event)

    def close(self) -> None:
        """Write what is left to write."""
        self._desk.close()

    def summarise(self) -> None:
        """Say how many rows and alarms there were, and how long a row took.

        Raises:
            ValueError: no row came.
        """
        if not (self.rows or self._unreadable_lines):
            raise ValueError("no row came")
        text = f"{self.rows} rows, {counted(self.alarms, 'alarm')}"
        if self._unreadable_lines:
            text += f", {counted(self._unreadable_lines, 'line')} that could not be read"
        if self._latencies:
            median, slow = np.percentile(self._latencies, [50, 99])
            text += f"; a row took {median:.2f} ms, 99 % of the newest under {slow:.2f} ms"
        self._note(text, SUMMARY)


def _opened(reopen: Callable[[float], Iterator[str]], first_s: float) -> Iterable[str] | None:
    """Return the lines of a source; None where it is not there, or sends none in ``first_s``."""
    try:
        lines = reopen(first_s)
        first_line = next(filter(str.strip, lines))  # skips blank lines
    except (OSError, SourceDied, StopIteration):
        return None
    return chain([first_line], lines)
