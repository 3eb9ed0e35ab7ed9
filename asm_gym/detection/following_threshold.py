"""The adaptive threshold in a watch: a minute of rows is its episode, and its state outlives the run in a file."""

from __future__ import annotations

import json
import math
from dataclasses import asdict
from pathlib import Path
from typing import Any, Self

import numpy as np

from asm_gym.detection.adaptive import AdaptiveThreshold, RunningThreshold
from asm_gym.detection.alarm_rule import rows_of_a_minute
from asm_gym.detection.base import Array, Floats
from asm_gym.files import write_text
from asm_gym.validation import short_repr

MOST_A_MINUTE = 0.5  # largest share of minutes in alarm that a promise may ask for


class FollowingThreshold:
    """A threshold that moves every minute.

    Args:
        running: the adaptive threshold.
        calibrated: the threshold that it began at.
        dt: period of the rows [s].
        path: file of its state.
    """

    def __init__(self, running: RunningThreshold, calibrated: float, dt: float, path: Path) -> None:
        self._running = running
        self._calibrated = calibrated
        self._rows_of_a_minute = rows_of_a_minute(dt)
        self._path = path
        self._rows = 0
        self._largest = 0.0
        self._confirmed = False

    @classmethod
    def open(cls, path: Path, calibrated: float, per_hour: float, dt: float) -> Self:
        """Go on from the state in a file; begin at the calibrated threshold where there is none.

        Args:
            path: of the state.
            calibrated: threshold of the memory.
            per_hour: promised false alarms an hour.
            dt: period of the rows [s].

        Raises:
            ValueError: the file holds no such state, or that of a memory with another threshold.
        """
        settings = AdaptiveThreshold(min(per_hour / 60.0, MOST_A_MINUTE))
        running = settings.start(calibrated)
        if path.exists():
            kept = _read(path)
            if not math.isclose(kept["calibrated"], calibrated, rel_tol=1e-9):
                raise ValueError(
                    f"{path} is of a memory with the threshold {kept['calibrated']:.6g}, "
                    f"and this one has {calibrated:.6g}: give another file"
                )
            running.log = kept["log"]
            running.episodes = int(kept["episodes"])
            running.alarms = int(kept["alarms"])
        return cls(running, calibrated, dt, path)

    @property
    def value(self) -> float:
        """The present threshold."""
        return self._running.value

    def add(self, surprise: float) -> bool:
        """Take up the surprise of a row; return whether a minute ended, after which the threshold moved."""
        self._largest = max(self._largest, surprise)
        self._rows += 1
        if self._rows < self._rows_of_a_minute:
            return False
        self._running.follow(self._largest, confirmed=self._confirmed)
        self._begin_minute()
        return True

    def confirm(self) -> None:
        """Take the alarm of this minute as a true one, by which the threshold does not move."""
        self._confirmed = True

    def relative(self, surprise: Array) -> Floats:
        """Return surprise (T,) as a multiple of the threshold at each row, and move on."""
        relative = np.empty(len(surprise))
        for first in range(0, len(surprise), self._rows_of_a_minute):
            minute = slice(first, first + self._rows_of_a_minute)
            relative[minute] = surprise[minute] / self.value
            if len(surprise[minute]) == self._rows_of_a_minute:
                self._running.follow(float(surprise[minute].max()))
        return relative

    def save(self) -> None:
        """Write the state to its file."""
        running = self._running
        state = {
            "calibrated": self._calibrated,
            "log": running.log,
            "episodes": running.episodes,
            "alarms": running.alarms,
            "settings": asdict(running.settings),
        }
        write_text(self._path, json.dumps(state, indent=2) + "\n")

    def _begin_minute(self) -> None:
        """Forget the minute before."""
        self._rows = 0
        self._largest = 0.0
        self._confirmed = False


def _read(path: Path) -> dict[str, Any]:
    """Return the state in a file. Raises ValueError where it is none."""
    try:
        kept = json.loads(path.read_text(encoding="utf-8"))
        numbers = [float(kept[name]) for name in ("calibrated", "log", "episodes", "alarms")]
    except (ValueError, KeyError, TypeError) as error:
        raise ValueError(f"{path} holds no state of a threshold: {short_repr(error)}") from None
    if not all(map(math.isfinite, numbers)) or min(numbers[2:]) < 0:
        raise ValueError(f"{path} holds no state of a threshold: {numbers}")
    return dict(kept)
