"""Asks a monitor for the surprise of rows; whatever goes wrong with that is infinite surprise."""

from __future__ import annotations

import time
from collections.abc import Mapping
from contextlib import suppress
from typing import Any, NamedTuple

import numpy as np

from asm_gym.compilation import Bound
from asm_gym.guard.robot_table import Floats32, Mask
from asm_gym.monitors import ExpectsActions, ForgetsEvidence, Monitor, NeuralASM, Surprise
from asm_gym.monitors.row_kernel import RowKernel, unwritten


class _CompiledStep(NamedTuple):
    """A compiled row from one state of the monitor to the next."""

    kernel: RowKernel
    state: Any
    next_state: Any  # written
    bound: Bound


class Observer:
    """Watches n streams with one monitor, and keeps its state.

    Args:
        monitor: fitted and calibrated.
        count: n.
        recalls: the monitor is asked what it expects to be commanded.

    Attributes:
        latency: how long the monitor took for the last rows [s].
        expected: (n, A) what is likely to be commanded next; None where nobody asks.

    Raises:
        ValueError: ``recalls`` with a monitor that expects no action.
    """

    def __init__(self, monitor: Monitor, count: int, recalls: bool) -> None:
        self._monitor = monitor
        self._count = count
        self._size = monitor.spec.size
        # Asked once: isinstance on a protocol takes longer than most of what follows.
        self._forgets = monitor if isinstance(monitor, ForgetsEvidence) else None
        self._neural = monitor if isinstance(monitor, NeuralASM) else None
        self._expects: ExpectsActions | None = None
        if recalls:
            if not isinstance(monitor, ExpectsActions) or not monitor.spec.motor.size:
                kind = type(monitor).__name__
                raise ValueError(
                    f"recall needs a memory that predicts actions, and {kind} does not"
                )
            self._expects = monitor
        self._steps: list[_CompiledStep] = []  # the last two, which take turns
        self.latency = 0.0
        self.expected: Floats32 | None = None
        self.begin(np.ones(count, bool))
        if self._neural is not None:
            # What a row needs is loaded now, and not within the first step.
            zeros = np.zeros((count, self._size), np.float32)
            self._neural.observe(self._initial, zeros)

    def begin(self, which: Mask) -> None:
        """Begin new episodes in the streams of ``which`` (n,)."""
        if which.all():
            self._initial = self._monitor.initial_state(batch=self._count)
            self._state = self._initial
            self._state_before = self._initial
        elif which.any():
            self._state = choose(which, self._initial, self._state)

    # ------------------------------------------------------------------ a row in compiled code

    def compiled_step(self) -> Bound | None:
        """Return what ``observe_rows`` needs for the next rows; None where Python takes part in them."""
        if self._neural is None or self._expects is not None:
            return None
        kernel = self._neural.compiled_row()
        if kernel is None:
            return None
        spare = self._spare()
        for step in self._steps:
            is_same = step.kernel is kernel and step.state is self._state
            if is_same and step.next_state is spare:
                return step.bound
        if spare is None:
            spare = unwritten(self._state)
        bound = kernel.bound(self._state, spare)
        step = _CompiledStep(kernel, self._state, spare, bound)
        self._steps = [*self._steps[-1:], step]
        return bound

    def stepped(self, bound: Bound, seconds: float) -> None:
        """Take up the state that compiled code has written, in so many seconds."""
        step = next(step for step in self._steps if step.bound is bound)
        self._state_before = self._state
        self._state = step.next_state
        self.latency = seconds

    def _spare(self) -> Any:
        """Return the state before the present one, which may be written to; None where it is still needed."""
        if self._state_before is self._initial or self._state_before is self._state:
            return None
        return self._state_before

    # ------------------------------------------------------------------ a row of any monitor

    def observe(self, rows: Floats32, judged: Any, attribution: Any) -> dict[int, str]:
        """Write what the monitor makes of rows (n, D), perhaps not finite.

        Args:
            judged: (n,) records of ``JUDGED``, written.
            attribution: (n, D), written.

        Returns:
            What failed, by robot.
        """
        start = time.perf_counter()
        spare = self._spare()
        self._state_before = self._state
        try:
            if self._neural is None:
                state, surprise = self._monitor.observe(self._state_before, rows)
            else:
                state, surprise = self._neural.observe(self._state_before, rows, spare)
            self._write(surprise, judged, attribution)
            if self._expects is not None:
                self.expected = self._expected_actions(self._expects, state)
        except Exception as error:  # nothing has judged these rows
            judged["surprise"] = np.inf
            attribution[:] = 0.0
            return dict.fromkeys(range(self._count), f"monitor: {error!r}")
        self._state = state
        self.latency = time.perf_counter() - start
        return invalid_surprises(judged)

    def amend(self, rows: Floats32) -> None:
        """Observe other rows (n, D) in the place of the last ones: something else was commanded than it seemed."""
        with suppress(Exception):  # the state stays as it is: the next row is judged from there
            self._state, _ = self._monitor.observe(self._state_before, rows)

    def forget(self, acted_on: Mask) -> str:
        """Let the evidence begin anew in the streams of ``acted_on`` (n,); return what failed."""
        if self._forgets is None:
            return ""
        try:
            state = self._forgets.reset_evidence(self._state)
            if not acted_on.all():
                state = choose(acted_on, state, self._state)
            self._state = state
        except Exception as error:
            return f"monitor: {error!r}"
        return ""

    def _expected_actions(self, monitor: ExpectsActions, state: Any) -> Floats32:
        expected = np.asarray(monitor.expected_action(state), np.float32)
        if expected.shape != (self._count, self._monitor.spec.motor.size):
            raise ValueError(f"expected_action has the shape {expected.shape}")
        return expected

    def _write(self, surprise: Surprise, judged: Any, attribution: Any) -> None:
        """Write a surprise, whose arrays may be buffers that the monitor uses again."""
        values = np.asarray(surprise.value, np.float64)
        shares = np.asarray(surprise.attribution, np.float64)
        if values.shape != judged.shape or shares.shape != attribution.shape:
            raise ValueError(
                f"a surprise must have values of shape {judged.shape} and attributions of shape "
                f"{attribution.shape}, got {values.shape} and {shares.shape}"
            )
        judged["surprise"] = values
        judged["raw_surprise"] = values
        judged["excuse"] = 0
        if surprise.raw is not None and surprise.excuse is not None:
            judged["raw_surprise"] = surprise.raw
            judged["excuse"] = surprise.excuse
        attribution[:] = shares


