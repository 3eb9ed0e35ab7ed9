"""Asks a monitor for the surprise of rows; whatever goes wrong with that is infinite surprise.

Before, it is checked that the monitor can watch such rows.
"""

from __future__ import annotations

import logging
import math
import time
from collections.abc import Mapping
from contextlib import suppress
from copy import deepcopy
from typing import Any, NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from asm_gym.data.episode import CONTROLLER
from asm_gym.guard.rows import Rows
from asm_gym.monitors import (
    CalibratedMonitor,
    ExpectsActions,
    ExplainsItself,
    ForgetsEvidence,
    Monitor,
    NeuralASM,
    Surprise,
)
from asm_gym.monitors.diagnosis import Diagnosis
from asm_gym.spec import StreamSpec
from asm_gym.validation import check_number, short_repr

LOG = logging.getLogger("asm_gym.safety")

UNNAMED = {"", "spaces", "table"}  # sources of streams that do not say whose they are

STALE = "monitor: it was fitted while it watched; reset() takes it over"

Mask = NDArray[np.bool_]


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
        return monitor, monitor.model.completion_, monitor.model.senses_
    return monitor, getattr(monitor, "diagnosis_", None), None


def check_monitor(monitor: Monitor, watched: StreamSpec, controller: str = "") -> float:
    """Return the monitor's threshold, once it can watch such a stream of a body under a ``controller``.

    Raises:
        ValueError: it is for another stream, robot or controller (the message names both), or would never alarm.
        RuntimeError: it is not calibrated.
    """
    if not all(callable(getattr(monitor, name, None)) for name in ("initial_state", "observe")):
        raise TypeError(f"monitor must have initial_state() and observe(), got {short_repr(monitor)}")
    monitor.spec.require(watched, "the monitor")
    learned = getattr(monitor, "about", {}).get(CONTROLLER, "")
    for what, mine, theirs in ("robot", monitor.spec.source, watched.source), (CONTROLLER, learned, controller):
        if mine != theirs and not {mine, theirs} & UNNAMED:
            raise ValueError(f"the monitor was fitted for the {what} {mine}, got {theirs}: give a monitor for {theirs}")
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


class Observation(NamedTuple):
    """What a monitor made of n rows."""

    surprise: Surprise  # infinite, and attributed to nothing, where there is a failure
    expected: NDArray[np.float32] | None  # (n, A) what is likely to be commanded next; None where nobody asks
    failures: Mapping[int, str]  # what failed, by robot


