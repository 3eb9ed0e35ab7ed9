"""One row of each stream in two compiled calls: the errors of a memory, their evidence, and what excuses it.

    read → carry on, associate → errors → whiten, accumulate → repetitions → attribute → excuse

``expect_rows`` is the first half, which a memory's model uses by itself; ``judge_rows`` is the second.
"""

from __future__ import annotations

import sys
from collections.abc import Mapping
from contextlib import nullcontext
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from asm_gym.blas import ONE_THREAD
from asm_gym.compilation import compiled, inner, must_compile
from asm_gym.detection.detector import _step
from asm_gym.detection.events import Excuses
from asm_gym.detection.events import _step as _excuse
from asm_gym.detection.evidence import POWER, TAIL_INDEX, TINY, Evidence
from asm_gym.detection.evidence_detection import EvidenceDetection, EvidenceState
from asm_gym.detection.repetition import Repetition, repeated
from asm_gym.memory.association import normalised_errors
from asm_gym.memory.readout import add_up
from asm_gym.memory.settling import SettlingWeights, settle, settling_shapes
from asm_gym.memory.temporal import UNSURE, MemoryState, RowHistory, TemporalNetwork
from asm_gym.memory.traces import Weights, carry, weight_shapes
from asm_gym.monitors.base import Surprise
from asm_gym.monitors.calibrated_monitor import MonitorState
from asm_gym.monitors.layout import Layout, matrix, vector
from asm_gym.scaling import StreamScaler, _read


def layout_of(network: TemporalNetwork, scaler: StreamScaler, names: Mapping[str, NDArray[Any]]) -> Layout:
    """Return what ``expect_rows`` computes with; ``names`` are W_K and b_K, of no rows where no skill has a name."""
    spec, weights = scaler.spec, network.weights._asdict()
    both = (weight_shapes(1, 1, 1), Weights), (settling_shapes(1, 1, 1), SettlingWeights)
    unused = {name: np.zeros(shape, np.float32) for shapes, _ in both for name, shape in shapes.items()}
    singles = unused | weights | network.association._asdict() | dict(names)
    doubles = {"mean": scaler.mean, "spread": scaler.spread, "change": scaler.change}
    places = {"sensory": spec.sensory, "motor": spec.motor, "slow": scaler.slow, "groups": scaler.groups}
    places["spans"] = network.spans
    arrays = {
        name: np.asarray(array, kind)
        for kind, own in ((np.float32, singles), (np.float64, doubles), (np.int64, places))
        for name, array in own.items()
    }
    how = "prior_precision", "sensory_precision", "curvature", "iterations"
    numbers = dict(zip(how, network.inference, strict=True))
    return Layout.of(arrays, numbers | {"settles": isinstance(network.weights, SettlingWeights)})


class RowKernel:
    """``observe`` of a memory under the detection of evidence, for the weights as they are.

    Args:
        memory: what its model computes with.
        detection: fitted.
        excuses: of knocks and stops; None where nothing is excused.
    """

    def __init__(self, memory: Layout, detection: EvidenceDetection, excuses: Excuses | None) -> None:
        d = detection.fitted_detector
        if must_compile(expect_rows):
            print("asm-gym: compiling the memory, once on this machine (about 20 s)", file=sys.stderr)
        arrays = {name: getattr(d, name) for name in detection.arrays[:-1]} | {"gains": d.gains}
        arrays |= dict(
            zip(("repetition_steps", "repetition_most", "repetition_offset"), detection.repeating, strict=True)
        )
        arrays["sensory"] = detection.spec.sensory
        none: list[NDArray[Any]] = [np.zeros(0, np.intp)] * 4
        columns, ends = (none, np.zeros((0, 2))) if excuses is None else excuses.arrays
        arrays |= dict(zip(("wrist", "joints", "fingers", "lasting", "ends"), (*columns, ends), strict=True))
        on_its_way = 0.0 if excuses is None else excuses.on_its_way
        excused = {"excuses": excuses is not None, "on_its_way": on_its_way}
        self._memory: tuple[Any, ...] = *memory, bool(d.context_quantile[:-1].any())
        _, *self._judges = Layout.of(arrays, {"bound": d.bound} | excused)
        self._excuses = excuses

    def __call__(
        self, state: MonitorState, rows: NDArray[np.float64], out: MonitorState | None = None
    ) -> tuple[MonitorState, Surprise, NDArray[np.float64]]:
        """Return the new state, the surprise of the next rows (B, D), perhaps not finite, and its divisor (B,).

        The new state is written to ``out``, where that is given, a state of as many streams.
        """
        B, empty = len(rows), np.empty
        old = _arrays(state)
        new = [empty(array.shape, array.dtype) for array in old] if out is None else _arrays(out)
        value, attribution, raw, excuse, divisor = empty(B), empty(rows.shape), empty(B), empty(B, np.int8), empty(B)
        found: tuple[Any, ...] = value, attribution, raw, excuse, divisor
        with ONE_THREAD if B > 1 else nullcontext():  # one row calls no BLAS
            error, finite = expect_rows(rows, *old[:6], *new[:6], *self._memory)
            judge_rows(rows, error, finite, new[1], *old[6:], *new[6:], *found, *self._judges)
        excused = (raw, excuse) if self._excuses is not None else (None, None)
        surprise = Surprise(value, attribution, None, *excused)
        if out is not None:
            return out, surprise, divisor
        memory = MemoryState(new[0], new[1], RowHistory(new[2], new[3], new[4]), new[5])
        detection = EvidenceState(Evidence(new[6], new[7], new[8]), Repetition(new[9], new[10], new[11]))
        return MonitorState(memory, detection, new[12]), surprise, divisor


