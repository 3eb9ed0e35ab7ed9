"""Whether a monitor can watch a stream, and what it knows of healthy motion there."""

from __future__ import annotations

import logging
from copy import deepcopy
from typing import Any, NamedTuple, Self

import numpy as np

from asm_gym.monitors import CalibratedMonitor, ExplainsItself, Monitor, NeuralASM
from asm_gym.monitors.diagnosis import Diagnosis
from asm_gym.spec import StreamSpec
from asm_gym.validation import check_number, short_repr

LOG = logging.getLogger("asm_gym.safety")

STALE = "monitor: it was fitted while it watched; reset() takes it over"


class Fitted(NamedTuple):
    """A monitor as it was when it was taken up."""

    monitor: Monitor
    threshold: float
    parts: tuple[Any, ...]  # what ``fit`` replaces, compared by identity

    @classmethod
    def of(cls, monitor: Monitor, spec: StreamSpec) -> Self:
        """Return a monitor that can watch such a stream. Raises what ``check_monitor`` does."""
        return cls(monitor, check_monitor(monitor, spec), _parts(monitor))

    @property
    def stale(self) -> bool:
        """Whether it was fitted since."""
        return any(now is not then for now, then in zip(_parts(self.monitor), self.parts, strict=True))

    def differs(self, other: Fitted) -> bool:
        """Return whether it is another monitor, or was fitted or calibrated in between."""
        same = all(a is b for a, b in zip(self.parts, other.parts, strict=True))
        return not same or self.threshold != other.threshold


def _parts(monitor: Monitor) -> tuple[Any, ...]:
    if isinstance(monitor, NeuralASM):
        return monitor, monitor.model.completion_, monitor.model.senses_  # which ``adapt`` leaves as they are
    return monitor, getattr(monitor, "diagnosis_", None), None


def check_monitor(monitor: Monitor, watched: StreamSpec) -> float:
    """Return the monitor's threshold, once it can watch such a stream.

    Raises:
        ValueError: it is for another stream (the message names what differs), or would never alarm.
        RuntimeError: it is not calibrated.
    """
    if not all(callable(getattr(monitor, name, None)) for name in ("initial_state", "observe")):
        raise TypeError(f"monitor must have initial_state() and observe(), got {short_repr(monitor)}")
    monitor.spec.require(watched, "the monitor")
    return check_number("the monitor's threshold", monitor.threshold)


def check_answer(monitor: Monitor) -> None:
    """Raise TypeError where a user's monitor answers a row with anything but a state and a surprise."""
    if isinstance(monitor, CalibratedMonitor):
        return
    try:
        tried = deepcopy(monitor)  # one that counts its rows must not count this one
        answer: Any = tried.observe(tried.initial_state(1), np.zeros((1, monitor.spec.size), np.float32))
    except Exception as error:  # an alarm at the first row, unless it is mended by then
        LOG.warning("the monitor failed at a row of zeros: %r", error)
        return
    if not (isinstance(answer, tuple) and len(answer) == 2 and hasattr(answer[1], "attribution")):
        parts = [type(part).__name__ for part in answer] if isinstance(answer, tuple) else [type(answer).__name__]
        raise TypeError(f"observe(state, stream) must return (state, Surprise), got ({', '.join(parts)})")


def diagnosis_of(monitor: Monitor) -> Diagnosis | None:
    """Return what names causes, and not only that something is wrong; None where nothing does."""
    return monitor.diagnosis_ if isinstance(monitor, ExplainsItself) else None


class ExchangesMonitor:
    """A guard whose monitor can be exchanged between episodes."""

    _spec: StreamSpec
    _monitor: Monitor
    _next: Monitor
    _taken_up: Fitted

    @property
    def monitor(self) -> Monitor:
        """The monitor in use; one that is assigned, or was fitted or calibrated since, takes over at the next reset."""
        return self._monitor

    @monitor.setter
    def monitor(self, monitor: Monitor) -> None:
        check_monitor(monitor, self._spec)
        self._next = monitor

    def _changed(self) -> bool:
        """Return whether a monitor is to be taken over."""
        changed = Fitted.of(self._next, self._spec).differs(self._taken_up)
        if changed:
            LOG.info("the monitor was changed, fitted or calibrated since: it is taken over as it is now")
        return changed
