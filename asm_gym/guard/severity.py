"""How bad it is: what presses on the arm, for how long, how fast the hand goes, and how hard it would hit.

This is also where a row is found to need no decision: no alarm, the policy acts, and nothing is wrong.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import Any, NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from asm_gym.compilation import compiled
from asm_gym.detection.events import EVENTS, KNOCK
from asm_gym.monitors import Surprise
from asm_gym.spec import Channel, StreamSpec

FREE_FORCE = 40.0
"""Force that healthy motion of many tasks comes to; impulse is counted beyond it [N]."""

LEANS_S = 0.4
"""More than ``FREE_FORCE`` for longer than this is no blow: the arm leans on something [s]. Healthy motion of six tasks
did so for 0.35 s, once 0.45; ISO/TS 15066 calls contact quasi-static from half a second on."""

AGAIN = 4.0
"""Each time that the policy has pressed too hard before shortens that by as many times."""

LEVER = 0.5
"""How far from a joint's axis an arm is touched, about [m]."""

BLOW = 2900.0
"""First blow on a table for each m/s of the hand [N s/m]; measured 2,500 to 3,100, on a bin 4,100."""

FAST = 0.35
"""No healthy hand is faster [m/s]."""

KNOCKED = EVENTS.index(KNOCK)

Floats = NDArray[np.float64]
Mask = NDArray[np.bool_]


class Felt(NamedTuple):
    """What n arms felt in the physics substeps of a control step; not a number where nothing feels there.

    Attributes:
        load: (n,) the largest share of a contact limit.
        left_s: (n,) when in the step a limit was passed [s]; not a number where none was.
        mean: (n, F) mean of what was felt, in the order of ``Robots.felt_channels`` [N], [N m].
    """

    load: Floats
    left_s: Floats
    mean: Floats

    @classmethod
    def nothing(cls, count: int, size: int) -> Self:
        """Return that nothing was felt by ``count`` arms, in ``size`` numbers."""
        none = np.full(count, np.nan)
        return cls(none, none, np.full((count, size), np.nan))


class Severity(NamedTuple):
    """How bad it is for each of n robots.

    Attributes:
        load: (n,) the largest share of a contact limit that was felt in a physics substep of this step.
        presses: (n,) a limit was passed, or the arm leans on something.
        force: (n,) contact force on the arm, estimated from wrist and joints, the mean of the step [N]; not a number
            where neither is sensed.
        impulse: (n,) what that force has added up to beyond ``FREE_FORCE`` in this episode [N s].
        speed: (n,) of the fastest hand [m/s]; not a number where none is sensed.
        predicted_force: (n,) of the blow if the hand met something stiff now [N].
        held: (n,) the arm is kept where it is.
        left_s: (n,) when in the step a limit was passed [s]; not a number where none was.
    """

    load: Floats
    presses: Mask
    force: Floats
    impulse: Floats
    speed: Floats
    predicted_force: Floats
    held: Mask
    left_s: Floats


class ForceColumns(NamedTuple):
    """Where numbers stand that tell of a contact force: (W, 3) forces at wrists, and (J,) external torques."""

    wrists: NDArray[np.intp]
    torques: NDArray[np.intp]

    @classmethod
    def of(cls, channels: Sequence[Channel]) -> Self:
        """Return those of numbers in the order of ``channels``, by their names."""
        places = _places(channels)
        wrists = [own for name, own in places.items() if name.endswith("wrist_force") and len(own) == 3]
        torques = [own for name, own in places.items() if name.endswith("external_torque")]
        return cls(_triples(wrists), np.concatenate([np.zeros(0, np.intp), *torques]).astype(np.intp))


def hand_velocities(spec: StreamSpec) -> NDArray[np.intp]:
    """Return the (H, 3) columns of hands' velocities."""
    return _triples([own for name, own in _places(spec.channels).items() if name.endswith("hand_velocity")])


def _places(channels: Sequence[Channel]) -> dict[str, NDArray[np.intp]]:
    ends = np.cumsum([0, *(c.size for c in channels)])
    return {c.name: np.arange(ends[i], ends[i + 1]) for i, c in enumerate(channels)}


def _triples(found: Sequence[NDArray[np.intp]]) -> NDArray[np.intp]:
    return np.array([own for own in found if own.size == 3], np.intp).reshape(-1, 3)


@compiled
def largest_norm(numbers: Any, triples: Any) -> float:
    """Return the largest norm of vectors; not a number where one is none, or there are none."""
    found = -np.inf
    for n in range(len(triples)):
        x, y, z = float(numbers[triples[n, 0]]), float(numbers[triples[n, 1]]), float(numbers[triples[n, 2]])
        norm = np.sqrt(x * x + y * y + z * z)
        if not norm <= found and found == found:
            found = norm
    return np.nan if found == -np.inf else found


