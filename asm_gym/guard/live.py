"""Watch rows as they come, in constant memory, over lost rows, other rates and sources that die and come back.

Nothing that a line holds ends a watch: a line that cannot be read is an alarm.
"""

from __future__ import annotations

import json
import math
import subprocess
import time
import warnings
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from contextlib import suppress
from itertools import chain
from threading import Thread
from typing import Any, NamedTuple

import numpy as np

from asm_gym.data.rows import Row, RowReader, SourceDied
from asm_gym.data.timing import LATE, SURPRISING, TOGETHER_S, Bridge, blamed, reason
from asm_gym.detection.alarm_rule import EVENTS, KNOCK, NO_EVENT, STOP
from asm_gym.guard.engine import Engine
from asm_gym.guard.options import GuardOptions
from asm_gym.guard.report import RowReport
from asm_gym.guard.robots import Robots
from asm_gym.spec import StreamSpec
from asm_gym.validation import as_float32

MOST_LOST = 1000  # lost rows that a bridge is asked about one by one
LATENCIES = 10_000  # newest rows whose latency is kept
RETRY_S = 0.2  # time between two attempts to open a source again [s]

ALARM, NOTE, SUMMARY = "alarm", "note", "summary"  # kinds of events
DIED, UNREADABLE, CLOCK, RATE, WATCHDOG = "source died", "unreadable", "clock", "rate", "watchdog"
"""Why there is an alarm, beside surprise."""

Opened = Callable[[float], Iterator[str]]
Beat = Callable[[], bool] | None


class LiveEvent(NamedTuple):
    """What a watch has to say; as text it is a line for the user."""

    kind: str  # ``ALARM``, ``NOTE`` or ``SUMMARY``
    time: float  # of the rows up to now [s]
    text: str
    reason: str = ""  # of an alarm
    channel: str = ""  # that an alarm points to
    thresholds: float | None = None  # surprise over its threshold; infinite where something is missing
    latency_ms: float | None = None  # from the arrival of the row to the alarm

    def __str__(self) -> str:
        return self.text if self.kind == SUMMARY else f"{self.time:.3f} s  {self.text}"

    def to_json(self) -> str:
        """Return it as one line for machines; a number that is not finite is text: ``"inf"``, ``"nan"``."""
        fields: dict[str, Any] = self._asdict()
        return json.dumps(
            {k: str(v) if isinstance(v, float) and not math.isfinite(v) else v for k, v in fields.items()}
        )


def run_hook(command: str, event: LiveEvent) -> None:
    """Run a shell command with an event as a line of JSON on its standard input; nothing waits for it."""
    process = subprocess.Popen(command, shell=True, stdin=subprocess.PIPE, text=True, start_new_session=True)
    assert process.stdin is not None
    with suppress(BrokenPipeError), process.stdin as file:  # it need not read
        file.write(event.to_json() + "\n")
    Thread(target=process.wait, daemon=True).start()


def hold_by_hook(command: str, why: str) -> None:
    """Run a shell command as ``run_hook`` does, for a watchdog that tells ``why``."""
    run_hook(command, LiveEvent(ALARM, 0.0, f"{why}: an alarm", WATCHDOG))


def follow(
    lines: Iterable[str],
    monitor: Any,
    say: Callable[[LiveEvent], None],
    seconds: float = 0.0,
    again: Opened | None = None,
    wait: float = 0.0,
    until_alarm: bool = False,
    beat: Beat = None,
    clock: str = "",
    silence: float = 2.0,
) -> int:
    """Say every alarm as it is raised, and why; return how many there were. Those of one cause are one.

    Args:
        lines, monitor: rows, as ``asm_gym.data.live.lines_from`` yields them; a calibrated monitor.
        say: takes what there is to say.
        seconds: that something may be missing without an alarm.
        again, wait: opens the source anew after it has died; for how long that is tried [s]. It is given how long the
            first line may take.
        until_alarm: the first alarm ends the watch.
        beat: of a watchdog, told of every row that was judged; it returns whether the watchdog lives.
        clock: the column of times; by default the first that is called so.
        silence: after which the numbers of a publisher, of several, are missing [s].

    Raises:
        ValueError: no row came, or the first line of a source that cannot be opened anew is no row.
    """
    watch = _Watch(monitor, say, seconds, beat, RowReader(monitor.spec, clock, silence))
    source: Iterable[str] | None = lines
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", ".*rows under this policy alarm")  # every alarm is said here
        try:
            while source is not None:
                died = watch.follow(source, again is not None, until_alarm)
                source = watch.reopened(again, wait) if died and again is not None and watch.rows else None
        except KeyboardInterrupt:
            if watch.rows:
                watch.summarise()
            raise
    watch.summarise()
    return watch.alarms


