"""A row in which nothing happens, in one compiled call: nearly all of them are such.

finite → hand against joints → severity → memory, excuses → is there anything to decide?

It is made of the kernels by which ``Guard`` judges a row, which is the oracle of this. Where there is anything to
decide nothing is kept, and ``Guard`` judges the row from where this began.
"""

from __future__ import annotations

import math
import sys
import time
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from asm_gym.addresses import flags2, floats1, floats2, singles1, singles2, table, whole1, whole2
from asm_gym.compilation import compiled, must_compile
from asm_gym.detection.detector import EvidenceState
from asm_gym.detection.events import EVENTS, KNOCK, _step
from asm_gym.detection.evidence import Evidence
from asm_gym.detection.repetition import Repetition
from asm_gym.memory.state import MemoryState
from asm_gym.monitors import Monitor, NeuralASM, Surprise
from asm_gym.monitors.fused import _matrix, _observe, _side_by_side, _vector
from asm_gym.monitors.monitor import MonitorState
from asm_gym.wrappers.arbiter import NOTHING, Decision
from asm_gym.wrappers.hand import HAND, LIMIT, _follow
from asm_gym.wrappers.responses import NO_RESPONSE
from asm_gym.wrappers.severity import BLOW, FREE_FORCE, LEVER, Severity
from asm_gym.wrappers.step_report import RowReport

if TYPE_CHECKING:
    from asm_gym.wrappers.guard import Guard

SIZES, AT, WRIST, JOINTS, FINGERS, LASTING, WRISTS, TORQUES, HANDS, FELT_WRISTS, FELT_TORQUES = range(11)
AXES, ANCHORS, REACH, ONE_OVER, ENDS, NUMBERS = range(11, 17)
"""Places of what stays as it is. ``SIZES`` are those of a state's arrays; the others are what ``HandAgainstJoints``,
``Excuses`` and ``SeverityEstimator`` know."""

ITERATIONS, LOOKS, CHAINED, EXCUSES = range(7, 11)
"""Places among ``SIZES``: what ``_observe`` is told, and whether there is a hand to compare and something to excuse."""

VALUE, RAW, KIND, FORCE, IMPULSE, SPEED, LOAD, LEFT, LATENCY, FOUND = range(10)
"""Places of what is found of a row; then its attribution (D,)."""

NOTHING_FELT = np.zeros(0)
KNOCKED = EVENTS.index(KNOCK)


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
        numbers = np.array([*numbers, monitor.spec.dt, pi_z, pi_x, curvature])
        ints, where = _side_by_side(np.int64, spans, at, *senses, *guard.columns)
        doubles, and_where = _side_by_side(np.float64, *chain, ends, numbers)
        self._fixed = ints, doubles, np.array([*where, *and_where]), *learned

        # Of each kind of number the state now and the next one, in turns.
        sizes = T + H + K, 2 * lag * D + G * X + H + 2 * X + HAND + 2, 4, X
        kinds = np.float32, np.float64, np.int64, np.bool_
        self._state = tuple(np.zeros((2, n), kind) for n, kind in zip(sizes, kinds, strict=True))
        self._table = table((*self._state, *self._fixed))
        self._now, self._size, self._runs, self._patience = 0, FOUND + D, False, (0.0, 0.0)
        if must_compile(_quiet):
            print("asm-gym: compiling the guard, once on this machine (about a minute)", file=sys.stderr)
        self.judge(np.full(D, np.nan, np.float32), None, 0.0)

    @classmethod
    def of(cls, monitor: Monitor, guard: Guard) -> QuietRows | None:
        """Those of a monitor and a guard; None where there are none for them."""
        if type(monitor) is not NeuralASM or monitor.compiled_row is None or not guard.can_be_quiet:
            return None
        return None if monitor.values_ is not None or monitor.skill_ is not None else cls(monitor, guard)

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
            felt = np.array(info.get("contact_felt", NOTHING_FELT), np.float64)
        start = time.perf_counter()
        quiet = _quiet(row, felt, found, threshold, load, left, *self._patience, self._now, self._table)
        found[LATENCY] = time.perf_counter() - start
        return QuietRow(found) if quiet else None

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
        old = _state(singles, doubles, whole, flags, self._fixed[0])
        state = MemoryState(*old[:6]), EvidenceState(Evidence(*old[6:9]), Repetition(*old[9:12]))
        self._guard.passed(doubles[-HAND - 2 : -2], *doubles[-2:].tolist())
        return MonitorState(*state, knock=old[12] if self._monitor.events is not None else ())


@compiled
def _state(singles: Any, doubles: Any, whole: Any, flags: Any, ints: Any) -> Any:
    """What lies in a row of each array: the fields of ``MemoryState``, ``Evidence`` and ``Repetition``, and knocks."""
    T, H, K, lag, D, G, X = ints[0], ints[1], ints[2], ints[3], ints[4], ints[5], ints[6]
    a, b, c = lag * D, 2 * lag * D, 2 * lag * D + G * X
    return (
        singles[:T].reshape((1, T)),
        singles[T : T + H].reshape((1, H)),
        doubles[:a].reshape((1, lag, D)),
        doubles[a:b].reshape((1, lag, D)),
        whole[:1],
        singles[T + H : T + H + K].reshape((1, K)),
        doubles[b:c].reshape((1, G, X)),
        doubles[c : c + H].reshape((1, H)),
        whole[1:2],
        doubles[c + H : c + H + X].reshape((1, X)),
        flags[:X].reshape((1, X)),
        doubles[c + H + X : c + H + 2 * X].reshape((1, X)),
        whole[2:4].reshape((1, 2)),
    )


