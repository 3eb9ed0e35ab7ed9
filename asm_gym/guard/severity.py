"""How bad it is: what presses on the arm, for how long, how fast the hand goes, and how hard it would hit.

This is also where a row is found to need no decision: no alarm, the policy acts, and nothing is wrong.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import Any, NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from asm_gym.compilation import compiled, inner
from asm_gym.detection.alarm_rule import EVENTS, KNOCK
from asm_gym.guard.arbiter import CALM, FREE, MOSTLY_AFTER, POLICY, ROWS, SINCE, STRIKES, Arbiter
from asm_gym.guard.robots import named
from asm_gym.monitors import Surprise
from asm_gym.spec import Channel, StreamSpec

FREE_FORCE = 40.0  # force that healthy motion of many tasks comes to; impulse is counted beyond it [N]
AGAIN = 4.0  # each time that the policy has pressed too hard before shortens that by as many times
LEVER = 0.5  # how far from a joint's axis an arm is touched, about [m]
BLOW = 2900.0  # first blow on a table for each m/s of the hand [N s/m]; measured 2,500 to 3,100, on a bin 4,100

LEANS_S = 0.5
"""More than ``FREE_FORCE`` for longer than this is no blow: the arm leans on something [s]. Healthy motion of six tasks
did so for 0.35 s, once 0.45; ISO/TS 15066 calls contact quasi-static from half a second on."""
SLOW, TWICE = 0.1, 15.0  # a slow hand [m/s] feels no inertia: time counts twice so far beyond ``FREE_FORCE`` [N]

HEAVIEST, WEIGHED_S = 15.0, 5.0
"""What a wrist bears without a contact, its hand's weight, is at most so much [N]; it is averaged over so long [s]."""

FAST = 0.35  # no healthy hand is faster [m/s]
UNKNOWN = np.array([np.nan, 0.0, np.nan])  # force, impulse and speed of a robot of which nothing is known

KNOCKED = EVENTS.index(KNOCK)

Floats = NDArray[np.float64]
Mask = NDArray[np.bool_]


def nothing_felt(count: int, size: int) -> Floats:
    """Return that ``count`` arms felt nothing within a step; arguments and result as ``felt`` in ``Severity``."""
    felt = np.empty((count, 2 + size))
    felt.fill(np.nan)
    return felt


class Severity(NamedTuple):
    """How bad it is for each of n robots; what is not sensed is not a number."""

    felt: Floats
    """(n, 2 + F) in the physics substeps of this control step: the largest share of a contact limit, when in the step a
    limit was passed [s], and the mean of what was felt, in the order of ``Robots.felt_channels`` [N], [N m]."""
    numbers: Floats
    """(n, 3) contact force on the arm, estimated from wrist and joints, the mean of the step [N]; what that force has
    added up to beyond ``FREE_FORCE`` in this episode [N s]; speed of the fastest hand [m/s]."""
    presses: Mask  # (n,) a limit was passed, or the arm leans on something
    held: Mask  # (n,) the arm is kept where it is

    @classmethod
    def unknown(cls, count: int) -> Self:
        """Return that nothing is known of ``count`` robots."""
        no = np.zeros(count, bool)
        return cls(nothing_felt(count, 0), np.tile(UNKNOWN, (count, 1)), no, no)

    def named(self, robot: int) -> dict[str, Any]:
        """Return what ``info["asm"]["severity"]`` says of a robot.

        ``load``: the largest share of a contact limit that was felt in a physics substep; ``presses``; ``force``;
        ``impulse``; ``speed``; ``predicted_force``: of the blow if the hand met something stiff now [N]; ``held``;
        ``left_s``: when in the step a limit was passed [s].
        """
        load, left_s = self.felt[robot, :2].tolist()
        force, impulse, speed = self.numbers[robot].tolist()
        forces = {"force": force, "impulse": impulse, "speed": speed, "predicted_force": BLOW * speed}
        presses, held = bool(self.presses[robot]), bool(self.held[robot])
        return {"load": load, "presses": presses, **forces, "held": held, "left_s": left_s}

    def where(self, known: Mask) -> Severity:
        """Return it of those robots alone that are ``known`` (n,)."""
        felt, numbers = (np.where(known[:, None], a, b) for a, b in ((self.felt, np.nan), (self.numbers, UNKNOWN)))
        return Severity(felt, numbers, self.presses & known, self.held & known)


