"""One row of each stream in one compiled call: the errors of a memory, their evidence, and what excuses it.

    read → carry on, associate → errors → whiten, accumulate → repetitions, events → attribute

Functions that write a state take the state before and the state after, whose arrays they fill. ``expected_errors``
stops at the errors, for a memory under another detection and for one that learns.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from asm_gym.blas import one_thread_for
from asm_gym.compilation import Bound, announce, bind, compiled, inner
from asm_gym.detection.alarm_rule import JUDGED
from asm_gym.detection.base import ModelOutput
from asm_gym.detection.benign_events import NO_SENSES, BenignEvents, EventState, find_events
from asm_gym.detection.detector import NO_DETECTOR, step_evidence
from asm_gym.detection.evidence import Evidence, scale, total
from asm_gym.detection.evidence_detection import EvidenceDetection, EvidenceState
from asm_gym.detection.repetition import (
    NO_REPETITION,
    Repetition,
    RepetitionWeights,
    pool_repetitions,
    step_repetition,
)
from asm_gym.memory.association import Association, Wiring, normalised_errors
from asm_gym.memory.energy import Inference
from asm_gym.memory.readout import add_up
from asm_gym.memory.recurrent import RecurrentWeights, recurrent_shapes, remember
from asm_gym.memory.settling import SettlingWeights, settle, settling_shapes
from asm_gym.memory.temporal import UNSURE, MemoryState, RowHistory, TemporalNetwork
from asm_gym.monitors.monitor_protocol import Surprise
from asm_gym.monitors.monitor_state import MonitorState
from asm_gym.scaling import RowScale, ScaledRows, StreamScaler, read_rows

KINDS_OF_WEIGHTS: dict[Any, Any] = {
    SettlingWeights: settling_shapes,
    RecurrentWeights: recurrent_shapes,
}
"""The records of weights that a temporal network may have, and their shapes."""
STATE_ARRAYS = 14  # of ``arrays_of``


class RowWeights(NamedTuple):
    """The learned numbers of a memory, as compiled code reads them."""

    settling: SettlingWeights
    recurrent: RecurrentWeights
    settles: bool  # the temporal network settles; the weights of the other kind are 0
    association: Association
    wiring: Wiring
    W_K: NDArray[np.float32]  # (K, M + H) from units and context to the evidence for each skill
    b_K: NDArray[np.float32]  # noqa: N815 (K,)
    scale: RowScale
    inference: Inference


def row_weights(
    network: TemporalNetwork, scaler: StreamScaler, learned: Mapping[str, NDArray[Any]]
) -> RowWeights:
    """Return the learned numbers of a memory; ``learned`` has W_K and b_K where skills have names."""
    unused: dict[Any, Any] = {
        kind: kind._make(np.zeros(shape, np.float32) for shape in shapes(1, 1, 1).values())
        for kind, shapes in KINDS_OF_WEIGHTS.items()
    }
    kind: Any = type(network.weights)
    used = unused | {kind: kind._make(map(single, network.weights))}
    return RowWeights(
        settling=used[SettlingWeights],
        recurrent=used[RecurrentWeights],
        settles=kind is SettlingWeights,
        association=Association._make(map(single, network.association)),
        wiring=Wiring.of(network.association, scaler),
        W_K=single(learned.get("W_K", np.zeros((0, 0)))),
        b_K=single(learned.get("b_K", np.zeros(0))),
        scale=scaler.row_scale,
        inference=network.inference,
    )


def single(array: NDArray[Any]) -> NDArray[np.float32]:
    """Return a writable copy, of the one type that compiled code takes."""
    return np.array(array, np.float32, order="C")


class RowKernel:
    """Observe rows by a memory under the detection of evidence; new weights need a new kernel.

    Args:
        memory: its learned numbers.
        detection: fitted.
        events: that excuse surprise; None where nothing is excused.
    """

    def __init__(
        self, memory: RowWeights, detection: EvidenceDetection, events: BenignEvents | None
    ) -> None:
        announce(observe_rows, "the memory")
        self._arguments = (memory, detection, events)
        self._memory = memory
        self._detector = detection.fitted_detector
        self._has_events = events is not None
        senses = NO_SENSES
        if events is not None:
            senses = events.senses
        wants_context = bool(self._detector.context_quantile[:-1].any())
        self._learned = bind(
            memory, wants_context, self._detector, detection.fitted_repetition, senses
        )

    def is_of(self, memory: RowWeights, detection: EvidenceDetection) -> bool:
        """Return whether the kernel computes with the learned numbers of this memory and this detection."""
        return self._memory is memory and self._detector is detection.detector_

    def __reduce__(self) -> tuple[Any, ...]:
        """Copy and pickle by the arguments: what is bound lies in memory that is not Python's."""
        return RowKernel, self._arguments

    def bound(self, state: MonitorState, new: MonitorState) -> Bound:
        """Return all that ``observe_rows`` needs.

        Args:
            state: before the rows.
            new: to be written, a state of as many streams, which shares no array with ``state``.
        """
        return bind_states(self._learned, *arrays_of(state), *arrays_of(new))

    def __call__(
        self, state: MonitorState, rows: NDArray[np.float64], out: MonitorState | None = None
    ) -> tuple[MonitorState, Surprise, NDArray[np.float64]]:
        """Return the new state, the surprise of the next rows (B, D), perhaps not finite, and its divisor (B,).

        The new state is written to ``out``, where that is given, a state of as many streams.
        """
        if out is None:
            out = unwritten(state)
        judged = np.empty(len(rows), JUDGED)
        attribution = np.empty(rows.shape)
        with one_thread_for(len(rows)):
            observe_rows(self.bound(state, out), rows, judged, attribution)

        return out, self.surprise(judged, attribution), judged["divisor"].copy()

    def surprise(self, judged: Any, attribution: NDArray[np.float64]) -> Surprise:
        """Return the surprise of rows (N,) of ``JUDGED``, with their attribution (N, D)."""
        surprise = Surprise(judged["surprise"].copy(), attribution)
        if not self._has_events:
            return surprise
        return surprise._replace(raw=judged["raw_surprise"].copy(), excuse=judged["excuse"].copy())