class _Watch:
    """The state of a source while it is watched; the arguments are those of ``follow``."""

    def __init__(
        self, monitor: Any, say: Callable[[LiveEvent], None], seconds: float, beat: Beat, reader: RowReader
    ) -> None:
        self.say, self.seconds, self.spec, self.beat = say, seconds, monitor.spec, beat
        spec: StreamSpec = monitor.spec
        self.engine = Engine(Robots.unknown(spec), monitor, GuardOptions("monitor", contact_limits=None))
        self.reader = reader
        self.no_action = np.zeros((1, spec.motor.size), np.float32)
        self.latencies: deque[float] = deque(maxlen=LATENCIES)
        self.rows = self.alarms = self.unreadable = 0
        self.unreadable_at = -np.inf  # when a line that cannot be read came last, by ``time.perf_counter``
        self._judge(np.zeros(spec.size), bridged=False)  # compiles
        self._begin()

    def _begin(self) -> None:
        """Begin anew: no row before is the past of those that follow."""
        self.engine.begin()
        self.bridge = Bridge(self.seconds, self.spec.dt, self.spec.size)
        self.late, self.above, self.event = False, "", NO_EVENT  # above: why surprise is, empty where it is not
        self.newest = dict[str, int]()  # row over the threshold, by why it was

    def _judge(self, numbers: Any, bridged: bool) -> RowReport:
        return self.engine.judge(as_float32(numbers)[None], self.no_action, active=np.array([not bridged]))

    def alarm(self, text: str, reason: str, ahead: int = 0, **about: Any) -> None:
        """Count an alarm, and say at which row it was, so many ahead of the newest."""
        self.alarms += 1
        self._note(text, ahead, kind=ALARM, reason=reason, **about)

    def _note(self, text: str, ahead: int = 0, kind: str = NOTE, **about: Any) -> None:
        self.say(LiveEvent(kind, (self.rows + ahead) * self.spec.dt, text, **about))

    def follow(self, lines: Iterable[str], returns: bool, until_alarm: bool) -> bool:
        """Watch rows until the source ends or dies, or until an alarm; return whether it died."""
        try:
            for row, arrived in self.reader.rows(lines):
                if row.problem and not (returns or self.rows):
                    raise ValueError(row.problem)
                self._row(row, arrived)
                if until_alarm and self.alarms:
                    return False
        except SourceDied as error:
            self.alarm(f"the source has died, {error}: an alarm", DIED)
            return not until_alarm
        return False

    def reopened(self, again: Opened, wait: float) -> Iterable[str] | None:
        """Return the lines of the source once it is there again; None where it did not come back."""
        start = time.monotonic()
        while (left := start + wait - time.monotonic()) > 0:
            try:
                lines = again(left)
                first = next(lines, None)
            except (OSError, SourceDied):
                first = None
            if first is not None:
                self.reader.begin()
                self._begin()
                self._note(f"the source is back after {time.monotonic() - start:.1f} s")
                return chain([first], lines)
            time.sleep(min(RETRY_S, left))
        self._note(f"the source did not come back within {wait:g} s")
        return None

    def _row(self, row: Row, arrived: float) -> None:
        if row.problem and not row.read:
            self.unreadable += 1
            if arrived - self.unreadable_at > TOGETHER_S:
                self.alarm(f"{row.problem[:200]}: an alarm", UNREADABLE)
            self.unreadable_at = arrived
        elif row.problem:
            self.alarm(f"{row.problem}: an alarm, and a new beginning", CLOCK)
            self._begin()
        elif row.change and row.read:
            self._note(row.change)
        elif row.change:
            self.alarm(f"{row.change}: they are not judged, an alarm", RATE)
            self._begin()
        if not row.read:
            return
        if row.lost:
            self._lost(row.lost)
        self.late = row.lost > 0
        self.rows += 1 + row.lost
        numbers = row.numbers
        report = self._judge(numbers, bridged=self.bridge.over(np.isnan(numbers)))
        self.latencies.append(1e3 * (time.perf_counter() - arrived))
        if self.beat is not None and not self.beat():
            self.beat = None
            self.alarm("the watchdog has died: an alarm", WATCHDOG)
        excess = float(report.surprise.value[0] / report.threshold[0])
        why = (self.above or reason(numbers)) if excess > 1.0 else ""
        if why and (self.rows - self.newest.get(why, -math.inf)) * self.spec.dt > TOGETHER_S:
            at = blamed(numbers, report.surprise.attribution[0])
            channel = "" if at is None else self.spec.labels[at]
            because = "" if why == SURPRISING else f"  ({why})"
            took = self.latencies[-1]
            text = f"{excess:.2f} thresholds  {took:.2f} ms after the row came{because}"
            text = f"{channel}  {text}" if channel else text
            self.alarm(text, why, channel=channel, thresholds=excess, latency_ms=took)
        event = EVENTS[report.event[0]]
        if event in (KNOCK, STOP) and event != self.event:
            self._note(f"{event}: no alarm")
        self.above, self.event = why, event
        if why:
            self.newest[why] = self.rows

    def _lost(self, lost: int) -> None:
        """Go on over rows that did not come, as many as the bridge allows."""
        missing = np.ones(self.spec.size, bool)
        over = [self.bridge.over(missing) for _ in range(min(lost, MOST_LOST))]
        for _ in over if all(over) else over[:1]:
            self._judge(np.full(self.spec.size, np.nan), bridged=True)
        if not all(over) and not self.late:  # of rows that are late again and again it is said once
            self.alarm(f"{lost} row{'s' * (lost != 1)} lost: an alarm ({LATE})", LATE, ahead=1)

    def summarise(self) -> None:
        """Say how many rows and alarms there were, and how long a row took."""
        if not (self.rows or self.unreadable):
            raise ValueError("no row came")
        text = f"{self.rows} rows, {self.alarms} alarm{'s' * (self.alarms != 1)}"
        if self.unreadable:
            text += f", {self.unreadable} line{'s' * (self.unreadable != 1)} that could not be read"
        if self.latencies:
            median, late = np.percentile(self.latencies, [50, 99])
            text += f"; a row took {median:.2f} ms, 99 % of the newest under {late:.2f} ms"
        self._note(text, kind=SUMMARY)