def _arrays(state: MonitorState) -> list[Any]:
    """Return the arrays of a state, in the order in which the compiled functions take them."""
    (traces, expected, history, skill), (evidence, repetition) = state.model, state.detection
    return [traces, expected, *history, skill, *evidence, *repetition, state.excuses]


def uninitialised(state: Any) -> Any:
    """Return a state of the same arrays, in whatever nesting, that are yet to be written."""
    if isinstance(state, np.ndarray):
        return np.empty(state.shape, state.dtype)
    return type(state)(*map(uninitialised, state))


@inner
def _copy(rows: Any, to: Any, n: int) -> None:
    """Copy row ``n``; numba takes seconds to compile an assignment of rows, with its message about shapes."""
    for i in range(rows.shape[1]):
        to[n, i] = rows[n, i]


@inner
def _compare(
    rows: Any, before: Any, earlier: Any, steps: Any, new_before: Any, new_earlier: Any, new_steps: Any
) -> Any:
    """Write the new history; return the rows that ``rows`` (B, D) are compared with, and those before."""
    lag = before.shape[1]
    last, past = np.empty_like(rows), np.empty_like(rows)
    for n in range(len(rows)):
        new_steps[n] = steps[n] + 1
        for i in range(rows.shape[1]):
            last[n, i] = before[n, 0, i] if steps[n] >= lag else rows[n, i]  # at first nothing moves
            past[n, i] = earlier[n, 0, i] if steps[n] >= 2 * lag else last[n, i]
            new_before[n, lag - 1, i], new_earlier[n, lag - 1, i] = rows[n, i], last[n, i]
        for k in range(lag - 1):
            for i in range(rows.shape[1]):
                new_before[n, k, i], new_earlier[n, k, i] = before[n, k + 1, i], earlier[n, k + 1, i]
    return last, past


@partial(compiled, calls=("memory", "."))
def expect_rows(
    rows: Any,
    traces: Any,
    expected: Any,
    before: Any,
    earlier: Any,
    steps: Any,
    skill: Any,
    new_traces: Any,
    new_expected: Any,
    new_before: Any,
    new_earlier: Any,
    new_steps: Any,
    new_skill: Any,
    singles: Any,
    doubles: Any,
    places: Any,
    layout: Any,
    context: bool,
) -> Any:
    """Write the new state; return the errors (B, X) of rows (B, D), and which of their numbers are finite (B, D).

    Args:
        rows: (B, D).
        traces: and on to ``skill`` the fields of ``MemoryState``; after them, as ``new``, those that are written.
        singles: and on to ``layout`` what was learned, see ``layout_of``.
        context: whether f(μ) is wanted.
    """
    at, lag, due = layout[0], before.shape[1], False
    last, past = _compare(rows, before, earlier, steps, new_before, new_earlier, new_steps)
    scale = vector(doubles, at.mean), vector(doubles, at.spread), vector(doubles, at.change)
    columns = vector(places, at.sensory), vector(places, at.motor), vector(places, at.slow)
    senses, seen, commands, inputs, changes, whole, finite = _read(rows, last, past, *scale, *columns)

    for n in range(len(rows)):
        due = due or steps[n] % lag == 0
        _copy(traces, new_traces, n)
        _copy(expected, new_expected, n)
    if due:  # f(μ_t) (B, H) and c_t (B, I), were it due for all streams
        how = at.prior_precision, at.sensory_precision, at.curvature, at.iterations
        W_F = matrix(singles, at.W_F)
        if at.settles:
            weights = matrix(singles, at.W_H), matrix(singles, at.W_U), W_F, vector(singles, at.b_F)
            state, carried = settle(traces, commands, senses, seen, *weights, *how)
        else:
            others = matrix(singles, at.W_D), vector(singles, at.gains)
            state, carried = carry(traces, commands, senses, seen, matrix(singles, at.W_C), W_F, *others, *how, context)
        for n in range(len(rows)):
            if steps[n] % lag == 0:
                _copy(carried, new_traces, n)
                _copy(state, new_expected, n)

    hidden = matrix(singles, at.V), matrix(singles, at.U), matrix(singles, at.D)
    spread = matrix(singles, at.W_S), vector(singles, at.b_S), matrix(singles, at.span_S)
    beyond = vector(singles, at.remainder), matrix(places, at.spans)
    far = matrix(singles, at.R), matrix(singles, at.Q), matrix(singles, at.doubt), vector(places, at.groups)
    error, units = normalised_errors(inputs, changes, whole, *hidden, *spread, *beyond, *far, rows.shape[1])
    for n in range(len(rows)):
        # Nothing came before the first rows, so that no change is known.
        sure = np.float32(0.0) if steps[n] < lag else UNSURE
        for i in range(error.shape[1]):
            if steps[n] < 2 * lag:
                error[n, i] *= sure
    if skill.shape[1]:
        named = add_up(skill, units, new_expected, matrix(singles, at.W_K), vector(singles, at.b_K))
        for n in range(len(rows)):
            _copy(named, new_skill, n)
    return error, finite


