"""Whether anything happens in a row: the compiled part of ``wrappers.quiet``."""

from __future__ import annotations

from functools import partial
from typing import Any

import numpy as np

from asm_gym.addresses import flags2, floats1, floats2, singles1, singles2, whole1, whole2
from asm_gym.compilation import compiled
from asm_gym.detection.events import EVENTS, KNOCK, _step
from asm_gym.kinematics import HAND
from asm_gym.monitors.fused import _matrix, _observe, _vector
from asm_gym.wrappers.hand import LIMIT, _follow
from asm_gym.wrappers.severity import FREE_FORCE, LEVER

SIZES, AT, WRIST, JOINTS, FINGERS, LASTING, WRISTS, TORQUES, HANDS, FELT_WRISTS, FELT_TORQUES = range(11)
AXES, ANCHORS, REACH, ONE_OVER, ENDS, NUMBERS = range(11, 17)
"""Places of what stays as it is. ``SIZES`` are those of a state's arrays; the others are what ``HandAgainstJoints``,
``Excuses`` and ``SeverityEstimator`` know."""

ITERATIONS, LOOKS, CHAINED, EXCUSES = range(7, 11)
"""Places among ``SIZES``: what ``_observe`` is told, and whether there is a hand to compare and something to excuse."""

VALUE, RAW, KIND, FORCE, IMPULSE, SPEED, LOAD, LEFT, LATENCY, FOUND = range(10)
"""Places of what is found of a row; then its attribution (D,)."""

KNOCKED = EVENTS.index(KNOCK)


@compiled
def state_in(singles: Any, doubles: Any, whole: Any, flags: Any, ints: Any) -> Any:
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
        whole[2:].reshape((1, len(whole) - 2)),
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
def quiet(
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

    old = state_in(singles[now], own, whole[now], flags[now], ints)
    new = state_in(singles[1 - now], after, whole[1 - now], flags[1 - now], ints)
    value, shares = found[VALUE : VALUE + 1], found[FOUND:].reshape((1, D))
    learned = singles1(t, 7), floats1(t, 8), whole1(t, 9), whole2(t, 10)
    how = pi_z, pi_x, curvature, ints[ITERATIONS], ints[LOOKS] != 0
    _observe(rows, *old[:12], *new[:12], value, shares, *learned, *how)  # type: ignore[call-arg]
    found[RAW], found[KIND] = value[0], -1.0
    if ints[EXCUSES]:
        senses = _vector(ints, where, WRIST), _vector(ints, where, JOINTS), _matrix(fixed, where, ENDS)
        lasting = _vector(ints, where, FINGERS), _vector(ints, where, LASTING)
        knocks, kind, divisor = _step(old[12], rows, *senses, *lasting, numbers[7])
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
