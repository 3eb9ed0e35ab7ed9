"""Asks a monitor what it makes of the rows, and takes whatever goes wrong with that for infinite surprise."""

from __future__ import annotations

import time
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from asm_gym.monitors import ExpectsActions, ForgetsEvidence, LearnsOnTheJob, Monitor, NeuralASM, Surprise
from asm_gym.monitors.monitor import CalibratedMonitor
from asm_gym.wrappers.vector_utils import Mask, choose


class Observation(NamedTuple):
    """What a monitor made of n rows.

    Attributes:
        surprise: infinite, and attributed to nothing, where there is a failure.
        expected: (n, A) what is likely to be commanded next; None where nobody asks.
        failures: n, what failed; empty where nothing did.
        latency: [s].
    """

    surprise: Surprise
    expected: NDArray[np.float32] | None
    failures: tuple[str, ...]
    latency: float


class Observer:
    """Watches n streams with one monitor, and keeps its state.

    Args:
        monitor: fitted and calibrated.
        batch: n.
        recalls: the monitor is asked what it expects to be commanded.
    """

    def __init__(self, monitor: Monitor, batch: int = 1, recalls: bool = False) -> None:
        self._monitor, self._batch = monitor, batch
        self._own = type(monitor) in (CalibratedMonitor, NeuralASM)
        # Asked once: whether an object has what a protocol asks for takes longer than most of what follows.
        self._forgets = monitor if isinstance(monitor, ForgetsEvidence) else None
        self._learns = monitor if isinstance(monitor, LearnsOnTheJob) else None
        self._recalls = monitor if recalls and isinstance(monitor, ExpectsActions) else None

    def begin(self) -> None:
        """New episodes in all streams."""
        self._state = self._before = self._initial = self._monitor.initial_state(batch=self._batch)

    @property
    def state(self) -> Any:
        """The monitor's, after the last rows."""
        return self._state

    @state.setter
    def state(self, state: Any) -> None:
        self._state = state

    def begin_in(self, begun: Mask) -> None:
        """New episodes in the streams of ``begun`` (n,)."""
        if begun.any():
            self._state = self._initial if begun.all() else choose(begun, self._initial, self._state)

    def observe(self, rows: NDArray[np.float32], failures: tuple[str, ...]) -> Observation:
        """Judges the next rows (n, D), some of which may be no more than NaN by the failures that are known already."""
        self._before, start, latency = self._state, time.perf_counter(), 0.0
        try:
            state, surprise = self._monitor.observe(self._before, rows)
            latency = time.perf_counter() - start
            surprise = self._checked(surprise)
            expected = self._expected(state)
            self._state = state
        except Exception as error:
            # Nobody has looked at these rows.
            none = Surprise(np.zeros(self._batch), np.zeros((self._batch, self._monitor.spec.size)))
            failures = tuple(joined(f, f"monitor: {error!r}") for f in failures)
            return Observation(_infinite(none, failures), None, failures, latency)
        if not surprise.value.min() > -np.inf:  # NaN too
            lost = ~(surprise.value > -np.inf)
            failures = tuple(
                joined(f, f"monitor: its surprise is {v}") if no else f
                for f, v, no in zip(failures, surprise.value, lost, strict=True)
            )
        return Observation(_infinite(surprise, failures), expected, failures, latency)

    def forget(self, acted_on: Mask) -> str:
        """Lets the evidence begin anew in the streams of ``acted_on`` (n,); what failed at that."""
        if self._forgets is None or not acted_on.any():
            return ""
        try:
            state = self._forgets.reset_evidence(self._state)
            self._state = state if acted_on.all() else choose(acted_on, state, self._state)
        except Exception as error:
            return f"monitor: {error!r}"
        return ""

    def learn(self, rows: NDArray[np.float32], surprise: Surprise, rate: float) -> str:
        """Lets the monitor learn from the rows that were observed last; what failed at that."""
        try:
            if self._learns is not None:
                self._learns.adapt(self._before, rows, surprise, rate)
        except Exception as error:
            return f"monitor: {error!r}"
        return ""

    def _checked(self, surprise: Surprise) -> Surprise:
        shapes = (self._batch,), (self._batch, self._monitor.spec.size)
        value, attribution = surprise.value, surprise.attribution
        if not self._own:  # another's may be buffers that it uses again
            value, attribution = np.array(value, np.float64), np.array(attribution, np.float64)
        if (value.shape, attribution.shape) != shapes:
            raise ValueError(
                f"a surprise must have values of shape {shapes[0]} and attributions of shape {shapes[1]}, "
                f"got {value.shape} and {attribution.shape}"
            )
        return surprise if self._own else surprise._replace(value=value, attribution=attribution)

    def _expected(self, state: Any) -> NDArray[np.float32] | None:
        if self._recalls is None:
            return None
        expected = np.asarray(self._recalls.expected_action(state), np.float32)
        if expected.shape != (self._batch, self._monitor.spec.motor.size):
            raise ValueError(f"expected_action has the shape {expected.shape}")
        return expected


def joined(*failures: str) -> str:
    """Several failures in one line, each once; empty where there is none."""
    return "; ".join(dict.fromkeys(filter(None, failures)))


def _infinite(surprise: Surprise, failures: tuple[str, ...]) -> Surprise:
    """Infinite, and attributed to nothing, where there are failures."""
    if not any(failures):
        return surprise
    failed = np.array([bool(f) for f in failures])
    value = np.where(failed, np.inf, surprise.value)
    return surprise._replace(value=value, attribution=np.where(failed[:, None], 0.0, surprise.attribution))
