"""How alarms leave a watch for machines: JSON lines, a command that is run, and a topic of ROS 2."""

from __future__ import annotations

import json
import logging
import math
import shlex
import shutil
import subprocess
from typing import Any

from asm_gym.guard.live import ALARM, LiveEvent


def as_json(event: LiveEvent) -> str:
    """Return an event as one line of JSON; a number that is not finite is text: ``"inf"``, ``"nan"``."""
    fields: dict[str, Any] = event._asdict()
    finite = {k: str(v) if isinstance(v, float) and not math.isfinite(v) else v for k, v in fields.items()}
    return json.dumps(finite, allow_nan=False)


LOG = logging.getLogger("asm_gym.watch")


class AlarmCommand:
    """Runs a command at every alarm, with the alarm as JSON on its standard input; nothing waits for it.

    Raises:
        ValueError: the command is empty, its quotes do not match, or there is no such program.
    """

    def __init__(self, command: str) -> None:
        self._words = shlex.split(command)
        if not self._words:
            raise ValueError("a command to run at an alarm must not be empty")
        if shutil.which(self._words[0]) is None:
            raise ValueError(f"there is no program {self._words[0]} to run at an alarm")
        self._running: list[subprocess.Popen[str]] = []

    def __call__(self, event: LiveEvent) -> None:
        self._running = [process for process in self._running if process.poll() is None]
        if event.kind != ALARM:
            return
        try:
            process = subprocess.Popen(self._words, stdin=subprocess.PIPE, text=True, start_new_session=True)
        except OSError as error:  # the watch goes on, and the alarm was printed
            LOG.error("the command %s did not run: %s", self._words[0], error)
            return
        assert process.stdin is not None
        try:
            with process.stdin as file:
                file.write(as_json(event) + "\n")
        except BrokenPipeError:  # it does not read
            pass
        self._running.append(process)

    def wait(self, seconds: float) -> None:
        """Wait for commands that run, each for at most so many seconds."""
        for process in self._running:
            try:
                process.wait(seconds)
            except subprocess.TimeoutExpired:
                continue
