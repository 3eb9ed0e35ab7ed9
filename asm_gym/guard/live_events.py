"""Say alarms, notes and a summary of a watch: as text, as JSON, or to the user's command."""

from __future__ import annotations

import json
import math
import subprocess
from contextlib import suppress
from dataclasses import asdict, dataclass
from threading import Thread

# Kinds of events.
ALARM = "alarm"
NOTE = "note"
SUMMARY = "summary"

# Reasons of alarms, beside those of ``asm_gym.data.alarm_reasons``.
DIED = "source died"
UNREADABLE = "unreadable"
CLOCK = "clock"
RATE = "rate"
WATCHDOG = "watchdog"
OUTPUT = "output"


@dataclass(frozen=True, slots=True)
class LiveEvent:
    """An alarm, a note or the summary of a watch; as text it is a line for the user."""

    kind: str  # ``ALARM``, ``NOTE`` or ``SUMMARY``
    time: float  # of the rows up to now [s]
    text: str  # what happened
    reason: str = ""  # of an alarm
    channel: str = ""  # that an alarm points to
    thresholds: float | None = None  # surprise over its threshold; infinite for missing numbers
    latency_ms: float | None = None  # from the arrival of the row to the alarm [ms]
    stamp: float | None = None  # of the row, by the robot's own clock [s]
    # Wall clock, ISO 8601: when it happened, or by a clock of dates; empty if unknown.
    date: str = ""
    cause: str = ""  # in words, once it is known
    remedy: str = ""  # what to do about it
    log: str = ""  # the recording; empty of a live source
    incident: int | None = None  # its number, from 1
    group: str = ""  # of the channel
    sign: str = ""  # ``+`` or ``-``: where the channel is from what is expected; empty if unknown
    sensed: float | None = None  # number of the channel [unit]
    expected: float | None = None  # by all other senses; None if unknown [unit]
    plus_minus: float | None = None  # standard deviation of what is expected [unit]
    unit: str = ""
    evidence: str = ""  # file with the rows around the incident, written five seconds later

    def __str__(self) -> str:
        if self.kind == SUMMARY:
            return self.text
        time = self.time
        if self.stamp is not None:
            time = self.stamp
        return f"{time:.3f} s  {self.text}"

    def to_json(self) -> str:
        """Return one line of JSON; a number that is not finite is text: ``"inf"``, ``"nan"``."""
        fields = asdict(self)
        for name, value in fields.items():
            if isinstance(value, float) and not math.isfinite(value):
                fields[name] = str(value)
        return json.dumps(fields)


def run_hook(command: str, event: LiveEvent) -> None:
    """Run a shell command with an event as JSON on its standard input; do not wait for it.

    What it prints is left out: a pipe that nobody reads would stop it.
    """
    process = subprocess.Popen(
        command,
        shell=True,
        stdin=subprocess.PIPE,
        stdout=subprocess.DEVNULL,
        text=True,
        start_new_session=True,
    )
    assert process.stdin is not None
    with suppress(BrokenPipeError), process.stdin as file:  # the command need not read
        file.write(event.to_json() + "\n")
    Thread(target=process.wait, daemon=True).start()


def hold_by_hook(command: str, why: str) -> None:
    """Run a shell command as ``run_hook`` does, for a watchdog that reports ``why``."""
    run_hook(command, LiveEvent(ALARM, 0.0, f"{why}: an alarm", WATCHDOG))


def counted(count: int, noun: str) -> str:
    """Return a number of things: ``1 row``, ``2 rows``."""
    if count == 1:
        return f"1 {noun}"
    return f"{count} {noun}s"