@compiled
def _norm(numbers: Any, triples: Any) -> float:
    """The largest of vectors; not a number where one is none, or there are none."""
    found = -np.inf
    for n in range(len(triples)):
        x, y, z = numbers[triples[n, 0]], numbers[triples[n, 1]], numbers[triples[n, 2]]
        number = np.sqrt(x * x + y * y + z * z)
        if not number <= found and found == found:
            found = number
    return np.nan if found == -np.inf else found


@compiled
def _force(numbers: Any, wrists: Any, torques: Any) -> float:
    """As ``ContactForce``."""
    wrist, largest = _norm(numbers, wrists), -np.inf
    for j in torques:
        number = abs(numbers[j])
        if not number <= largest and largest == largest:
            largest = number
    joints = np.nan if largest == -np.inf else largest / LEVER
    return wrist if joints != joints or wrist >= joints else joints


@partial(compiled, calls=("memory", "detection", "monitors", "."))
def _quiet(
    row: Any,
    felt: Any,
    found: Any,
    threshold: float,
    load: float,
    left: float,
    leans: float,
    most: float,
    now: int,
    t: Any,
) -> bool:
    """Whether nothing happens in a row (D,); writes what is ``found`` of it, and the next state beside the one now.

    Args:
        felt: (N,) what the arm felt in the step that the row ends, empty where it ends none.
        leans: how long the arm may lean on something [s].
        most: how much it may press in an episode [N s].
        now: which of the states is that before the row.
        t: the ``table`` of states, of what stays as it is, and of what was learned.
    """
    singles, doubles, whole, flags = singles2(t, 0), floats2(t, 1), whole2(t, 2), flags2(t, 3)
    ints, fixed, where = whole1(t, 4), floats1(t, 5), whole2(t, 6)
    D = len(row)
    rows = np.empty((1, D))
    for i in range(D):
        if not np.isfinite(row[i]):
            return False
        rows[0, i] = row[i]
    numbers = _vector(fixed, where, NUMBERS)
    late, gain, cap, dt = numbers[0], numbers[1], numbers[2], numbers[3]
    pi_z, pi_x, curvature = np.float32(numbers[4]), np.float32(numbers[5]), np.float32(numbers[6])
    own, after = doubles[now], doubles[1 - now]
    first = len(own) - HAND - 2
    after[first:] = own[first:]
    mean = after[first : first + HAND]
    if ints[CHAINED]:
        at = _vector(ints, where, AT)
        sensed = np.empty(len(at))
        for i in range(len(at)):
            sensed[i] = rows[0, at[i]]
        chain = _matrix(fixed, where, AXES), _matrix(fixed, where, ANCHORS), _matrix(fixed, where, REACH)
        if not _follow(sensed, *chain, late, _vector(fixed, where, ONE_OVER), gain, cap, mean) <= LIMIT:
            return False

    force = np.nan
    if len(felt):
        force = _force(felt, _matrix(ints, where, FELT_WRISTS), _vector(ints, where, FELT_TORQUES))
    if force != force:
        force = _force(rows[0], _matrix(ints, where, WRISTS), _vector(ints, where, TORQUES))
    more = max(force - FREE_FORCE, 0.0) if np.isfinite(force) else 0.0
    impulse = own[first + HAND] + more * dt
    leant = own[first + HAND + 1] + dt if more > 0.0 else 0.0
    after[first + HAND], after[first + HAND + 1] = impulse, leant
    if load > 1.0 or np.isfinite(left) or leant > leans or impulse > most:
        return False

    old = _state(singles[now], own, whole[now], flags[now], ints)
    new = _state(singles[1 - now], after, whole[1 - now], flags[1 - now], ints)
    value, shares = found[VALUE : VALUE + 1], found[FOUND:].reshape((1, D))
    learned = singles1(t, 7), floats1(t, 8), whole1(t, 9), whole2(t, 10)
    how = pi_z, pi_x, curvature, ints[ITERATIONS], ints[LOOKS] != 0
    _observe(rows, *old[:12], *new[:12], value, shares, *learned, *how)
    found[RAW], found[KIND] = value[0], -1.0
    if ints[EXCUSES]:
        senses = _vector(ints, where, WRIST), _vector(ints, where, JOINTS), _matrix(fixed, where, ENDS)
        lasting = _vector(ints, where, FINGERS), _vector(ints, where, LASTING)
        knocks, kind, divisor = _step(old[12], rows, *senses, *lasting)
        new[12][:] = knocks
        found[KIND] = kind[0]
        if divisor[0] != 1.0:
            value[0] /= divisor[0]
            for i in range(D):
                shares[0, i] /= divisor[0]
    if not -np.inf < value[0] <= threshold or (found[KIND] == KNOCKED and found[RAW] > threshold):
        return False
    found[FORCE], found[IMPULSE], found[LOAD], found[LEFT] = force, impulse, load, left
    found[SPEED] = _norm(rows[0], _matrix(ints, where, HANDS))
    return True
