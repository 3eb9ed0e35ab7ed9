"""A row in which nothing happens, in one compiled call: nearly all of them are such.

finite → hand against joints → severity → memory, excuses → is there anything to decide?

It is made of the kernels by which ``Guard`` judges a row, which is the oracle of this. Where there is anything to
decide nothing is kept, and ``Guard`` judges the row from where this began.
"""

from __future__ import annotations

import math
import sys
import time
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from asm_gym.addresses import table
from asm_gym.compilation import must_compile
from asm_gym.detection.evidence import Evidence
from asm_gym.detection.evidence_detection import EvidenceState
from asm_gym.detection.repetition import Repetition
from asm_gym.kinematics import HAND
from asm_gym.memory.state import MemoryState
from asm_gym.monitors import Monitor, NeuralASM, Surprise
from asm_gym.monitors.fused import _side_by_side
from asm_gym.monitors.monitor import MonitorState
from asm_gym.wrappers.arbiter import NOTHING, Decision
from asm_gym.wrappers.quiet_kernel import (
    FORCE,
    FOUND,
    IMPULSE,
    KIND,
    LATENCY,
    LEFT,
    LOAD,
    RAW,
    SPEED,
    VALUE,
    quiet,
    state_in,
)
from asm_gym.wrappers.responses import NO_RESPONSE
from asm_gym.wrappers.severity import BLOW, Severity
from asm_gym.wrappers.step_report import RowReport

if TYPE_CHECKING:
    from asm_gym.wrappers.guard import Guard

NOTHING_FELT = np.zeros(0)


class QuietRow:
    """What became of a row in which nothing happened, in the place of a ``RowReport``.

    Args:
        found: (FOUND + D,) left alone from now on.
    """

    __slots__ = ("_found",)
    decision: Decision = NOTHING

    def __init__(self, found: NDArray[np.float64]) -> None:
        self._found = found

    @property
    def value(self) -> float:
        """Its surprise."""
        return float(self._found[VALUE])

    @property
    def latency(self) -> float:
        """Of the call [s]."""
        return float(self._found[LATENCY])

    def whole(self, threshold: float) -> RowReport:
        """All that there is to say of it, at the threshold of its episode."""
        found, each = self._found, self._found[:FOUND].tolist()
        kind = int(each[KIND])
        surprise = Surprise(found[:1], found[None, FOUND:])
        if kind >= 0:
            surprise = surprise._replace(raw=found[RAW : RAW + 1], excuse=np.array([kind], np.int8))
        speed = each[SPEED]
        severity = Severity(each[LOAD], False, each[FORCE], each[IMPULSE], speed, BLOW * speed, False, each[LEFT])
        said = surprise.event(threshold)
        return RowReport(surprise, NOTHING, each[LATENCY], "", NO_RESPONSE, severity, "", said)