@partial(compiled, calls=("detection", "."))
def judge_rows(
    rows: Any,
    error: Any,
    finite: Any,
    expected: Any,
    evidence: Any,
    context: Any,
    counted: Any,
    last: Any,
    again: Any,
    unlikely: Any,
    excused: Any,
    new_evidence: Any,
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
    learned: Any,
    columns: Any,
    layout: Any,
) -> None:
    """Write the surprise of rows (B, D), and the state of detection after them.

    The arrays come one by one: numba takes longer to look through named tuples of them than to compute with them.

    Args:
        error, finite, expected: (B, X), (B, D) and (B, H), as ``expect_rows`` found them.
        evidence: and on to ``excused`` the fields of ``EvidenceState``, and what is excused; after them, as ``new``,
            those that are written.
        value, attribution, raw, excuse: of the surprise, see ``Surprise``.
        divisor: (B,) of what is excused.
        learned: and on to ``layout`` what is known of detection and excuses.
    """
    d = layout[0]
    B, X = error.shape
    errors, shares, now = np.empty((B, X)), np.empty((B, X)), np.empty(expected.shape)
    for n in range(B):
        for i in range(X):
            errors[n, i] = error[n, i]
        for i in range(now.shape[1]):
            now[n, i] = expected[n, i]
    white = matrix(learned, d.whitening), matrix(learned, d.ceiling), matrix(learned, d.tail)
    usual = vector(learned, d.context_quantile), vector(learned, d.context_range), vector(learned, d.gains)
    new = new_evidence, new_context, new_counted, value, shares
    _step(evidence, context, counted, errors, now, *white, *usual, d.bound, *new)
    sensory, offset = vector(columns, d.sensory), vector(learned, d.repetition_offset)
    by = vector(learned, d.repetition_steps).reshape((2, 2, X)), vector(learned, d.repetition_most)
    repeated(last, again, unlikely, rows, sensory, *by, new_last, new_again, new_unlikely)
    _attribute(shares, new_unlikely, offset, sensory, finite, value, attribution)
    for n in range(B):
        raw[n], excuse[n], divisor[n] = value[n], 0, 1.0
    if d.excuses:
        stops = vector(columns, d.joints), matrix(learned, d.ends)
        senses = vector(columns, d.wrist), *stops, vector(columns, d.fingers), vector(columns, d.lasting)
        _excuse(excused, rows, *senses, d.on_its_way, new_excused, excuse, divisor)
        for n in range(B):
            if divisor[n] != 1.0:
                value[n] /= divisor[n]
                for i in range(attribution.shape[1]):
                    attribution[n, i] /= divisor[n]


@inner
def _attribute(
    shares: Any, unlikely: Any, offset: Any, sensory: Any, finite: Any, value: Any, attribution: Any
) -> None:
    """Write the surprise: shares of errors (B, X), pooled with repetitions; what is not finite is above all."""
    D, X = attribution.shape[1], len(sensory)
    ratios = np.zeros(X)
    for n in range(len(value)):
        found, whole = 0.0, True
        for i in range(D):
            attribution[n, i] = 0.0
            whole = whole and finite[n, i]
        for i in range(X):
            attribution[n, sensory[i]] = shares[n, i]
        for i in range(D):
            found += attribution[n, i]
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
        value[n] = 0.0
        for i in range(D):
            if not whole:
                attribution[n, i] = 0.0 if finite[n, i] else np.inf
            value[n] += attribution[n, i]