def expected_errors(
    memory: RowWeights, before: MemoryState, after: MemoryState, rows: NDArray[np.float64]
) -> Any:
    """Return the errors (B, X) of rows (B, D), and write the memory's state; nothing is judged."""
    learned = bind(memory, True, NO_DETECTOR, NO_REPETITION, NO_SENSES)
    streams = len(rows)
    detection = EvidenceState(NO_DETECTOR.start(streams), Repetition.start(streams, 0))
    events = EventState.start(streams, 0)
    states = [MonitorState(memory_state, detection, events) for memory_state in (before, after)]
    bound = bind_states(learned, *arrays_of(states[0]), *arrays_of(states[1]))
    return observe_rows(bound, rows, np.empty(streams, JUDGED), np.empty(rows.shape))


def arrays_of(state: MonitorState) -> list[NDArray[Any]]:
    """Return the arrays of a state in the order in which ``state_of`` takes them."""
    memory = state.model
    detection = state.detection
    return [
        memory.carried,
        memory.expected,
        memory.skill,
        *memory.history,
        *detection.evidence,
        *detection.repetition,
        *state.excuses,
    ]


@inner
def state_of(arrays: Any) -> MonitorState:
    """Return the state of ``STATE_ARRAYS`` arrays, in the order of ``arrays_of``."""
    carried, expected, skill = arrays[:3]
    history = RowHistory(arrays[3], arrays[4], arrays[5])
    evidence = Evidence(arrays[6], arrays[7], arrays[8])
    repetition = Repetition(arrays[9], arrays[10], arrays[11])
    return MonitorState(
        model=MemoryState(carried, expected, history, skill),
        detection=EvidenceState(evidence, repetition),
        excuses=EventState(arrays[12], arrays[13]),
        values=(),
    )


@partial(compiled, calls=("memory", "detection", "."))
def bind_states(learned: Bound, *arrays: Any) -> Bound:
    """Return what was learned, a state, and a state that is to be written, as one object.

    ``arrays`` are those of both states: Numba takes longer to look through nested named tuples that
    Python hands over than through arrays.
    """
    state = state_of(arrays[:STATE_ARRAYS])
    written = state_of(arrays[STATE_ARRAYS:])
    return Bound((learned, state, written))  # type: ignore[no-untyped-call]


def unwritten(state: Any) -> Any:
    """Return an uninitialised state of the same nesting, shapes and types."""
    if isinstance(state, np.ndarray):
        return np.empty(state.shape, state.dtype)
    if not state:
        return state
    return type(state)._make(map(unwritten, state))


@partial(compiled, calls=("memory", "detection", "."))
def observe_rows(bound: Bound, rows: Any, judged: Any, attribution: Any) -> Any:
    """Observe the next rows, write the new state, and return the memory's errors (B, X).

    A detector of no errors judges nothing: then ``judged`` and ``attribution`` stay as they are.

    Args:
        bound: what was learned, the state before, and the state to write (``RowKernel.bound``).
        rows: (B, D), perhaps not finite.
        judged: (B,) of ``JUDGED``, written.
        attribution: (B, D) share of each number in the surprise, written.
    """
    learned, before, after = bound.parts
    weights, wants_context, detector, repetition, senses = learned.parts
    reading = read(weights, before.model.history, after.model.history, rows)
    carry_on(weights, before.model, after.model, reading, wants_context)
    errors, units = associate(weights, reading)
    weigh_first_rows(before.model.history, errors)
    name_skills(weights, before.model, after.model, units)

    if detector.whitening.size:
        shares = np.empty(errors.shape)
        output = ModelOutput(errors, after.model.expected)
        step_evidence(detector, before.detection.evidence, after.detection.evidence, output, shares)
        step_repetition(repetition, before.detection.repetition, after.detection.repetition, rows)
        find_events(senses, before.excuses, after.excuses, rows, judged)
        unlikely = after.detection.repetition.unlikely
        surprise_of_rows(repetition, unlikely, shares, reading.finite, judged, attribution)
    return errors


