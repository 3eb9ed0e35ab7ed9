"""Asks a monitor for the surprise of rows; whatever goes wrong with that is infinite surprise."""

from __future__ import annotations

import math
import time
from collections.abc import Iterable, Mapping
from typing import Any, NamedTuple, Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from asm_gym.monitors import ExpectsActions, ForgetsEvidence, LearnsOnTheJob, Monitor, NeuralASM, Surprise

Mask = NDArray[np.bool_]


class Observation(NamedTuple):
    """What a monitor made of n rows.

    Attributes:
        surprise: infinite, and attributed to nothing, where there is a failure.
        expected: (n, A) what is likely to be commanded next; None where nobody asks.
        failures: what failed, by robot.
        latency: of the monitor [s].
    """

    surprise: Surprise
    expected: NDArray[np.float32] | None
    failures: Mapping[int, str]
    latency: float


@runtime_checkable
class NamedTupleLike(Protocol):
    """A named tuple."""

    def _make(self, parts: Iterable[Any]) -> Any: ...


class Observer:
    """Watches n streams with one monitor, and keeps its state.

    Args:
        monitor: fitted and calibrated.
        count: n.
        recalls: the monitor is asked what it expects to be commanded.
    """

    def __init__(self, monitor: Monitor, count: int, recalls: bool = False) -> None:
        self._monitor, self._count, self._size = monitor, count, monitor.spec.size
        self._copies = not isinstance(monitor, NeuralASM)  # another's arrays may be buffers that it uses again
        # Asked once: isinstance on a protocol takes longer than most of what follows.
        self._forgets = monitor if isinstance(monitor, ForgetsEvidence) else None
        self._learns = monitor if isinstance(monitor, LearnsOnTheJob) else None
        self._recalls = monitor if recalls and isinstance(monitor, ExpectsActions) else None
        self.begin(np.ones(count, bool))

    def begin(self, which: Mask) -> None:
        """New episodes in the streams of ``which`` (n,)."""
        if which.all():
            self._state = self._before = self._initial = self._monitor.initial_state(batch=self._count)
        elif which.any():
            self._state = choose(which, self._initial, self._state)

    def observe(self, rows: NDArray[np.float32], failures: Mapping[int, str]) -> Observation:
        """Judge the next rows (n, D), some of which may be no more than NaN by the failures that are known already."""
        self._before, start, latency = self._state, time.perf_counter(), 0.0
        try:
            state, surprise = self._monitor.observe(self._before, rows)
            latency = time.perf_counter() - start
            surprise = self._checked(surprise)
            expected = None if self._recalls is None else self._expected(self._recalls, state)
            self._state = state
        except Exception as error:  # nothing has judged these rows
            surprise = Surprise(np.zeros(self._count), np.zeros((self._count, self._size)))
            everywhere = dict.fromkeys(range(self._count), f"monitor: {error!r}")
            failures = {i: joined(failures.get(i, ""), said) for i, said in everywhere.items()}
            return Observation(_infinite(surprise, failures), None, failures, latency)
        for i, value in enumerate(surprise.value.tolist()):
            if not value > -math.inf:  # NaN too
                failures = {**failures, i: joined(failures.get(i, ""), f"monitor: its surprise is {value}")}
        return Observation(_infinite(surprise, failures) if failures else surprise, expected, failures, latency)

    def amend(self, rows: NDArray[np.float32]) -> None:
        """Observe other rows (n, D) in the place of the last ones: something else was commanded than it seemed."""
        try:
            self._state, _ = self._monitor.observe(self._before, rows)
        except Exception:  # the state stays as it is: the next row is judged from there
            return

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

    def learn(self, rows: NDArray[np.float32], surprise: Surprise, rate: float) -> str:
        """Let the monitor learn from the rows that were observed last; return what failed."""
        try:
            if self._learns is not None:
                self._learns.adapt(self._before, rows, surprise, rate)
        except Exception as error:
            return f"monitor: {error!r}"
        return ""

    def _checked(self, surprise: Surprise) -> Surprise:
        shapes = (self._count,), (self._count, self._size)
        value, attribution = surprise.value, surprise.attribution
        if self._copies:
            value, attribution = np.array(value, np.float64), np.array(attribution, np.float64)
        if (value.shape, attribution.shape) != shapes:
            raise ValueError(
                f"a surprise must have values of shape {shapes[0]} and attributions of shape {shapes[1]}, "
                f"got {value.shape} and {attribution.shape}"
            )
        return surprise._replace(value=value, attribution=attribution) if self._copies else surprise

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
        return old._make(parts) if isinstance(old, NamedTupleLike) else tuple(parts)
    if not isinstance(old, np.ndarray) or len(old) != len(mask):
        raise TypeError(f"a monitor's state must be arrays whose first axis is {len(mask)} long, got {old!r}")
    return np.where(mask.reshape(-1, *[1] * (old.ndim - 1)), new, old)


def _infinite(surprise: Surprise, failures: Mapping[int, str]) -> Surprise:
    """Return it infinite, and attributed to nothing, where there are failures."""
    value, attribution = surprise.value.copy(), surprise.attribution.copy()
    for robot in failures:
        value[robot], attribution[robot] = np.inf, 0.0
    return surprise._replace(value=value, attribution=attribution)
