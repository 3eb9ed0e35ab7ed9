"""One row of each stream in one compiled call: the errors of a memory, their evidence, and what excuses it.

    read → carry on, associate → errors → whiten, accumulate → repetitions → attribute → excuse

``expect_rows`` is the first half, which a memory's model uses by itself; ``observe_rows`` is all of it.
"""

from __future__ import annotations

import sys
from functools import partial
from threading import Lock
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from threadpoolctl import ThreadpoolController

from asm_gym.compilation import compiled, must_compile
from asm_gym.detection.detector import _step
from asm_gym.detection.events import Excuses
from asm_gym.detection.events import _step as _excuse
from asm_gym.detection.evidence import POWER, TINY
from asm_gym.detection.evidence_detection import EvidenceDetection, EvidenceState
from asm_gym.detection.repetition import repeated
from asm_gym.detection.tails import TAIL_INDEX
from asm_gym.memory.association import Association, normalised_errors
from asm_gym.memory.energy import activate, outward
from asm_gym.memory.inference import Weights, carry, infer, weight_shapes
from asm_gym.memory.readout import add_up
from asm_gym.memory.settling import SettlingWeights, settling_shapes
from asm_gym.memory.state import UNSURE, MemoryState, RowHistory
from asm_gym.memory.temporal import TemporalNetwork
from asm_gym.monitors.base import Surprise
from asm_gym.monitors.calibrated_monitor import MonitorState
from asm_gym.scaling import StreamScaler, _read


class LearnedMemory(NamedTuple):
    """What ``expect_rows`` computes with; of ``traces`` and ``settling`` one is not used."""

    mean: NDArray[np.float64]  # (D,)
    spread: NDArray[np.float64]  # (D,)
    change: NDArray[np.float64]  # (D,)
    sensory: NDArray[np.intp]
    motor: NDArray[np.intp]
    slow: NDArray[np.intp]
    traces: Weights
    settling: SettlingWeights
    settles: bool
    prior_precision: np.float32
    sensory_precision: np.float32
    curvature: np.float32
    iterations: int
    association: Association
    spans: NDArray[np.intp]  # (X, 2)
    W_K: NDArray[np.float32]  # (K, M + H) of names of skills
    b_K: NDArray[np.float32]  # noqa: N815 (K,)
    context: bool  # whether f(μ) is wanted

    @classmethod
    def of(cls, network: TemporalNetwork, scaler: StreamScaler, names: tuple[NDArray[Any], NDArray[Any]]) -> Any:
        """Return what a network computes with; ``names`` are W_K and b_K, of no rows where no skill has a name."""
        spec, settles = scaler.spec, isinstance(network.weights, SettlingWeights)
        unused: Any = weight_shapes(1, 1, 1) if settles else settling_shapes(1, 1, 1)
        other = (Weights if settles else SettlingWeights)(**{n: np.zeros(s, np.float32) for n, s in unused.items()})
        weights = (other, network.weights) if settles else (network.weights, other)
        scale = [np.ascontiguousarray(a, np.float64) for a in (scaler.mean, scaler.spread, scaler.change)]
        named = [np.ascontiguousarray(a, np.float32) for a in names]
        inference = weights[0], weights[1], settles, *network.inference
        columns = spec.sensory, spec.motor, scaler.slow
        return cls._make([*scale, *columns, *inference, network.association, network.spans, *named, True])


class LearnedEvidence(NamedTuple):
    """What of a fitted ``EvidenceDetection`` its errors are judged by."""

    whitening: NDArray[np.float64]  # (X, X)
    ceiling: NDArray[np.float64]  # (G, X)
    tail: NDArray[np.float64]  # (G, X)
    context_quantile: NDArray[np.float64]  # (2 H + 1,)
    context_range: NDArray[np.float64]  # (2,)
    gains: NDArray[np.float64]  # (G,)
    bound: float
    repetition_steps: NDArray[np.float64]  # (2, 2, X)
    repetition_most: NDArray[np.float64]  # (X,)
    repetition_offset: NDArray[np.float64]  # (X,)


class LearnedExcuses(NamedTuple):
    """What knocks and stops are told by, of ``Excuses``; without any, nothing is excused."""

    active: bool
    wrist: NDArray[np.intp]
    joints: NDArray[np.intp]
    fingers: NDArray[np.intp]
    rows: NDArray[np.int64]
    ends: NDArray[np.float64]  # (J, 2)
    on_its_way: float


class RowState(NamedTuple):
    """What one row hands to the next."""

    memory: MemoryState
    detection: EvidenceState
    excuses: NDArray[np.int64]  # (B, 3 + J); (B, 0) where nothing is excused


class RowSurprise(NamedTuple):
    """The surprise of a row, with and without what is excused."""

    value: NDArray[np.float64]  # (B,)
    attribution: NDArray[np.float64]  # (B, D)
    raw: NDArray[np.float64]  # (B,)
    excuse: NDArray[np.int8]  # (B,)
    divisor: NDArray[np.float64]  # (B,) of what is excused


