"""Checks that a monitor can watch a stream, and tells whether it was fitted since."""

from __future__ import annotations

import logging
from copy import deepcopy
from dataclasses import dataclass
from typing import Any, Self

import numpy as np

from asm_gym.control_period import whole_multiple
from asm_gym.data.episode import CONTROLLER
from asm_gym.exceptions import SpecMismatch
from asm_gym.monitors import CalibratedMonitor, ExplainsItself, Monitor, NeuralASM
from asm_gym.monitors.diagnosis import Diagnosis
from asm_gym.spec import UNNAMED, StreamSpec
from asm_gym.stream_view import StreamView
from asm_gym.validation import check_number, short_repr

LOG = logging.getLogger("asm_gym.safety")

STALE = "monitor: it was fitted while it watched; reset() takes it over"


@dataclass(frozen=True, eq=False, slots=True)
class FittedMonitor:
    """A monitor as it was when it was taken up."""

    monitor: Monitor
    threshold: float
    learned: tuple[Any, Any]
    """What ``fit`` replaces, compared by identity."""

    @classmethod
    def of(cls, monitor: Monitor, spec: StreamSpec) -> Self:
        """Return a monitor that can watch such a stream. Raises what ``check_monitor`` does."""
        return cls(monitor, check_monitor(monitor, spec), _learned(monitor))

    @property
    def stale(self) -> bool:
        """Whether it was fitted since."""
        return not _identical(self.learned, _learned(self.monitor))

    def differs(self, other: FittedMonitor) -> bool:
        """Return whether it is another monitor, or was fitted or calibrated in between."""
        same = self.monitor is other.monitor and _identical(self.learned, other.learned)
        return self.threshold != other.threshold or not same


def _learned(monitor: Monitor) -> tuple[Any, Any]:
    """Return what ``fit`` replaces in a monitor."""
    if isinstance(monitor, NeuralASM):
        return monitor.model.completion_, monitor.model.senses_
    return getattr(monitor, "diagnosis_", None), None


def _identical(one: tuple[Any, Any], other: tuple[Any, Any]) -> bool:
    return one[0] is other[0] and one[1] is other[1]


def check_monitor(monitor: Monitor, watched: StreamSpec, controller: str = "") -> float:
    """Return the monitor's threshold, once it can watch such a stream of a body under a ``controller``.

    Raises:
        TypeError: it is no monitor.
        ValueError: it is for another stream, robot or controller (the message names both), or would never alarm.
        RuntimeError: it is not calibrated.
    """
    if not all(callable(getattr(monitor, name, None)) for name in ("initial_state", "observe")):
        raise TypeError(
            f"monitor must have initial_state() and observe(), got {short_repr(monitor)}"
        )
    _check_stream(monitor.spec, watched)
    _check_same("robot", monitor.spec.source, watched.source)
    _check_same(CONTROLLER, getattr(monitor, "about", {}).get(CONTROLLER, ""), controller)
    return check_number("the monitor's threshold", monitor.threshold)


def _check_stream(learned: StreamSpec, watched: StreamSpec) -> None:
    """Raise SpecMismatch unless a monitor of the stream ``learned`` can read ``watched``."""
    try:
        StreamView(offered=watched, wanted=learned)
    except SpecMismatch as error:
        multiple = whole_multiple(watched.dt, learned.dt)
        if multiple < 2:
            raise
        advice = (
            f"A control step takes {multiple} times as long. If a wrapper inside the guard repeats "
            "actions, put it outside, or fit a monitor on episodes that were recorded through it"
        )
        raise SpecMismatch(error.whose, error.differences, advice) from error


def _check_same(what: str, learned: str, watched: str) -> None:
    """Raise ValueError where a monitor was fitted for something else than it is to watch.

    Only what both name is compared.
    """
    if learned != watched and not {learned, watched} & UNNAMED:
        raise ValueError(
            f"the monitor was fitted for the {what} {learned}, got {watched}: "
            f"give a monitor for {watched}"
        )


def check_answer(monitor: Monitor) -> None:
    """Raise TypeError where a user's monitor answers a row with anything but a state and a surprise."""
    if isinstance(monitor, CalibratedMonitor):
        return
    try:
        tried = deepcopy(monitor)  # one that counts its rows must not count this one
        answer: Any = tried.observe(
            tried.initial_state(1), np.zeros((1, monitor.spec.size), np.float32)
        )
    except Exception as error:  # an alarm at the first row, unless it is mended by then
        LOG.warning("the monitor failed at a row of zeros: %r", error)
        return
    parts = answer if isinstance(answer, tuple) else (answer,)
    if len(parts) != 2 or not hasattr(parts[1], "attribution"):
        kinds = ", ".join(type(part).__name__ for part in parts)
        raise TypeError(f"observe(state, stream) must return (state, Surprise), got ({kinds})")


def diagnosis_of(monitor: Monitor) -> Diagnosis | None:
    """Return what names causes, and not only that something is wrong; None where nothing does."""
    return monitor.diagnosis_ if isinstance(monitor, ExplainsItself) else None
