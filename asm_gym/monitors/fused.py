"""One row of each stream in one compiled call: what ``MemoryModel`` and ``EvidenceDetection`` make of it together.

read → expect, infer → associate → whiten, accumulate → repetitions → attribute

The parts are the kernels of those two, and so is the mathematics; what is saved is Python between them, which took as
long as they did. They stay as they are for every other pair of model and detection, and are the oracle of this one.
"""

from __future__ import annotations

import sys
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from threading import Lock
from typing import Any

import numpy as np
from numpy.typing import NDArray
from threadpoolctl import ThreadpoolController

from asm_gym.compilation import compiled, must_compile
from asm_gym.detection import Detection, EvidenceDetection
from asm_gym.detection.detector import _step
from asm_gym.detection.evidence import POWER, TINY, Evidence
from asm_gym.detection.evidence_detection import EvidenceState
from asm_gym.detection.repetition import Repetition, repeated
from asm_gym.detection.tails import TAIL_INDEX
from asm_gym.memory.association import normalised_errors
from asm_gym.memory.inference import carry
from asm_gym.memory.network import Network
from asm_gym.memory.readout import add_up
from asm_gym.memory.state import UNSURE, MemoryState
from asm_gym.monitors.base import Surprise
from asm_gym.monitors.memory_model import MemoryModel
from asm_gym.monitors.monitor import MonitorState
from asm_gym.scaling import _read

(W_C, W_F, W_D, KEPT, V, U, LINEAR, W_S, B_S, SPAN_S, REMAINDER, W_K, B_K) = range(13)
(MEAN, SPREAD, CHANGE, WHITENING, CEILING, TAIL, USUAL, BETWEEN, GAINS, REPEATS, MOST, OFFSET, BOUND) = range(13, 26)
SENSORY, MOTOR, SLOW, SPANS = range(26, 30)
"""Places of what was learned in ``CompiledRow``."""

A_THREAD = 256
"""Streams that one thread observes at a time."""


class _OneThread:
    """While anybody is in such a block BLAS uses one thread: several are slower at products this small, and by tens of
    times where they share cores with others."""

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


class CompiledRow:
    """``observe`` of a memory under the detection of evidence.

    What was learned lies in three arrays, one a kind of number: a row finds it in one piece, and handing over sixty
    arrays took longer than adding them up.

    Args:
        model: fitted, and one of traces.
        detection: fitted.
    """

    def __init__(self, model: MemoryModel, detection: EvidenceDetection) -> None:
        network, d, s = model.network, detection.detector_, model.senses_
        assert d is not None
        if must_compile(_observe):
            print("asm-gym: compiling the memory, once on this machine (about a minute)", file=sys.stderr)
        skills = [model.learned_[n] for n in ("W_K", "b_K")] if model.skills_ else [np.zeros((0, 0)), np.zeros(0)]
        detector = d.whitening, d.ceiling, d.tail, d.context_quantile, d.context_range, d.gains
        singles, where_singles = _side_by_side(np.float32, *network.weights, *network.association, *skills)
        doubles, where_doubles = _side_by_side(
            np.float64, s.mean, s.spread, s.change, *detector, *detection.repeating, np.array([d.bound])
        )
        spec = model.spec
        whole, where_whole = _side_by_side(np.int64, spec.sensory, spec.motor, s.slow, network.spans)
        where = np.stack([*where_singles, *where_doubles, *where_whole])
        self.learned: tuple[Any, ...] = (
            singles,
            doubles,
            whole,
            where,
            *network.inference,
            bool(d.context_quantile[:-1].any()),
        )

    @classmethod
    def of(cls, model: MemoryModel, detection: Detection) -> CompiledRow | None:
        """That of a model and a detection; None where there is none for them."""
        fits = isinstance(model.network, Network) and isinstance(detection, EvidenceDetection)
        return cls(model, detection) if fits and isinstance(detection, EvidenceDetection) else None

    def __call__(self, state: MonitorState, rows: NDArray[np.float64]) -> tuple[MonitorState, Surprise]:
        """The new state, and the surprise of the next rows (B, D), some of which may not be finite."""
        model, (evidence, repetition) = state.model, state.detection
        old = (*model, *evidence, *repetition)
        new, B = [np.empty_like(a) for a in old], len(rows)
        found = np.empty(B), np.empty_like(rows)
        arrays: tuple[Any, ...] = (rows, *old, *new, *found)
        if B == 1:  # calls no BLAS
            _observe(*arrays, *self.learned)
        else:
            parts = [[a[n : n + A_THREAD] for a in arrays] for n in range(0, B, A_THREAD)]
            with _ONE_THREAD:
                if len(parts) == 1:
                    _observe(*parts[0], *self.learned)
                else:
                    with ThreadPoolExecutor() as threads:
                        list(threads.map(lambda part: _observe(*part, *self.learned), parts))
        detection = EvidenceState(Evidence(*new[6:9]), Repetition(*new[9:]))
        return MonitorState(MemoryState(*new[:6]), detection), Surprise(*found)