class RowKernel:
    """``observe`` of a memory under the detection of evidence, for the weights as they are.

    Args:
        memory: what its model computes with.
        detection: fitted.
        excuses: of knocks and stops; None where nothing is excused.
    """

    def __init__(self, memory: LearnedMemory, detection: EvidenceDetection, excuses: Excuses | None) -> None:
        d = detection.detector_
        assert d is not None
        if must_compile(observe_rows):
            print("asm-gym: compiling the memory, once on this machine (about a minute)", file=sys.stderr)
        steps, most, offset = detection.repeating
        arrays = d.whitening, d.ceiling, d.tail, d.context_quantile, d.context_range, d.gains
        whole = map(np.ascontiguousarray, arrays)
        evidence = LearnedEvidence._make([*whole, float(d.bound), steps, most, offset])
        looks = bool(d.context_quantile[:-1].any())
        self._excuses = excuses
        self._learned = memory._replace(context=looks), evidence, _learned_excuses(excuses)

    def __call__(
        self, state: MonitorState, rows: NDArray[np.float64]
    ) -> tuple[MonitorState, Surprise, NDArray[np.float64]]:
        """Return the new state, the surprise of the next rows (B, D), perhaps not finite, and its divisor (B,)."""
        B = len(rows)
        old = RowState(state.model, state.detection, state.excuses)
        new = uninitialised(old)
        found = RowSurprise(np.empty(B), np.empty(rows.shape), np.empty(B), np.empty(B, np.int8), np.empty(B))
        if B == 1:  # calls no BLAS
            observe_rows(rows, old, new, found, *self._learned)
        else:
            with _ONE_THREAD:
                observe_rows(rows, old, new, found, *self._learned)
        raw = (found.raw, found.excuse) if self._excuses is not None else (None, None)
        surprise = Surprise(found.value, found.attribution, None, None, None, *raw)
        return MonitorState(new.memory, new.detection, new.excuses), surprise, found.divisor


class _OneThread:
    """Limit BLAS to one thread: several are slower at products this small, above all where they share cores."""

    def __init__(self) -> None:
        self._lock, self._inside = Lock(), 0
        self._blas: ThreadpoolController | None = None
        self._limit: Any = None

    def __enter__(self) -> None:
        with self._lock:
            if self._inside == 0:
                self._blas = self._blas or ThreadpoolController()  # looks through all libraries, once
                self._limit = self._blas.limit(limits=1, user_api="blas")
            self._inside += 1

    def __exit__(self, *error: object) -> None:
        with self._lock:
            self._inside -= 1
            if self._inside == 0:
                self._limit.restore_original_limits()


_ONE_THREAD = _OneThread()


def uninitialised(state: Any) -> Any:
    """Return a state of the same arrays, in whatever nesting, that are yet to be written."""
    if isinstance(state, np.ndarray):
        return np.empty(state.shape, state.dtype)
    return type(state)(*map(uninitialised, state))


def _learned_excuses(excuses: Excuses | None) -> LearnedExcuses:
    if excuses is None:
        none = np.zeros(0, np.intp)
        return LearnedExcuses(False, none, none, none, np.zeros(3, np.int64), np.zeros((0, 2)), 0.0)
    (wrist, joints, fingers, rows), ends = excuses.arrays
    return LearnedExcuses(True, wrist, joints, fingers, rows, ends, excuses.on_its_way)


@compiled
def _compare(rows: Any, old: RowHistory, new: RowHistory) -> Any:
    """Write the new history; return the rows that ``rows`` (B, D) are compared with, and those before."""
    lag = old.before.shape[1]
    before, earlier = rows.copy(), rows.copy()  # at first nothing moves
    for n in range(len(rows)):
        if old.steps[n] >= lag:
            before[n] = old.before[n, 0]
        earlier[n] = old.earlier[n, 0] if old.steps[n] >= 2 * lag else before[n]
        new.before[n, : lag - 1], new.earlier[n, : lag - 1] = old.before[n, 1:], old.earlier[n, 1:]
        new.before[n, lag - 1], new.earlier[n, lag - 1] = rows[n], before[n]
        new.steps[n] = old.steps[n] + 1
    return before, earlier


@compiled
def _carried(old: MemoryState, senses: Any, seen: Any, commands: Any, learned: LearnedMemory) -> Any:
    """f(μ_t) (B, H) and c_t (B, I) after a row that all streams take up."""
    pi_z, pi_x, curvature, most = (
        learned.prior_precision,
        learned.sensory_precision,
        learned.curvature,
        learned.iterations,
    )
    if learned.settles:
        s = learned.settling
        mu = outward(activate(old.traces), s.W_H) + outward(commands, s.W_U)
        z = infer(mu, senses - s.b_F, s.W_F, pi_z, pi_x * seen, curvature, most)
        return activate(mu), z
    w = learned.traces
    weights = w.W_C, w.W_F, w.W_D, w.gains
    return carry(old.traces, commands, senses, seen, *weights, pi_z, pi_x, curvature, most, learned.context)


