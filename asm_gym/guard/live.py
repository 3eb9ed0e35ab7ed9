"""Watch rows as they come, in constant memory, over lost rows, other rates and sources that die and come back."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from itertools import chain
from typing import Any

import numpy as np

from asm_gym.data.gaps import LATE, SURPRISING, Bridge, blamed, reason
from asm_gym.data.live import SourceDied
from asm_gym.data.rows import ClockWentBack, Row, RowReader
from asm_gym.detection.events import KNOCK, NO_EVENT, STOP
from asm_gym.spec import StreamSpec

MOST_LOST = 1000
"""Lost rows that a bridge is asked about one by one."""

LATENCIES = 10_000
"""Newest rows whose latency is kept."""

TRIES_S = 0.2
"""How long after a source could not be opened it is tried again [s]."""

Opened = Callable[[], Iterator[str]]


def follow(
    lines: Iterable[str],
    monitor: Any,
    say: Callable[[str], None],
    seconds: float = 0.0,
    again: Opened | None = None,
    wait: float = 0.0,
) -> int:
    """Say every alarm as it is raised, and why; return how many there were.

    Args:
        lines: rows, as ``asm_gym.data.live.lines_from`` yields them.
        monitor: calibrated.
        say: takes a line for the user.
        seconds: that something may be missing without an alarm.
        again: opens the source anew after it has died, or its clock went back.
        wait: for how long that is tried [s].

    Raises:
        ValueError: no row came, or a line is no row.
    """
    watching = _Watch(monitor, say, seconds)
    source: Iterable[str] | None = lines
    try:
        while source is not None:
            died = watching.follow(source, again is not None)
            source = None if not died or again is None or not watching.rows else watching.reopened(again, wait)
    except KeyboardInterrupt:
        if watching.rows:
            watching.summarise()
        raise
    watching.summarise()
    return watching.alarms


class _Watch:
    """The state of a source while it is watched.

    Args:
        monitor: calibrated.
        say: prints a line.
        seconds: that something may be missing without an alarm.
    """

    def __init__(self, monitor: Any, say: Callable[[str], None], seconds: float) -> None:
        self.monitor, self.say, self.seconds = monitor, say, seconds
        self.spec: StreamSpec = monitor.spec
        self.latencies: deque[float] = deque(maxlen=LATENCIES)
        self.rows = self.alarms = 0
        self._begin()
        self.monitor.observe(self.state, np.zeros((1, self.spec.size)))  # compiles; the state is a value and stays

    def _begin(self) -> None:
        """Begin anew: rows before are no past of those that follow."""
        self.state = self.monitor.initial_state(1)
        self.bridge = Bridge(self.seconds, self.spec.dt, self.spec.size)
        self.above = self.late = False
        self.event = NO_EVENT

    def alarm(self, what: str) -> None:
        """Count an alarm, and say when it was."""
        self.alarms += 1
        self.say(f"{self.rows * self.spec.dt:.3f} s  {what}")

    def follow(self, lines: Iterable[str], returns: bool) -> bool:
        """Watch rows until the source ends or dies; return whether it died."""
        try:
            for row, arrived in RowReader(self.spec).rows(lines):
                self._row(row, arrived)
        except SourceDied as error:
            self.alarm(f"the source has died, {error}: an alarm")
            return True
        except ClockWentBack as error:
            if not returns:
                raise
            self.alarm(f"{error}: an alarm, and a new beginning")
            return True
        return False

    def reopened(self, again: Opened, wait: float) -> Iterable[str] | None:
        """Return the lines of the source once it is there again; None where it did not come back."""
        start = time.monotonic()
        while time.monotonic() - start < wait:
            try:
                lines = again()
                first = next(lines, None)
            except (OSError, SourceDied):
                first = None
            if first is not None:
                self._begin()
                self.say(f"{self.rows * self.spec.dt:.3f} s  the source is back after {time.monotonic() - start:.1f} s")
                return chain([first], lines)
            time.sleep(TRIES_S)
        self.say(f"the source did not come back within {wait:g} s")
        return None

    def _row(self, row: Row, arrived: float) -> None:
        if row.change:
            if row.read:
                self.say(f"{self.rows * self.spec.dt:.3f} s  {row.change}")
            else:
                self.alarm(row.change)
                self._begin()
        if not row.read:
            return
        if row.lost:
            self._lost(row.lost)
        self.late = row.lost > 0
        self.rows += 1 + row.lost
        numbers = row.numbers
        self.state, surprise = self.monitor.observe(self.state, numbers[None])
        value = 0.0 if self.bridge.over(np.isnan(numbers)) else float(surprise.value[0])
        self.latencies.append(1e3 * (time.perf_counter() - arrived))
        threshold = self.monitor.threshold
        if value > threshold and not self.above:
            at, why = blamed(numbers, surprise.attribution[0]), reason(numbers)
            channel = "" if at is None else self.spec.labels[at] + "  "
            late = f"{self.latencies[-1]:.2f} ms after the row came"
            because = "" if why == SURPRISING else f"  ({why})"
            self.alarm(f"{channel}{value / threshold:.2f} thresholds  {late}{because}")
        event = NO_EVENT if value == 0.0 else surprise.event(threshold)
        if event in (KNOCK, STOP) and event != self.event:
            self.say(f"{self.rows * self.spec.dt:.3f} s  {event}: no alarm")
        self.above, self.event = value > threshold, event

    def _lost(self, lost: int) -> None:
        """Rows that did not come: the memory runs on over as many as may be missing."""
        nothing = np.full(self.spec.size, np.nan)
        over = [self.bridge.over(np.isnan(nothing)) for _ in range(min(lost, MOST_LOST))]
        for _ in over if all(over) else over[:1]:
            self.state, _ = self.monitor.observe(self.state, nothing[None])
        if not all(over) and not self.late:  # of rows that are late again and again it is said once
            self.alarms += 1
            when = (self.rows + 1) * self.spec.dt
            self.say(f"{when:.3f} s  {lost} row{'s' * (lost != 1)} lost: an alarm ({LATE})")

    def summarise(self) -> None:
        """Say how many rows and alarms there were, and how long a row took."""
        if not self.rows:
            raise ValueError("no row came")
        median, late = np.percentile(self.latencies, [50, 99])
        counted = f"{self.rows} rows, {self.alarms} alarm{'s' * (self.alarms != 1)}"
        self.say(f"{counted}; a row took {median:.2f} ms, 99 % of the newest under {late:.2f} ms")
