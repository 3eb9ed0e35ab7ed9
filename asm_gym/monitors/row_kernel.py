"""One row of each stream in one compiled call: the errors of a memory, their evidence, and what excuses it.

    read → carry on, associate → errors → whiten, accumulate → repetitions → attribute → excuse

``expect_rows`` is the first half, which a memory's model uses by itself; ``observe_rows`` is all of it.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
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
from asm_gym.detection.evidence import POWER, TAIL_INDEX, TINY, Evidence
from asm_gym.detection.evidence_detection import EvidenceDetection, EvidenceState
from asm_gym.detection.repetition import Repetition, repeated
from asm_gym.memory.association import Association, normalised_errors
from asm_gym.memory.energy import activate, infer, outward
from asm_gym.memory.readout import add_up
from asm_gym.memory.settling import SettlingWeights, settling_shapes
from asm_gym.memory.temporal import UNSURE, MemoryState, RowHistory, TemporalNetwork
from asm_gym.memory.traces import Weights, carry, weight_shapes
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
        m, none = memory, np.zeros(0, np.intp)
        columns, ends = ([none] * 4, np.zeros((0, 2))) if excuses is None else excuses.arrays
        scalars = m.prior_precision, m.sensory_precision, m.curvature, m.iterations, m.settles, d.bound
        excused = (False, 0.0) if excuses is None else (True, excuses.on_its_way)
        context = bool(d.context_quantile[:-1].any())
        numbers = np.array([*scalars, context, *excused], np.float64)
        detector = d.whitening, d.ceiling, d.tail, d.context_quantile, d.context_range, d.gains
        singles = *m.traces, *m.settling, *m.association, m.W_K, m.b_K
        doubles = numbers, m.mean, m.spread, m.change, *detector, *detection.repeating, ends
        places = m.sensory, m.motor, m.slow, m.spans, *columns
        packed = [_packed(*part) for part in ((np.float32, singles), (np.float64, doubles), (np.int64, places))]
        self._learned: tuple[Any, ...] = *(flat for flat, _ in packed), np.array([w for _, at in packed for w in at])
        self._excuses = excuses
        self._kinds: dict[int, list[tuple[tuple[int, ...], Any]]] = {}  # of the arrays of a state of B streams

    def __call__(
        self, state: MonitorState, rows: NDArray[np.float64]
    ) -> tuple[MonitorState, Surprise, NDArray[np.float64]]:
        """Return the new state, the surprise of the next rows (B, D), perhaps not finite, and its divisor (B,)."""
        B, empty = len(rows), np.empty
        (traces, expected, (before, earlier, steps), skill), (evidence, repetition) = state.model, state.detection
        old = traces, expected, before, earlier, steps, skill, *evidence, *repetition, state.excuses
        kinds = self._kinds.get(B) or self._kinds.setdefault(B, [(a.shape, a.dtype) for a in old])
        new = [empty(*kind) for kind in kinds]
        value, attribution, raw, excuse, divisor = empty(B), empty(rows.shape), empty(B), empty(B, np.int8), empty(B)
        arguments: tuple[Any, ...] = rows, *old, *new, value, attribution, raw, excuse, divisor, *self._learned
        if B == 1:  # calls no BLAS
            observe_rows(*arguments)
        else:
            with _ONE_THREAD:
                observe_rows(*arguments)
        excused = (raw, excuse) if self._excuses is not None else (None, None)
        surprise = Surprise(value, attribution, None, *excused)
        memory = MemoryState(new[0], new[1], RowHistory(new[2], new[3], new[4]), new[5])
        detection = EvidenceState(Evidence(new[6], new[7], new[8]), Repetition(new[9], new[10], new[11]))
        return MonitorState(memory, detection, new[12]), surprise, divisor


def _packed(kind: Any, arrays: Sequence[NDArray[Any]]) -> tuple[NDArray[Any], list[tuple[int, int, int]]]:
    """Return arrays end to end, each at the beginning of a line of the cache; and where, and of which shape, each is.

    A vector is a matrix of one row, an array of three axes one of as many rows as its first two axes hold.
    """
    flat, where, end, line = [], [], 0, 64 // np.dtype(kind).itemsize
    for array in arrays:
        columns = array.shape[-1]
        where.append((end, int(np.prod(array.shape[:-1])), columns))
        flat += [np.ravel(array).astype(kind), np.zeros(-array.size % line, kind)]
        end += array.size + flat[-1].size
    return np.concatenate(flat), where


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


@compiled
def _matrix(flat: Any, where: Any, k: int) -> Any:
    begin, rows, columns = where[k]
    return flat[begin : begin + rows * columns].reshape((rows, columns))


@compiled
def _vector(flat: Any, where: Any, k: int) -> Any:
    begin, rows, columns = where[k]
    return flat[begin : begin + rows * columns]


@compiled
def _unpacked(singles: Any, doubles: Any, places: Any, where: Any) -> Any:
    """Return what was learned, from the arrays of a ``RowKernel``, in their order."""
    S, D, P, w = singles, doubles, places, where
    numbers = _vector(D, w, 18)
    traces = Weights(_matrix(S, w, 0), _matrix(S, w, 1), _matrix(S, w, 2), _vector(S, w, 3))
    settling = SettlingWeights(_matrix(S, w, 4), _matrix(S, w, 5), _matrix(S, w, 6), _vector(S, w, 7), _matrix(S, w, 8))
    association = Association(
        _matrix(S, w, 9),
        _matrix(S, w, 10),
        _matrix(S, w, 11),
        _matrix(S, w, 12),
        _vector(S, w, 13),
        _matrix(S, w, 14),
        _vector(S, w, 15),
    )
    sensory = _vector(P, w, 32)
    memory = LearnedMemory(
        _vector(D, w, 19),
        _vector(D, w, 20),
        _vector(D, w, 21),
        sensory,
        _vector(P, w, 33),
        _vector(P, w, 34),
        traces,
        settling,
        numbers[4] != 0.0,
        np.float32(numbers[0]),
        np.float32(numbers[1]),
        np.float32(numbers[2]),
        int(numbers[3]),
        association,
        _matrix(P, w, 35),
        _matrix(S, w, 16),
        _vector(S, w, 17),
        numbers[6] != 0.0,
    )
    evidence = LearnedEvidence(
        _matrix(D, w, 22),
        _matrix(D, w, 23),
        _matrix(D, w, 24),
        _vector(D, w, 25),
        _vector(D, w, 26),
        _vector(D, w, 27),
        numbers[5],
        _vector(D, w, 28).reshape((2, 2, len(sensory))),
        _vector(D, w, 29),
        _vector(D, w, 30),
    )
    columns = _vector(P, w, 36), _vector(P, w, 37), _vector(P, w, 38), _vector(P, w, 39)
    excuses = LearnedExcuses(numbers[7] != 0.0, *columns, _matrix(D, w, 31), numbers[8])
    return memory, evidence, excuses


@partial(compiled, calls=("memory", "detection", "."))
def observe_rows(
    rows: Any,
    traces: Any,
    expected: Any,
    before: Any,
    earlier: Any,
    steps: Any,
    skill: Any,
    vector: Any,
    context: Any,
    counted: Any,
    last: Any,
    again: Any,
    unlikely: Any,
    excused: Any,
    new_traces: Any,
    new_expected: Any,
    new_before: Any,
    new_earlier: Any,
    new_steps: Any,
    new_skill: Any,
    new_vector: Any,
    new_context: Any,
    new_counted: Any,
    new_last: Any,
    new_again: Any,
    new_unlikely: Any,
    new_excused: Any,
    value: Any,
    attribution: Any,
    raw: Any,
    excuse: Any,
    divisor: Any,
    singles: Any,
    doubles: Any,
    places: Any,
    where: Any,
) -> None:
    """Write the new state after rows (B, D), and their surprise.

    The arrays come one by one: numba takes longer to look through named tuples of them than to compute with them.

    Args:
        rows: (B, D).
        traces: and on to ``excused`` the old state, the fields of ``MemoryState`` and ``EvidenceState``, and what is
            excused; after them, as ``new``, the new one.
        value, attribution, raw, excuse: of the surprise, see ``Surprise``.
        divisor: (B,) of what is excused.
        singles: and on to ``where`` what was learned, see ``_unpacked``.
    """
    learned, evidence, excuses = _unpacked(singles, doubles, places, where)
    old = MemoryState(traces, expected, RowHistory(before, earlier, steps), skill)
    new = MemoryState(new_traces, new_expected, RowHistory(new_before, new_earlier, new_steps), new_skill)
    error, finite = expect_rows(rows, old, new, learned)
    errors, now = error.astype(np.float64), new_expected.astype(np.float64)
    white = evidence.whitening, evidence.ceiling, evidence.tail
    usual = evidence.context_quantile, evidence.context_range, evidence.gains
    (new_vector[:], new_context[:], new_counted[:]), _, shares = _step(
        vector, context, counted, errors, now, *white, *usual, evidence.bound
    )
    steps_of, most = evidence.repetition_steps, evidence.repetition_most
    new_last[:], new_again[:], new_unlikely[:] = repeated(
        last, again, unlikely, rows[:, learned.sensory], steps_of, most
    )
    _attribute(shares, new_unlikely, evidence.repetition_offset, learned.sensory, finite, value, attribution)
    raw[:], excuse[:], divisor[:] = value, 0, 1.0
    if excuses.active:
        senses = excuses.wrist, excuses.joints, excuses.ends, excuses.fingers
        new_excused[:], excuse[:], divisor[:] = _excuse(excused, rows, *senses, excuses.rows, excuses.on_its_way)
        for n in range(len(rows)):
            if divisor[n] != 1.0:
                value[n] /= divisor[n]
                attribution[n] /= divisor[n]


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