@partial(compiled, calls=("memory", "."))
def expect_rows(rows: Any, old: MemoryState, new: MemoryState, learned: LearnedMemory) -> Any:
    """Write the new state; return the errors (B, X) of rows (B, D), and which of their numbers are finite (B, D)."""
    steps, lag = old.history.steps, old.history.before.shape[1]
    before, earlier = _compare(rows, old.history, new.history)
    scale = learned.mean, learned.spread, learned.change
    columns = learned.sensory, learned.motor, learned.slow
    senses, seen, commands, inputs, changes, whole, finite = _read(rows, before, earlier, *scale, *columns)

    new.traces[:], new.expected[:] = old.traces, old.expected
    if (steps % lag == 0).any():
        expected, traces = _carried(old, senses, seen, commands, learned)
        for n in range(len(rows)):
            if steps[n] % lag == 0:
                new.traces[n], new.expected[n] = traces[n], expected[n]

    a = learned.association
    predicts = a.V, a.U, a.D, a.W_S, a.b_S, a.span_S, a.remainder
    error, units = normalised_errors(inputs, changes, whole, *predicts, learned.spans)
    for n in range(len(rows)):
        if steps[n] < lag:
            error[n] = 0.0  # nothing came before, so that no change is known
        elif steps[n] < 2 * lag:
            error[n] *= UNSURE
    if old.skill.shape[1]:
        new.skill[:] = add_up(old.skill, units, new.expected, learned.W_K, learned.b_K)
    return error, finite


@partial(compiled, calls=("memory", "detection", "."))
def observe_rows(
    rows: Any,
    old: RowState,
    new: RowState,
    found: RowSurprise,
    memory: LearnedMemory,
    evidence: LearnedEvidence,
    excuses: LearnedExcuses,
) -> None:
    """Write the ``new`` state after rows (B, D), and the surprise that is ``found``."""
    error, finite = expect_rows(rows, old.memory, new.memory, memory)
    was, now = old.detection.evidence, new.detection.evidence
    errors, context = error.astype(np.float64), new.memory.expected.astype(np.float64)
    white = evidence.whitening, evidence.ceiling, evidence.tail
    usual = evidence.context_quantile, evidence.context_range, evidence.gains
    (now.vector[:], now.context[:], now.steps[:]), _, shares = _step(
        was.vector, was.context, was.steps, errors, context, *white, *usual, evidence.bound
    )
    before, after = old.detection.repetition, new.detection.repetition
    after.row[:], after.again[:], after.unlikely[:] = repeated(
        before.row,
        before.again,
        before.unlikely,
        rows[:, memory.sensory],
        evidence.repetition_steps,
        evidence.repetition_most,
    )
    stuck = after.unlikely, evidence.repetition_offset
    _attribute(shares, *stuck, memory.sensory, finite, found.value, found.attribution)
    found.raw[:], found.excuse[:], found.divisor[:] = found.value, 0, 1.0
    if excuses.active:
        senses = excuses.wrist, excuses.joints, excuses.ends, excuses.fingers
        lasting = excuses.rows, excuses.on_its_way
        new.excuses[:], found.excuse[:], found.divisor[:] = _excuse(old.excuses, rows, *senses, *lasting)
        for n in range(len(rows)):
            if found.divisor[n] != 1.0:
                found.value[n] /= found.divisor[n]
                found.attribution[n] /= found.divisor[n]


@compiled
def _attribute(
    shares: Any, unlikely: Any, offset: Any, sensory: Any, finite: Any, value: Any, attribution: Any
) -> None:
    """Write the surprise: shares of errors (B, X), pooled with repetitions; what is not finite is above all."""
    X = len(sensory)
    attribution[:] = 0.0
    ratios = np.zeros(X)
    for n in range(len(value)):
        for i in range(X):
            attribution[n, sensory[i]] = shares[n, i]
        found = attribution[n].sum()
        greatest = max(found, TINY)
        for i in range(X):
            stuck = unlikely[n, i] > 0
            ratios[i] = np.exp(TAIL_INDEX * (unlikely[n, i] - offset[i])) if stuck else 0.0
            greatest = max(greatest, ratios[i])
        total = (found / greatest) ** POWER
        own = total
        for i in range(X):
            ratios[i] = (ratios[i] / greatest) ** POWER
            total += ratios[i]
        pooled = greatest * total ** (1.0 / POWER) / max(total, TINY)
        if total > own:
            for i in range(X):
                shared = attribution[n, sensory[i]] * (pooled * own / max(found, TINY))
                attribution[n, sensory[i]] = shared + pooled * ratios[i]
        if not finite[n].all():
            for i in range(attribution.shape[1]):
                attribution[n, i] = 0.0 if finite[n, i] else np.inf
        value[n] = attribution[n].sum()
