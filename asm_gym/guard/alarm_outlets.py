"""Tell an alarm to the hook, to the topic and to the reader of standard output, so that none silences another.

    event ► hook ► topic ► queue ► a thread that writes lines to standard output

Printing comes last and in a thread of its own: a pipe that is closed or that nobody reads stops
neither the watch nor the hook. That it fails is told to hook and topic as an alarm.
"""

from __future__ import annotations

import os
import sys
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from io import UnsupportedOperation
from queue import Full, Queue
from threading import Thread
from typing import Any

from asm_gym.guard.live_events import ALARM, OUTPUT, LiveEvent

MOST_WAITING = 1000  # lines that wait to be written; later ones are left out
STUCK_S = 1.0  # a line that takes longer to write is not read by anybody [s]
RETRY_S = 0.01  # time between two attempts to write to a full pipe [s]
LAST_S = 2.0  # how long the end of a watch waits for its last lines [s]

# Problems of standard output.
CLOSED = "standard output is closed"
NOBODY_READS = "nobody reads standard output"

Tell = Callable[[LiveEvent], object]


class LineWriter:
    """Write lines to a file in a thread of its own.

    Args:
        file: such as ``sys.stdout``; None where there is none.

    Attributes:
        problem: why lines are not written; empty while they are.
    """

    def __init__(self, file: Any) -> None:
        self.problem = ""
        self._file = file
        self._lines: Queue[str] = Queue(MOST_WAITING)
        self._since: float | None = None  # when the line that is being written was begun [s]
        self._is_closed = file is None
        if self._is_closed:
            self.problem = CLOSED
        Thread(target=self._write_all, daemon=True).start()

    def put(self, line: str) -> None:
        """Write a line soon; leave it out if too many wait."""
        self._check_progress()
        with suppress(Full):
            self._lines.put_nowait(line + "\n")

    def close(self) -> None:
        """Wait, at most ``LAST_S``, until all lines are written."""
        end = time.monotonic() + LAST_S
        while self._lines.unfinished_tasks and not self._is_closed and time.monotonic() < end:
            time.sleep(0.001)
        if self._lines.unfinished_tasks:
            self.problem = self.problem or NOBODY_READS

    def _check_progress(self) -> None:
        """Note that nobody reads."""
        since = self._since
        is_stuck = since is not None and time.monotonic() - since > STUCK_S
        if is_stuck or self._lines.full():
            self.problem = self.problem or NOBODY_READS

    def _write_all(self) -> None:
        """Write lines one after another, also after a while in which nobody read."""
        while not self._is_closed:
            line = self._lines.get()
            self._since = time.monotonic()
            try:
                self._write(line)
            except (OSError, ValueError):  # ValueError: the file is closed
                self.problem = self.problem or CLOSED
                self._is_closed = True
                return
            self._since = None
            self._lines.task_done()

    def _write(self, line: str) -> None:
        """Write a line without a buffer that the end of the process would wait for."""
        try:
            number = self._file.fileno()
        except (AttributeError, UnsupportedOperation):  # text in memory
            self._file.write(line)
            return
        rest = line.encode(errors="replace")
        while rest:
            try:
                rest = rest[os.write(number, rest) :]
            except BlockingIOError:  # a full pipe that does not block
                time.sleep(RETRY_S)


class AlarmOutlets:
    """Say the events of a live watch.

    Args:
        outlets: what is told each alarm, in this order: the hook, the topic.
        writer: prints each event.
        as_json: events are printed as JSON lines.

    Attributes:
        output_failed: standard output could not be written.
    """

    def __init__(self, outlets: Sequence[Tell], writer: LineWriter, as_json: bool) -> None:
        self.output_failed = False
        self._outlets = outlets
        self._writer = writer
        self._as_json = as_json
        self._failed: set[str] = set()  # errors of outlets that the user was told

    def say(self, event: LiveEvent) -> None:
        """Tell an alarm to the outlets, then print the event."""
        if event.kind == ALARM:
            self._tell(event)
        self._writer.put(event.to_json() if self._as_json else str(event))
        self._check_output(event.time)

    def close(self, time_s: float = 0.0) -> None:
        """Wait for the last lines; a writer that cannot write them is an alarm too."""
        self._writer.close()
        self._check_output(time_s)

    def _tell(self, event: LiveEvent) -> None:
        """Tell an alarm to every outlet, whatever becomes of the others."""
        for outlet in self._outlets:
            try:
                outlet(event)
            except Exception as error:
                message = f"an outlet of alarms failed: {error!r}"
                if message not in self._failed:
                    self._failed.add(message)
                    say_aside(message)

    def _check_output(self, time_s: float) -> None:
        """Raise an alarm, once, if standard output cannot be written."""
        problem = self._writer.problem
        if not problem or self.output_failed:
            return
        self.output_failed = True
        text = f"{problem}: the watch goes on, and hook and topic are told"
        self._tell(LiveEvent(kind=ALARM, time=time_s, text=text, reason=OUTPUT))
        say_aside(text)


def say_aside(message: str) -> None:
    """Print a message on standard error, in a thread: that may be a full pipe as well."""

    def print_it() -> None:
        with suppress(OSError, ValueError):
            print(f"asm-gym: {message}", file=sys.stderr, flush=True)

    thread = Thread(target=print_it, daemon=True)
    thread.start()
    thread.join(0.1)