def invalid_surprises(judged: Any) -> dict[int, str]:
    """Return what failed by robot, where a surprise is no number that a threshold can be compared with."""
    values = judged["surprise"]
    wrong = np.flatnonzero(~(values > -np.inf))  # NaN too
    return {robot: f"monitor: its surprise is {values[robot]}" for robot in wrong.tolist()}


def joined(*failures: str) -> str:
    """Return several failures in one line, each once; empty where there is none."""
    return "; ".join(dict.fromkeys(filter(None, failures)))


def merged_failures(*reports: Mapping[int, str]) -> dict[int, str]:
    """Return what failed by robot, from several reports of that."""
    failures: dict[int, str] = {}
    for report in reports:
        for robot, failure in report.items():
            failures[robot] = joined(failures.get(robot, ""), failure)
    return failures


def choose(mask: Mask, new: Any, old: Any) -> Any:
    """Return a monitor's state with ``new`` where ``mask`` (n,) holds, ``old`` elsewhere.

    Args:
        new, old: arrays whose first axis is n, or named tuples of such, nested or not.
    """
    if isinstance(old, tuple):
        parts = [choose(mask, *pair) for pair in zip(new, old, strict=True)]
        return getattr(old, "_make", tuple)(parts)
    if not isinstance(old, np.ndarray) or len(old) != len(mask):
        raise TypeError(
            f"a monitor's state must be arrays whose first axis is {len(mask)} long, got {old!r}"
        )
    along_the_first_axis = mask.reshape(-1, *[1] * (old.ndim - 1))
    return np.where(along_the_first_axis, new, old)