class Observer:
    """Watches n streams with one monitor, and keeps its state.

    Args:
        monitor: fitted and calibrated.
        count: n.
        rows: they know which surprise counts.
        recalls: the monitor is asked what it expects to be commanded.
    """

    def __init__(self, monitor: Monitor, count: int, rows: Rows, recalls: bool) -> None:
        self._monitor, self._count, self._size, self._rows = monitor, count, monitor.spec.size, rows
        self._ours = monitor if isinstance(monitor, NeuralASM) else None
        # Asked once: isinstance on a protocol takes longer than most of what follows.
        self._forgets = monitor if isinstance(monitor, ForgetsEvidence) else None
        self._recalls = monitor if isinstance(monitor, ExpectsActions) and recalls else None
        self.latency = 0.0  # of the monitor at the last rows [s]
        self.begin(np.ones(count, bool))
        if self._ours is not None:  # what a row needs is loaded now, and not within the first step
            self._ours.observe(self._initial, np.zeros((count, self._size), np.float32))

    def begin(self, which: Mask) -> None:
        """New episodes in the streams of ``which`` (n,)."""
        if which.all():
            self._state = self._before = self._initial = self._monitor.initial_state(batch=self._count)
        elif which.any():
            self._state = choose(which, self._initial, self._state)

    def observe(self, rows: NDArray[np.float32], failures: Mapping[int, str], active: Mask) -> Observation:
        """Return what counts of the surprise at the next rows.

        Args:
            rows: (n, D) as they are believed, perhaps not finite.
            failures: that are known already, by robot.
            active: (n,) whose rows count.
        """
        free, self._before = self._before, self._state
        start, expected = time.perf_counter(), None
        try:
            if self._ours is None:
                state, surprise = self._monitor.observe(self._before, rows)
                surprise = self._copied(surprise)  # its arrays may be buffers that it uses again
            else:
                reused = None if free is self._initial or free is self._before else free
                state, surprise = self._ours.observe(self._before, rows, reused)
            self.latency = time.perf_counter() - start
            if self._recalls is not None:
                expected = self._expected(self._recalls, state)
            self._state = state
        except Exception as error:  # nothing has judged these rows
            surprise = Surprise(np.full(self._count, np.inf), np.zeros((self._count, self._size)))
            failures = {i: joined(failures.get(i, ""), f"monitor: {error!r}") for i in range(self._count)}
        for i, value in enumerate(surprise.value.tolist()):
            if not value > -math.inf:  # NaN too
                failures = {**failures, i: joined(failures.get(i, ""), f"monitor: its surprise is {value}")}
        everyone = all(active.tolist())
        if everyone and not (failures or self._rows.repairs):
            return Observation(surprise, expected, failures)
        surprise = self._rows.counted(_infinite(surprise, failures), failures)
        surprise = surprise if everyone else surprise.silenced(~active)
        return Observation(surprise, expected, failures)

    def amend(self, rows: NDArray[np.float32]) -> None:
        """Observe other rows (n, D) in the place of the last ones: something else was commanded than it seemed."""
        with suppress(Exception):  # the state stays as it is: the next row is judged from there
            self._state, _ = self._monitor.observe(self._before, rows)

    def forget(self, acted_on: Mask) -> str:
        """Let the evidence begin anew in the streams of ``acted_on`` (n,); return what failed."""
        if self._forgets is None:
            return ""
        try:
            state = self._forgets.reset_evidence(self._state)
            self._state = state if acted_on.all() else choose(acted_on, state, self._state)
        except Exception as error:
            return f"monitor: {error!r}"
        return ""

    def _copied(self, surprise: Surprise) -> Surprise:
        """Return what another monitor than ours says in arrays of its own."""
        value, attribution = np.array(surprise.value, np.float64), np.array(surprise.attribution, np.float64)
        shapes = (self._count,), (self._count, self._size)
        if (value.shape, attribution.shape) != shapes:
            raise ValueError(
                f"a surprise must have values of shape {shapes[0]} and attributions of shape {shapes[1]}, "
                f"got {value.shape} and {attribution.shape}"
            )
        return surprise._replace(value=value, attribution=attribution)

    def _expected(self, monitor: ExpectsActions, state: Any) -> NDArray[np.float32]:
        expected = np.asarray(monitor.expected_action(state), np.float32)
        if expected.shape != (self._count, self._monitor.spec.motor.size):
            raise ValueError(f"expected_action has the shape {expected.shape}")
        return expected


def joined(*failures: str) -> str:
    """Return several failures in one line, each once; empty where there is none."""
    return "; ".join(dict.fromkeys(filter(None, failures)))


def choose(mask: Mask, new: Any, old: Any) -> Any:
    """Return a monitor's state with ``new`` where ``mask`` (n,) holds, ``old`` elsewhere.

    Args:
        new, old: arrays whose first axis is n, or named tuples of such, nested or not.
    """
    if isinstance(old, tuple):
        parts = [choose(mask, n, o) for n, o in zip(new, old, strict=True)]
        return getattr(old, "_make", tuple)(parts)
    if not isinstance(old, np.ndarray) or len(old) != len(mask):
        raise TypeError(f"a monitor's state must be arrays whose first axis is {len(mask)} long, got {old!r}")
    return np.where(mask.reshape(-1, *[1] * (old.ndim - 1)), new, old)


def _infinite(surprise: Surprise, failures: Mapping[int, str]) -> Surprise:
    """Return it infinite, and attributed to nothing, where there are failures."""
    if not failures:
        return surprise
    value, attribution = surprise.value.copy(), surprise.attribution.copy()
    for robot in failures:
        value[robot], attribution[robot] = np.inf, 0.0
    return surprise._replace(value=value, attribution=attribution)