def _forces(channels: Sequence[Channel]) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Return the columns that tell of a contact force: (W, 3) forces at wrists, and (J,) external torques."""
    return named(channels, "wrist_force", 3).reshape(-1, 3), named(channels, "external_torque")


@inner
def largest_norm(numbers: Any, triples: Any, less: Any) -> float:
    """Return the largest norm of vectors, ``less`` (N, 4) from its second number on; NaN where one is, or none."""
    found = -np.inf
    for n in range(len(triples)):
        x, y, z = float(numbers[triples[n, 0]]), float(numbers[triples[n, 1]]), float(numbers[triples[n, 2]])
        x, y, z = x - less[n, 1], y - less[n, 2], z - less[n, 3]
        norm = np.sqrt(x * x + y * y + z * z)
        if not norm <= found and found == found:
            found = norm
    return np.nan if found == -np.inf else found


@inner
def contact_force(numbers: Any, wrists: Any, torques: Any, weights: Any, steps: float) -> float:
    """Return the contact force [N] that numbers tell of; not a number where they tell of none.

    Args:
        weights: (W, 4) the number of steps, at most ``steps``, over which the wrists' loads without a contact were
            averaged, and that mean: the weight of each hand, which is no contact. It moves on here.
    """
    for n in range(len(wrists)):
        x, y, z = float(numbers[wrists[n, 0]]), float(numbers[wrists[n, 1]]), float(numbers[wrists[n, 2]])
        if x * x + y * y + z * z < HEAVIEST * HEAVIEST:
            weights[n, 0] = min(weights[n, 0] + 1.0, steps)
            for i in range(3):
                weights[n, 1 + i] += (float(numbers[wrists[n, i]]) - weights[n, 1 + i]) / weights[n, 0]
    wrist, largest = largest_norm(numbers, wrists, weights), -np.inf
    for j in torques:
        torque = abs(float(numbers[j]))
        if not torque <= largest and largest == largest:
            largest = torque
    joints = np.nan if largest == -np.inf else largest / LEVER
    return wrist if joints != joints or wrist >= joints else joints


@partial(compiled, calls=("detection", "."))
def _weigh(rows: Any, felt: Any, how: Any, judged: Any, counted: Any, active: Any, decides: Any, written: Any) -> int:
    """Judge rows (n, D), and count those about which there is nothing to decide; return how many there are to decide.

    Args:
        how: columns, times and limits. The impulse and the time that each arm has leant, ``pressed`` (2, n), and
            ``weights`` (2, n, W, 4) move on.
        judged: (n,) surprise, the same before anything excused it, and what did.
        counted: by the arbiter, which goes on counting.
        decides: (n,) gets more.
        written: the numbers (n, 3) of ``Severity``, and (n,) what presses, is over its threshold, and is excused.
    """
    felt_wrists, felt_torques, wrists, torques, hands, dt, leans_s, most_impulse, pressed, weights, nothing = how
    value, raw, excuse = judged
    threshold, state, counts, largest = counted
    numbers, presses, over, event = written
    some = 0
    for n in range(len(rows)):
        load, left_s = felt[n, 0], felt[n, 1]
        # What the arm feels itself is not what a faulty sensor says of it; where it feels nothing, the row says.
        force = contact_force(felt[n, 2:], felt_wrists, felt_torques, weights[0, n], WEIGHED_S / dt)
        if force != force:
            force = contact_force(rows[n], wrists, torques, weights[1, n], WEIGHED_S / dt)
        more = max(force - FREE_FORCE, 0.0) if np.isfinite(force) else 0.0
        speed = largest_norm(rows[n], hands, nothing)
        pressed[0, n] += more * dt
        leant = dt * (1.0 + (more / TWICE if speed < SLOW else 0.0)) if more > 0.0 else -dt
        pressed[1, n] = min(max(pressed[1, n] + leant, 0.0), 2.0 * leans_s)  # a moment below does not end it
        numbers[n, 0], numbers[n, 1], numbers[n, 2] = force, pressed[0, n], speed
        leans = pressed[1, n] > leans_s / (1.0 + AGAIN * counts[STRIKES, n])
        # What ends the episode is an alarm too.
        presses[n] = load > 1.0 or np.isfinite(left_s) or leans or pressed[0, n] > most_impulse
        over[n] = not value[n] <= threshold[n]
        event[n] = excuse[n] if raw[n] > threshold[n] and not over[n] else 0
        happens = presses[n] or over[n] or event[n] == KNOCKED
        if happens or state[n] != POLICY or counts[ROWS, n] == MOSTLY_AFTER - 1:
            decides[n] = True
        decides[n] = decides[n] and active[n]
        if decides[n]:
            some += 1
        elif active[n]:
            counts[CALM, n] += 1
            counts[FREE, n] = 0
            counts[SINCE, n] += 1
            counts[ROWS, n] += 1
            largest[n] = max(largest[n], value[n])
    return some


class SeverityEstimator:
    """Estimates severity from the rows of n streams, by the names of their channels.

    Args:
        count: n.
        spec: of the streams.
        felt: what arms feel in physics substeps.
        arbiter: counts the rows about which there is nothing to decide.
    """

    def __init__(self, count: int, spec: StreamSpec, felt: Sequence[Channel], arbiter: Arbiter) -> None:
        hands = named(spec.channels, "hand_velocity", 3).reshape(-1, 3)
        columns = *_forces(felt), *_forces(spec.channels), hands
        self._pressed, self._no_excuse = np.zeros((2, count)), np.zeros(count, np.int8)
        self._weights = np.zeros((2, count, max(len(columns[0]), len(columns[2])), 4))  # by what is felt, and by rows
        state = self._pressed, self._weights, np.zeros((len(columns[4]), 4))
        self._how: tuple[Any, ...] = *columns, spec.dt, LEANS_S, arbiter.most_impulse, *state
        self._arbiter: tuple[Any, ...] = arbiter.threshold, arbiter.state, arbiter.counts, arbiter.largest

    def begin(self, which: Mask) -> None:
        """New episodes of the robots of ``which`` (n,)."""
        self._pressed[:, which] = self._weights[:, which] = 0.0

    def weigh(
        self, rows: NDArray[np.float32], felt: Floats, held: Mask, surprise: Surprise, active: Mask, decides: Mask
    ) -> tuple[Severity, Mask, NDArray[np.int8], int]:
        """Judge the next rows.

        Args:
            rows: (n, D), perhaps not finite.
            felt: as in ``Severity``.
            held: (n,) the arm is kept where it is.
            surprise: at the rows.
            active: (n,) whose rows count.
            decides: (n,) where there is something to decide already; more are added.

        Returns:
            Severity; (n,) where surprise is over the threshold; (n,) what excuses it where it is over but for that, of
            ``EVENTS``; and for how many robots there is something to decide.
        """
        value, raw, excuse, empty, n = surprise.value, surprise.raw, surprise.excuse, np.empty, len(rows)
        numbers, presses, over, event = empty((n, 3)), empty(n, bool), empty(n, bool), empty(n, np.int8)
        judged: tuple[Any, ...] = value, value if raw is None else raw, self._no_excuse if excuse is None else excuse
        written = numbers, presses, over, event
        some = _weigh(rows, felt, self._how, judged, self._arbiter, active, decides, written)
        return Severity(felt, numbers, presses, held), over, event, some
