"""Make an arm hold when its guard dies or falls silent, or a process that it depends on dies.

The watchdog is a separate process, which only waits:

    guard ── a beat a row ──► watchdog ── no beat for ``patience``, or a death ──► hold(why)

It ends with the guard, after ``close`` without a hold. If the watchdog itself dies, ``beat``
returns False.
"""

from __future__ import annotations

import multiprocessing
import os
import signal
import time
from collections.abc import Callable, Sequence
from functools import partial
from multiprocessing.connection import wait
from typing import Any, Self

from asm_gym.validation import check_number

PATIENCE_S = 0.2  # without a beat for so long the guard is silent [s]
POLL_S = 0.02  # how often the last beat is looked at [s]
OVER = -1.0  # in place of the time of a beat: the guard has ended as it should

Hold = Callable[[str], object]


class Watchdog:
    """Watch the process that makes it, from a process of its own.

    Args:
        hold: called with the reason, makes the arm hold. The watchdog's process imports it, so it
            must be a function in a module, and open by itself what it needs.
        patience: time without ``beat`` after which the guard counts as silent [s], from the first
            beat on.
        processes: ids of other processes that must live, such as the policy's.

    Raises:
        ProcessLookupError: one of the processes does not exist.
        RuntimeError: the watchdog's process did not start.

    Example:
        >>> watchdog = Watchdog(print, patience=0.25)  # doctest: +SKIP
        >>> guard = LeRobotGuard("so101.asm", watchdog=watchdog)  # doctest: +SKIP
    """

    def __init__(
        self,
        hold: Hold,
        patience: float = PATIENCE_S,
        processes: Sequence[int] = (),
    ) -> None:
        check_number("patience", patience, above=0.0)
        for process in processes:
            os.kill(process, 0)
        context = multiprocessing.get_context("spawn")
        self._beat: Any = context.Value("d", 0.0, lock=False)  # time of the newest beat [s], or 0
        ready = context.Event()
        self.process = context.Process(
            target=_watch,
            args=(hold, patience, processes, self._beat, ready),
            daemon=True,
        )
        self.process.start()
        while not ready.wait(POLL_S):
            if not self.process.is_alive():
                raise RuntimeError(
                    "the watchdog did not start: hold must be a function of an importable module",
                )

    def beat(self) -> bool:
        """Report that a row was judged; return whether the watchdog lives."""
        self._beat.value = time.monotonic()
        return self.process.is_alive()

    def close(self) -> None:
        """End the watch without a hold."""
        self._beat.value = OVER
        self.process.join()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: object, *rest: object) -> None:
        if kind is None:  # after an error nobody guards any more
            self.close()


def _watch(hold: Hold, patience: float, processes: Sequence[int], beat: Any, ready: Any) -> None:
    """Call ``hold`` at each death and each silence, until the guard ends.

    Args:
        hold: makes the arm hold.
        patience: time without a beat that is silence [s].
        processes: ids of processes that must live.
        beat: shared time of the newest beat [s]; 0 before the first, ``OVER`` at the end.
        ready: event to set once deaths are noticed.
    """
    os.setsid()  # what ends the guard's group does not end the watchdog
    signal.signal(signal.SIGTERM, partial(_hold_and_exit, hold))
    guard = multiprocessing.parent_process()
    assert guard is not None
    others: dict[Any, int] = {os.pidfd_open(process): process for process in processes}
    ready.set()

    was_silent = False
    while True:
        ended = wait([guard.sentinel, *others], POLL_S)
        if beat.value == OVER:
            return
        if guard.sentinel in ended:
            hold("the guard's process has died")
            return
        for descriptor in ended:
            hold(f"process {others.pop(descriptor)} has died")
        is_silent = 0.0 < beat.value < time.monotonic() - patience
        if is_silent and not was_silent:
            hold(f"the guard has judged no row for {patience:g} s")
        was_silent = is_silent


def _hold_and_exit(hold: Hold, *_: object) -> None:
    """Hold when the watchdog is told to end, as a guard's interpreter does at its exit."""
    hold("the guard has ended without closing its watchdog")
    os._exit(0)