def _side_by_side(kind: Any, *arrays: Any) -> tuple[NDArray[Any], list[tuple[int, int, int]]]:
    """Arrays end to end, and of each where it begins and its shape, as a matrix; every one begins a line of cache."""
    where, parts, begins, line = [], [], 0, 64 // np.dtype(kind).itemsize
    for array in arrays:
        flat = np.asarray(array, kind).ravel()
        columns = array.shape[-1]
        where.append((begins, flat.size // max(columns, 1), columns))
        parts += [flat, np.zeros(-flat.size % line, kind)]
        begins += flat.size + parts[-1].size
    return np.concatenate(parts), where


@compiled
def _matrix(flat: Any, where: Any, k: int) -> Any:
    begins, rows, columns = where[k]
    return flat[begins : begins + rows * columns].reshape((rows, columns))


@compiled
def _vector(flat: Any, where: Any, k: int) -> Any:
    begins, rows, columns = where[k]
    return flat[begins : begins + rows * columns]


@partial(compiled, calls=("memory", "detection", "."), nogil=True)
def _observe(
    rows: Any,
    traces: Any,
    expected: Any,
    before: Any,
    earlier: Any,
    steps: Any,
    skill: Any,
    vector: Any,
    lately: Any,
    counted: Any,
    said: Any,
    again: Any,
    unlikely: Any,
    new_traces: Any,
    new_expected: Any,
    new_before: Any,
    new_earlier: Any,
    new_steps: Any,
    new_skill: Any,
    new_vector: Any,
    new_lately: Any,
    new_counted: Any,
    new_said: Any,
    new_again: Any,
    new_unlikely: Any,
    value: Any,
    attribution: Any,
    singles: Any,
    doubles: Any,
    whole_numbers: Any,
    where: Any,
    pi_z: Any,
    pi_x: Any,
    curvature: Any,
    iterations: int,
    looks: bool,
) -> None:
    """Writes the new state, ``value`` (B,) and ``attribution`` (B, D).

    Args:
        rows: (B, D).
        traces: and on to ``unlikely`` the old state: the fields of ``MemoryState``, ``Evidence`` and ``Repetition``;
            after them, as ``new``, the new one.
        singles, doubles, whole_numbers, where: what was learned, as ``CompiledRow`` lays it out.
        looks: whether anybody looks at the context.
    """
    S, D, I, w = singles, doubles, whole_numbers, where  # noqa: E741
    sensory, motor, slow, spans = (
        _vector(I, w, SENSORY),
        _vector(I, w, MOTOR),
        _vector(I, w, SLOW),
        _matrix(I, w, SPANS),
    )
    B, lag = len(rows), before.shape[1]
    last, past = rows.copy(), rows.copy()  # what rows are compared with: at first nothing moves
    due = 0
    for n in range(B):
        if steps[n] >= lag:
            last[n] = before[n, 0]
        past[n] = earlier[n, 0] if steps[n] >= 2 * lag else last[n]
        due += steps[n] % lag == 0
        new_before[n, : lag - 1], new_earlier[n, : lag - 1] = before[n, 1:], earlier[n, 1:]
        new_before[n, lag - 1], new_earlier[n, lag - 1] = rows[n], last[n]
        new_steps[n] = steps[n] + 1
    scales = _vector(D, w, MEAN), _vector(D, w, SPREAD), _vector(D, w, CHANGE)
    senses, seen, commands, inputs, changes, whole, finite = _read(rows, last, past, *scales, sensory, motor, slow)

    new_traces[:], new_expected[:] = traces, expected
    if due:
        weights = _matrix(S, w, W_C), _matrix(S, w, W_F), _matrix(S, w, W_D), _vector(S, w, KEPT)
        f, c = carry(traces, commands, senses, seen, *weights, pi_z, pi_x, curvature, iterations, looks)
        for n in range(B):
            if steps[n] % lag == 0:
                new_traces[n], new_expected[n] = c[n], f[n]

    predicts = _matrix(S, w, V), _matrix(S, w, U), _matrix(S, w, LINEAR)
    spread = _matrix(S, w, W_S), _vector(S, w, B_S), _matrix(S, w, SPAN_S), _vector(S, w, REMAINDER)
    error, units = normalised_errors(inputs, changes, whole, *predicts, *spread, spans)
    for n in range(B):
        if steps[n] < lag:
            error[n] = 0.0  # nothing came before, so that no change is known
        elif steps[n] < 2 * lag:
            error[n] *= UNSURE
    if skill.shape[1]:
        new_skill[:] = add_up(skill, units, new_expected, _matrix(S, w, W_K), _vector(S, w, B_K))

    errors, context = error.astype(np.float64), new_expected.astype(np.float64)
    detector = _matrix(D, w, WHITENING), _matrix(D, w, CEILING), _matrix(D, w, TAIL)
    usual = _vector(D, w, USUAL), _vector(D, w, BETWEEN), _vector(D, w, GAINS), _vector(D, w, BOUND)[0]
    (new_vector[:], new_lately[:], new_counted[:]), _, shares = _step(
        vector, lately, counted, errors, context, *detector, *usual
    )
    now, adds = rows[:, sensory], _vector(D, w, REPEATS).reshape((2, 2, len(sensory)))
    new_said[:], new_again[:], new_unlikely[:] = repeated(said, again, unlikely, now, adds, _vector(D, w, MOST))
    _attribute(shares, new_unlikely, _vector(D, w, OFFSET), sensory, finite, value, attribution)


@compiled
def _attribute(
    shares: Any, unlikely: Any, offset: Any, sensory: Any, finite: Any, value: Any, attribution: Any
) -> None:
    """Writes the surprise: errors' shares (B, X), and what is stuck beside them; what is not finite above all."""
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