@compiled
def contact_force(numbers: Any, wrists: Any, torques: Any) -> float:
    """Return the contact force [N] that numbers tell of; not a number where they tell of none."""
    wrist, largest = largest_norm(numbers, wrists), -np.inf  # with the weight of the hand, 5 to 10 N
    for j in torques:
        torque = abs(float(numbers[j]))
        if not torque <= largest and largest == largest:
            largest = torque
    joints = np.nan if largest == -np.inf else largest / LEVER
    return wrist if joints != joints or wrist >= joints else joints


@partial(compiled, calls=("detection", "."))
def weigh(
    rows: Any,
    load: Any,
    left_s: Any,
    felt: Any,
    felt_wrists: Any,
    felt_torques: Any,
    wrists: Any,
    torques: Any,
    hands: Any,
    dt: float,
    leans_s: float,
    most_impulse: float,
    impulse: Any,
    leant: Any,
    strikes: Any,
    force: Any,
    speed: Any,
    presses: Any,
    value: Any,
    raw: Any,
    excuse: Any,
    threshold: Any,
    over: Any,
    knocked: Any,
    decides: Any,
) -> None:
    """Judge rows (n, D): severity, whether surprise is over the threshold, and whether there is anything to decide.

    Args:
        load, left_s, felt: as ``Felt``.
        impulse, leant: (n,) the state: how much and for how long each arm has pressed; they are moved on.
        strikes: (n,) how often the policy has pressed too hard.
        value, raw, excuse: (n,) as ``Surprise``.
        force, speed, presses, over, knocked: (n,) are written.
        decides: (n,) where something is known already that takes a decision; more are added.
    """
    for n in range(len(rows)):
        # What the arm feels itself is not what a faulty sensor says of it; where it feels nothing, the row says.
        force[n] = contact_force(felt[n], felt_wrists, felt_torques)
        if force[n] != force[n]:
            force[n] = contact_force(rows[n], wrists, torques)
        more = max(force[n] - FREE_FORCE, 0.0) if np.isfinite(force[n]) else 0.0
        impulse[n] += more * dt
        leant[n] = leant[n] + dt if more > 0.0 else 0.0
        speed[n] = largest_norm(rows[n], hands)
        presses[n] = load[n] > 1.0 or np.isfinite(left_s[n]) or leant[n] > leans_s / (1.0 + AGAIN * strikes[n])
        over[n] = not value[n] <= threshold[n]
        knocked[n] = excuse[n] == KNOCKED and not over[n] and raw[n] > threshold[n]
        if presses[n] or over[n] or knocked[n] or impulse[n] > most_impulse:
            decides[n] = True


class Weighed(NamedTuple):
    """What surprise and severity come to.

    Attributes:
        over: (n,) surprise is over the threshold.
        knocked: (n,) it is over the threshold but for what a knock excuses.
        decides: (n,) there is something to decide.
    """

    over: Mask
    knocked: Mask
    decides: Mask


class SeverityEstimator:
    """Estimates severity from the rows of n streams, by the names of their channels.

    Args:
        count: n.
        spec: of the streams.
        felt: what arms feel in physics substeps.
        leans_s: how long an arm may press with more than ``FREE_FORCE`` [s].
    """

    def __init__(self, count: int, spec: StreamSpec, felt: Sequence[Channel], leans_s: float) -> None:
        columns = *ForceColumns.of(felt), *ForceColumns.of(spec.channels), hand_velocities(spec)
        self._how: tuple[Any, ...] = *columns, spec.dt, leans_s
        self._impulse, self._leant = np.zeros(count), np.zeros(count)

    def begin(self, which: Mask) -> None:
        """New episodes of the robots of ``which`` (n,)."""
        self._impulse[which] = self._leant[which] = 0.0

    def weigh(
        self,
        rows: NDArray[np.float32],
        felt: Felt,
        held: Mask,
        surprise: Surprise,
        threshold: Floats,
        strikes: NDArray[np.int64],
        most_impulse: float,
        decides: Mask,
    ) -> tuple[Severity, Weighed]:
        """Judge the next rows (n, D), which may have numbers that are not finite.

        Args:
            held: (n,) the arm is kept where it is.
            threshold: (n,) of surprise.
            strikes: (n,) how often the policy has pressed too hard.
            most_impulse: how much an arm may press [N s].
            decides: (n,) where there is something to decide already.
        """
        value, n = surprise.value, len(rows)
        raw = value if surprise.raw is None else surprise.raw
        excuse = np.zeros(n, np.int8) if surprise.excuse is None else surprise.excuse
        force, speed = np.empty(n), np.empty(n)
        presses, over, knocked, decides = np.empty(n, bool), np.empty(n, bool), np.empty(n, bool), decides.copy()
        state = most_impulse, self._impulse, self._leant, strikes
        judged = value, raw, excuse, threshold, over, knocked, decides
        weigh(rows, *felt, *self._how, *state, force, speed, presses, *judged)
        severity = Severity(felt.load, presses, force, self._impulse.copy(), speed, BLOW * speed, held, felt.left_s)
        return severity, Weighed(over, knocked, decides)