@inner
def weigh_first_rows(history: RowHistory, errors: Any) -> None:
    """Weigh the errors (B, X) of the first rows less: nothing came before them, so that no change is known."""
    lag = history.before.shape[1]
    for n in range(len(errors)):
        weight = np.float32(1.0)
        if history.steps[n] < lag:
            weight = np.float32(0.0)
        elif history.steps[n] < 2 * lag:
            weight = UNSURE
        scale(errors[n], weight)


@partial(inner, inlined=True)
def name_skills(weights: RowWeights, before: MemoryState, after: MemoryState, units: Any) -> None:
    """Write the evidence for each skill, by the units (B, M) and the state."""
    if before.skill.shape[1]:
        skill = add_up(before.skill, units, after.expected, weights.W_K, weights.b_K)
        for n in range(len(skill)):
            copy(skill[n], after.skill[n])


@inner
def copy(values: Any, to: Any) -> None:
    """Copy values (N,); an assignment of rows takes Numba seconds to compile, for its message about shapes."""
    for i in range(len(values)):
        to[i] = values[i]


@inner
def push(before: Any, newest: Any, after: Any) -> None:
    """Write the last rows (l, D): those before without the oldest, then the newest (D,)."""
    for k in range(1, len(before)):
        copy(before[k], after[k - 1])
    copy(newest, after[-1])


@partial(inner, inlined=True)
def read(weights: RowWeights, history: RowHistory, new: RowHistory, rows: Any) -> ScaledRows:
    """Write the history after rows (B, D); return the rows, scaled, and their changes.

    A row is compared with the one l rows before, and that with the one before it; at first nothing moves.
    """
    lag = history.before.shape[1]
    before = np.empty_like(rows)
    earlier = np.empty_like(rows)
    for n in range(len(rows)):
        steps = history.steps[n]
        new.steps[n] = steps + 1
        copy(rows[n], before[n])
        if steps >= lag:
            copy(history.before[n, 0], before[n])
        copy(before[n], earlier[n])
        if steps >= 2 * lag:
            copy(history.earlier[n, 0], earlier[n])
        push(history.before[n], rows[n], new.before[n])
        push(history.earlier[n], before[n], new.earlier[n])

    return read_rows(rows, before, earlier, weights.scale)


@partial(inner, inlined=True)
def carry_on(
    weights: RowWeights,
    before: MemoryState,
    after: MemoryState,
    reading: ScaledRows,
    wants_context: bool,
) -> None:
    """Write carried and expected state of every stream.

    The temporal network takes up every l-th row of a stream; at the others both stay.
    """
    steps = before.history.steps
    lag = before.history.before.shape[1]
    any_due = False
    for n in range(len(steps)):
        any_due = any_due or steps[n] % lag == 0
        copy(before.carried[n], after.carried[n])
        copy(before.expected[n], after.expected[n])
    if any_due:
        expected, carried = follow(
            weights, before.carried, reading, wants_context
        )  # of all streams
        for n in range(len(steps)):
            if steps[n] % lag == 0:
                copy(carried[n], after.carried[n])
                copy(expected[n], after.expected[n])


@partial(inner, inlined=True)
def follow(weights: RowWeights, carried: Any, reading: ScaledRows, wants_context: bool) -> Any:
    """Return f(μ_t) (B, H) and the new carried state c_t (B, I)."""
    if weights.settles:
        return settle(carried, reading, weights.settling, weights.inference)
    return remember(carried, reading, weights.recurrent, weights.inference, wants_context)


@partial(inner, inlined=True)
def associate(weights: RowWeights, reading: ScaledRows) -> Any:
    """Return the errors (B, X) of what other senses predict, and the units (B, M)."""
    return normalised_errors(reading, weights.association, weights.wiring)


@inner
def surprise_of_rows(
    repetition: RepetitionWeights,
    unlikely: Any,
    shares: Any,
    finite: Any,
    judged: Any,
    attribution: Any,
) -> None:
    """Write surprise and attribution: shares of errors pooled with repetitions, and divided by what excuses them.

    Args:
        repetition: what was learned of repetitions.
        unlikely: (B, X) n of ``repetition``.
        shares: (B, X) of the errors.
        finite: (B, D) which numbers are finite; the surprise of the others is infinite.
        judged: (B,) of ``JUDGED``, with the divisors.
        attribution: (B, D), written.
    """
    columns = repetition.columns
    for n in range(len(judged)):
        share = attribution[n]
        share.fill(0.0)
        for i in range(len(columns)):
            share[columns[i]] = shares[n, i]
        pool_repetitions(repetition, unlikely[n], share)
        mark_missing(finite[n], share)

        surprise = total(share)
        judged[n].raw_surprise = surprise
        judged[n].surprise = surprise
        if judged[n].divisor != 1.0:
            judged[n].surprise /= judged[n].divisor
            for i in range(len(share)):
                share[i] /= judged[n].divisor


@inner
def mark_missing(finite: Any, share: Any) -> None:
    """Write an infinite share for numbers that are not finite, and 0 for the others, where there are such."""
    if not finite.all():
        for i in range(len(finite)):
            share[i] = 0.0
            if not finite[i]:
                share[i] = np.inf
