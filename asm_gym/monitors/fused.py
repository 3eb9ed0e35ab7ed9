"""One row of each stream in one compiled call: what ``MemoryModel`` and ``EvidenceDetection`` make of it together.

read → expect, infer → associate → whiten, accumulate → repetitions → attribute

The parts are the kernels of those two, and so is the mathematics; what is saved is Python between them, which took as
long as they did. They stay as they are for every other pair of model and detection, and are the oracle of this one.
"""

from __future__ import annotations

import sys
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from asm_gym.compilation import compiled, must_compile
from asm_gym.detection import Detection, EvidenceDetection
from asm_gym.detection.detector import EvidenceState, _step
from asm_gym.detection.evidence import POWER, TINY, Evidence
from asm_gym.detection.repetition import Repetition, repeated
from asm_gym.detection.tails import TAIL_INDEX
from asm_gym.memory.association import normalised_errors
from asm_gym.memory.inference import carry
from asm_gym.memory.network import Network
from asm_gym.memory.readout import add_up
from asm_gym.memory.state import MemoryState
from asm_gym.monitors.base import Surprise
from asm_gym.monitors.memory_model import MemoryModel
from asm_gym.monitors.monitor import MonitorState
from asm_gym.scaling import _read

A_THREAD = 256
"""Streams that one thread observes at a time."""


class CompiledRow:
    """``observe`` of a memory under the detection of evidence.

    Args:
        model: fitted, and not of a memory that was saved before there were traces.
        detection: fitted.
    """

    def __init__(self, model: MemoryModel, detection: EvidenceDetection) -> None:
        network, d, s = model.network, detection.detector_, model.senses_
        assert d is not None
        if must_compile(_observe):
            print("asm-gym: compiling the memory, once on this machine (about half a minute)", file=sys.stderr)
        skills = [model.learned_[n] for n in ("W_K", "b_K")] if model.skills_ else [np.zeros((0, 0)), np.zeros(0)]
        self._learned = (
            (s.mean, s.spread, s.change, model.spec.sensory, model.spec.motor, s.slow),
            tuple(network.weights),
            (*network.inference, bool(d.context_quantile[:-1].any())),
            (*network.association, network.spans),
            tuple(np.ascontiguousarray(W, np.float32) for W in skills),
            (d.whitening, d.ceiling, d.tail, d.context_quantile, d.context_range, d.gains, d.bound),
            detection.repeating,
        )

    @classmethod
    def of(cls, model: MemoryModel, detection: Detection) -> CompiledRow | None:
        """That of a model and a detection; None where there is none for them."""
        fits = type(model.network) is Network and isinstance(detection, EvidenceDetection)
        return cls(model, detection) if fits and isinstance(detection, EvidenceDetection) else None

    def __call__(self, state: MonitorState, rows: NDArray[np.float64]) -> tuple[MonitorState, Surprise]:
        """The new state, and the surprise of the next rows (B, D), some of which may not be finite."""
        model, (evidence, repetition) = state.model, state.detection
        old = (*model, *evidence, *repetition)
        new, found = tuple(map(np.empty_like, old)), (np.empty(len(rows)), np.empty_like(rows))

        def observe(part: slice) -> None:
            before, after, said = (tuple(a[part] for a in arrays) for arrays in (old, new, found))
            _observe(rows[part], before, after, said, *self._learned)

        parts = _parts(len(rows))
        if len(parts) == 1:
            observe(parts[0])
        else:
            with ThreadPoolExecutor() as threads:
                list(threads.map(observe, parts))
        detection = EvidenceState(Evidence(*new[6:9]), Repetition(*new[9:]))
        return MonitorState(MemoryState(*new[:6]), detection), Surprise(*found)


def _parts(streams: int) -> list[slice]:
    """What each thread observes: as many whatever the machine is, for products of other sizes have other last bits."""
    return [slice(a, a + A_THREAD) for a in range(0, max(streams, 1), A_THREAD)]


@partial(compiled, calls=("memory", "detection", "."), nogil=True)
def _observe(
    rows: Any,
    old: Any,
    new: Any,
    found: Any,
    scaler: Any,
    weights: Any,
    inference: Any,
    association: Any,
    readout: Any,
    detector: Any,
    repeating: Any,
) -> None:
    """Writes the ``new`` state and what was ``found``, value (B,) and attribution (B, D).

    Args:
        rows: (B, D).
        old: the state: the fields of ``MemoryState``, ``Evidence`` and ``Repetition``; so is ``new``.
        inference: and whether anybody looks at the context.
    """
    traces, expected, before, earlier, steps, skill, vector, lately, counted, said, again, unlikely = old
    B = len(rows)
    sensory, lag = scaler[3], before.shape[1]
    last, past = rows.copy(), rows.copy()  # what rows are compared with: at first nothing moves
    due = 0
    for n in range(B):
        if steps[n] >= lag:
            last[n] = before[n, 0]
        past[n] = earlier[n, 0] if steps[n] >= 2 * lag else last[n]
        due += steps[n] % lag == 0
        new[2][n, : lag - 1], new[3][n, : lag - 1] = before[n, 1:], earlier[n, 1:]
        new[2][n, lag - 1], new[3][n, lag - 1] = rows[n], last[n]
        new[4][n] = steps[n] + 1
    senses, seen, commands, inputs, changes, whole, finite = _read(rows, last, past, *scaler)

    new[0][:], new[1][:] = traces, expected
    if due:
        f, c = carry(traces, commands, senses, seen, *weights, *inference)
        for n in range(B):
            if steps[n] % lag == 0:
                new[0][n], new[1][n] = c[n], f[n]

    error, units = normalised_errors(inputs, changes, whole, *association)
    for n in range(B):
        if steps[n] < lag:
            error[n] = 0.0  # nothing came before, so that no change is known
    if len(readout[1]):
        new[5][:] = add_up(skill, units, new[1], *readout)

    errors, context = error.astype(np.float64), new[1].astype(np.float64)
    (new[6][:], new[7][:], new[8][:]), _, shares = _step(vector, lately, counted, errors, context, *detector)
    now = rows[:, sensory]
    new[9][:], new[10][:], new[11][:] = repeated(said, again, unlikely, now, repeating[0], repeating[1])
    _attribute(shares, new[11], repeating[2], sensory, finite, *found)


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