class QuietRows:
    """Rows of one stream, for as long as nothing happens.

    Args:
        monitor: what watches, fitted.
        guard: what judges all other rows, of one arm at most.
    """

    def __init__(self, monitor: NeuralASM, guard: Guard) -> None:
        assert monitor.compiled_row is not None
        self._monitor, self._row, self._guard = monitor, monitor.compiled_row, guard
        first = monitor.initial_state(1)
        model, evidence = first.model, first.detection.evidence
        (T, H, K), (_, lag, D) = (a.size for a in (model.traces, model.expected, model.skill)), model.before.shape
        (_, G, X), hand, excuses = evidence.vector.shape, guard.hand, monitor.events
        none: NDArray[Any] = np.zeros(0)
        at, chain, numbers = (none, [none.reshape(0, 3)] * 3 + [none], np.zeros(3)) if hand is None else hand.arrays
        senses, ends = ([none] * 4, none.reshape(0, 2)) if excuses is None else excuses.arrays
        *learned, pi_z, pi_x, curvature, iterations, looks = monitor.compiled_row.learned
        spans = np.array([T, H, K, lag, D, G, X, iterations, looks, hand is not None, excuses is not None])
        joints, on_its_way = (0, 0.0) if excuses is None else (excuses.joints, excuses.on_its_way)
        numbers = np.array([*numbers, monitor.spec.dt, pi_z, pi_x, curvature, on_its_way])
        ints, where = _side_by_side(np.int64, spans, at, *senses, *guard.columns)
        doubles, and_where = _side_by_side(np.float64, *chain, ends, numbers)
        self._fixed = ints, doubles, np.array([*where, *and_where]), *learned
        # Of each kind of number the state now and the next one, in turns.
        sizes = T + H + K, 2 * lag * D + G * X + H + 2 * X + HAND + 2, 5 + joints, X
        kinds = np.float32, np.float64, np.int64, np.bool_
        self._state = tuple(np.zeros((2, n), kind) for n, kind in zip(sizes, kinds, strict=True))
        self._table = table((*self._state, *self._fixed))
        self._shape, self._size = (D,), FOUND + D
        self._felt = max((1 + int(c.max()) for c in guard.substeps.columns if c.size), default=0)
        self._now, self._runs, self._patience = 0, False, (0.0, 0.0)
        if must_compile(quiet):
            print("asm-gym: compiling the guard, once on this machine (about a minute)", file=sys.stderr)
        self.judge(np.full(D, np.nan, np.float32), None, 0.0)

    @classmethod
    def of(cls, monitor: Monitor, guard: Guard) -> QuietRows | None:
        """Those of a monitor and a guard; None where there are none for them."""
        if type(monitor) is not NeuralASM or monitor.compiled_row is None or not guard.can_be_quiet:
            return None
        return None if monitor.values_.monitor is not None or monitor.skill_ is not None else cls(monitor, guard)

    @property
    def stale(self) -> bool:
        """Whether the monitor was fitted since."""
        return self._monitor.compiled_row is not self._row

    def begin(self) -> None:
        """A new episode has begun: whatever ran is over."""
        self._runs = False

    def judge(self, row: NDArray[np.float32], info: dict[str, Any] | None, threshold: float) -> QuietRow | None:
        """What became of the next row (D,); None where something may have happened, and nothing was kept.

        Args:
            info: what the environment said of the control step that the row ends; None where it ends none.
            threshold: what surprise must exceed for an alarm.
        """
        found, load, left, felt = np.empty(self._size), math.nan, math.nan, NOTHING_FELT
        if info is not None:
            load, left = float(info.get("contact_load", math.nan)), float(info.get("contact_left_s", math.nan))
            felt = np.array(info.get("contact_felt", NOTHING_FELT), np.float64).ravel()
        if row.dtype != np.float32 or row.shape != self._shape or 0 < len(felt) < self._felt:
            return None  # compiled code would read beyond its end
        start = time.perf_counter()
        passes = quiet(row, felt, found, threshold, load, left, *self._patience, self._now, self._table)
        found[LATENCY] = time.perf_counter() - start
        return QuietRow(found) if passes else None

    def keep(self) -> None:
        """The row that was judged last was quiet, and has been."""
        self._now = 1 - self._now

    def take(self, state: MonitorState) -> None:
        """Takes up what all other rows have come to; nothing where it has."""
        if self._runs:
            return
        self._runs, self._patience = True, self._guard.patience
        model, (evidence, repetition) = state.model, state.detection
        guard = () if self._guard.hand is None else (self._guard.hand.mean,)
        parts: list[list[Any]] = [
            [model.traces, model.expected, model.skill],
            [model.before, model.earlier, evidence.vector, evidence.context, repetition.row, repetition.unlikely],
            [model.steps, evidence.steps, state.knock],
            [repetition.again],
        ]
        for array, each in zip(self._state, parts, strict=True):
            flat = np.concatenate([np.ravel(part) for part in each])
            array[self._now, : len(flat)] = flat
        severity = self._guard.severity
        self._state[1][self._now, -HAND - 2 :] = np.concatenate([*(guard or (np.zeros(HAND),)), severity.pressed])

    def hand_back(self) -> MonitorState | None:
        """What the rows so far have come to; the guard is told. None where nothing ran."""
        if not self._runs:
            return None
        self._runs = False
        singles, doubles, whole, flags = (array[self._now].copy() for array in self._state)
        old = state_in(singles, doubles, whole, flags, self._fixed[0])
        state = MemoryState(*old[:6]), EvidenceState(Evidence(*old[6:9]), Repetition(*old[9:12]))
        self._guard.passed(doubles[-HAND - 2 : -2], *doubles[-2:].tolist())
        return MonitorState(*state, knock=old[12] if self._monitor.events is not None else ())
