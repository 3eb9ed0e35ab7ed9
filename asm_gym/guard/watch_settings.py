"""How a live source is watched."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from asm_gym.data.schema import LogSchema
from asm_gym.detection.following_threshold import FollowingThreshold
from asm_gym.guard.operator_orders import Orders
from asm_gym.guard.step_info import RowReport


@dataclass(frozen=True, kw_only=True)
class WatchSettings:
    """How a live source is watched.

    ``reopen(first_s)`` opens the source anew; its first line may take ``first_s`` [s].
    """

    bridge_s: float = 0.0  # longest time for which numbers may be missing without an alarm [s]
    reopen: Callable[[float], Iterator[str]] | None = None  # opens the source anew
    wait_s: float = 0.0  # for how long a watch tries to open the source anew [s]
    until_alarm: bool = False  # the first alarm ends the watch
    beat: Callable[[], bool] | None = None  # tells a watchdog of a row; whether the watchdog lives
    clock: str = ""  # column of times; by default the first that has a clock's name
    silence_s: float = 2.0  # after which the numbers of one of several publishers are missing [s]
    schema: LogSchema | None = None  # how lines are read; by default that of the memory
    evidence: Path | None = None  # folder for the rows around each incident
    orders: Orders | None = None  # of a person: acknowledge or snooze
    # Channels whose level shifts are learned once they are steady.
    acknowledges: tuple[str, ...] = ()
    keep: Path | None = None  # file for the memory with the level shifts that were learned
    following: FollowingThreshold | None = None  # the threshold that follows
    # Called with time [s], numbers (D,) and report of each row, after its alarm is told.
    show: Callable[[float, NDArray[np.float64], RowReport], None] | None = None


USUAL = WatchSettings()
