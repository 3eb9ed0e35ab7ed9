"""The hand against its joints: two senses of one thing, of which one is wrong where they contradict each other.

    z = (x - x(q)) / σ                       x: the hand as it is sensed; x(q): by the joints' angles, see ``Chain``
    m ← m + g (z - m)                        |m| > LIMIT is a contradiction, at whatever rate it came about
    q̂_S = argmin |z|² + |q_S - q̄_S|²/ε²      what the angles S at fault must be; q̄, ε: completion, and its error

It takes a hand that is measured by itself: by a simulator, a camera, a tracker. Arms that compute their hand's place
from their encoders can contradict nothing.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from asm_gym.compilation import compiled, inner
from asm_gym.detection.kinematics import HAND, Chain, hand_at
from asm_gym.memory.completion import sensors_of
from asm_gym.spec import StreamSpec

NEEDS = "joint_position", "joint_velocity", "hand_position", "hand_orientation"
"""Channels that a check takes, of each arm."""

MOST_JOINTS = 12  # an arm with more joints is not checked
LIMIT = 6.0  # of |m|, in standard deviations of what the hand's channels say
AVERAGED_S = 0.2  # time over which the running mean is taken [s]
ONE_ROW = 2.0  # no single row takes the mean further than so many times the limit, lest it last
WINDOW = 10  # rows by which the sensor at fault is distinguished from others
EXPLAINED = 30.0  # most of |z|², nine numbers, that is left where the sensor at fault is left out
SURER_BY = 10.0  # how much more of |z|², in all of these rows, the next best sensor leaves; else a moment is waited for
SAME_SPEED = 0.2  # the speed that is sensed of a joint is that of its angle where they differ by less [rad/s]
DIFFERENCE = 1e-6  # of an angle, by which slopes are taken [rad]
LONGEST_STEP = 0.5  # that an angle makes in an iteration [rad]
ITERATIONS = 8

Floats = NDArray[np.float64]
Mask = NDArray[np.bool_]

HAND_GEOMETRY = np.dtype(
    [
        ("joints", np.int64),  # J
        (
            "columns",
            np.int64,
            2 * MOST_JOINTS + HAND,
        ),  # of the stream: J angles, J speeds, the hand
        ("axes", np.float64, (MOST_JOINTS, 3)),  # as in ``Chain``
        ("anchors", np.float64, (MOST_JOINTS, 3)),
        ("pose", np.float64, (3, 3)),
        ("late_s", np.float64),  # the angles are sensed by so much later than the hand [s]
        ("weights", np.float64, HAND),  # 1/σ
        ("gain", np.float64),  # g
    ],
    align=True,
)
"""What is known of an arm."""

HAND_STATE = np.dtype(
    [
        ("mean", np.float64, HAND),  # m
        ("distance", np.float64),  # |m|; -1 where a number is missing
        ("whole_rows", np.int64),  # since a number was missing
        ("kept_rows", np.int64),  # of ``rows``
        (
            "rows",
            np.float64,
            (WINDOW, 2 * MOST_JOINTS + HAND),
        ),  # the last that were whole, the newest last
        ("angles", np.float64, MOST_JOINTS),  # that were believed last [rad]
    ],
    align=True,
)
"""What was seen of an arm in this episode."""


class Contradiction(NamedTuple):
    """A hand and its joints contradict each other."""

    part: str  # the one sensor that explains it, such as ``encoder[3]``; empty where none does
    columns: NDArray[np.intp]  # (k,) of the stream, its own


@dataclass
class _OpenCase:
    """What is known of a robot whose hand and joints contradict each other."""

    accused: Mask  # (D,) what was named, as long as they contradict each other
    unexplained: float = 0.0  # running mean of |z|² that this does not explain
    undecided_rows: int = 0  # in which no sensor was surely the one at fault
    named: Contradiction | None = None


class HandChecks:
    """Compares the hands of n robots with their joints.

    Args:
        count: n.
        chains: of each arm, its kinematics in each of the n robots.
        spec: of the streams; an arm without the channels of ``NEEDS`` is not checked.

    Attributes:
        geometry, state: (n, arms) of ``HAND_GEOMETRY`` and ``HAND_STATE``.
        arms: a check for each arm.
    """

    def __init__(self, count: int, chains: tuple[tuple[Chain, ...], ...], spec: StreamSpec) -> None:
        checked = [own for own in chains if _can_check(own[0], spec)]
        self.geometry: NDArray[Any] = np.zeros((count, len(checked)), HAND_GEOMETRY)
        self.state: NDArray[Any] = np.zeros((count, len(checked)), HAND_STATE)
        for arm, own in enumerate(checked):
            for robot, chain in enumerate(own):
                _describe(self.geometry[robot, arm], chain, spec)
        self.arms = tuple(
            HandCheck(self.geometry[:, arm], self.state[:, arm], spec)
            for arm in range(len(checked))
        )

    def begin(self, which: Mask) -> None:
        """Begin new episodes of the robots of ``which`` (n,)."""
        self.state[which] = np.zeros((), HAND_STATE)
        for arm in self.arms:
            arm.begin(which)

    def right(self, robot: int) -> Mask | None:
        """Return (D,) what is right by the last row of a robot; None without an arm to check."""
        if not self.arms:
            return None
        return np.logical_or.reduce([arm.right(robot) for arm in self.arms])

    def contradiction(self, robot: int, missing: Mask) -> Contradiction | None:
        """Return what is wrong with the last row of a robot beside what is ``missing`` (D,): the first arm's."""
        named = [arm.contradiction(robot, missing) for arm in self.arms if arm.contradicts(robot)]
        return next((contradiction for contradiction in named if contradiction is not None), None)


def _can_check(chain: Chain, spec: StreamSpec) -> bool:
    """Return whether the stream tells of hand and joints of an arm."""
    return len(chain.axes) <= MOST_JOINTS and all(
        chain.prefix + name in spec.slices for name in NEEDS
    )


def _describe(geometry: Any, chain: Chain, spec: StreamSpec) -> None:
    """Write what is known of an arm into a record."""
    joints = len(chain.axes)
    slices = [spec.slices[chain.prefix + name] for name in NEEDS]
    columns = np.concatenate([np.arange(spec.size)[part] for part in slices])
    geometry["joints"] = joints
    geometry["columns"][: len(columns)] = columns
    geometry["axes"][:joints] = chain.axes
    geometry["anchors"][:joints] = chain.anchors
    geometry["pose"] = chain.hand
    geometry["late_s"] = chain.late_s
    geometry["weights"] = 1.0 / (chain.noise * spec.noise[columns[2 * joints :]])
    geometry["gain"] = min(1.0, spec.dt / AVERAGED_S)


class HandCheck:
    """Names the sensor at fault where the hand of one arm contradicts its joints.

    Args:
        geometry, state: (n,) of n robots, see ``HAND_GEOMETRY`` and ``HAND_STATE``.
        spec: of their streams.
    """

    def __init__(self, geometry: NDArray[Any], state: NDArray[Any], spec: StreamSpec) -> None:
        joints = int(geometry["joints"][0])
        columns = geometry["columns"][0]
        self._geometry = geometry
        self._state = state
        self._size = spec.size
        self._dt = spec.dt
        self._columns = columns[: 2 * joints + HAND]
        self._angles = columns[:joints]
        self._speeds = columns[joints : 2 * joints]
        self._hand = columns[2 * joints : 2 * joints + HAND]
        self._gain = float(geometry["gain"][0])
        sensors = {
            int(c): Contradiction(part=name, columns=own)
            for name, own in sensors_of(spec)
            for c in own
        }
        self._suspects = [sensors[int(c)] for c in (*self._angles, *self._hand)]
        self._cases: dict[int, _OpenCase] = {}
        # Compiled or loaded here, so that the first contradiction does not wait for it.
        self._explain(0, state["rows"][0, 0], np.ones(joints, bool), np.zeros(HAND, bool))

    def begin(self, which: Mask) -> None:
        """Begin new episodes of the robots of ``which`` (n,)."""
        self._cases = {robot: case for robot, case in self._cases.items() if not which[robot]}

    def contradicts(self, robot: int) -> bool:
        """Return whether the last row of a robot contradicts itself."""
        return bool(self._state["distance"][robot] > LIMIT)

    def close_cases(self) -> None:
        """Forget what was named of robots whose hands and joints agree again."""
        distance = self._state["distance"]
        agree = (distance >= 0.0) & (distance <= LIMIT)
        self._cases = {robot: case for robot, case in self._cases.items() if not agree[robot]}

    def contradiction(self, robot: int, missing: Mask) -> Contradiction | None:
        """Return what is wrong with a robot whose last row contradicts itself, beside what is ``missing`` (D,)."""
        case = self._cases.setdefault(robot, _OpenCase(np.zeros(self._size, bool)))
        wrong = missing | case.accused
        free = wrong[self._angles]
        unseen = wrong[self._hand]
        if free.any() or unseen.any():
            unexplained = self._explain(robot, self._state["rows"][robot, -1], free, unseen)[1]
            bounded = min(unexplained, ONE_ROW * EXPLAINED / self._gain)
            case.unexplained += self._gain * (bounded - case.unexplained)
            if case.unexplained <= EXPLAINED:
                # What was named explains it still; where nothing completes that sensor, it is named again.
                return case.named if (case.accused & ~missing).any() else None
        named = self._name_sensor(robot, case, free, unseen)
        if named is not None:
            case.named = named
            case.unexplained = 0.0
            case.accused[named.columns] = True
        return named

    def right(self, robot: int) -> Mask:
        """Return (D,) what is right by the last row: all say the same of hand and speeds, and none repeats itself."""
        right = np.zeros(self._size, bool)
        state = self._state[robot]
        if state["whole_rows"] < 2 or np.linalg.norm(state["mean"]) > LIMIT / 2:
            return right
        joints = len(self._angles)
        before, last = state["rows"][-2:]
        turned = last[:joints] - before[:joints]
        speeds = last[joints : 2 * joints]
        speeds_before = before[joints : 2 * joints]
        moves = np.abs(turned / self._dt - (speeds + speeds_before) / 2) < SAME_SPEED
        moves &= (turned != 0.0) | (speeds != speeds_before)
        right[self._angles] = moves
        right[self._speeds] = moves
        right[self._hand] = True
        return right

    def accused(self, robot: int) -> Mask:
        """Return (D,) what is not to be believed again while the contradiction lasts."""
        case = self._cases.get(robot)
        return np.zeros(self._size, bool) if case is None else case.accused

    def refine(self, robot: int, row: Floats, missing: Mask, error: Floats) -> Floats:
        """Return a completed row (D,), of errors (D,), with ``missing`` angles (D,) as the hand says."""
        free = missing[self._angles]
        unseen = missing[self._hand]
        now = row[self._columns]
        if free.any() and not unseen.all() and np.isfinite(now).all():
            completed = Prior(row[self._angles], error[self._angles])
            angles, _ = self._explain(robot, now, free, unseen, completed)
            believed = np.where(free, angles, row[self._angles])
            self._state["angles"][robot, : len(believed)] = believed
            row[self._angles] = believed
        return row

    def _name_sensor(
        self, robot: int, case: _OpenCase, free: Mask, unseen: Mask
    ) -> Contradiction | None:
        """Return the one sensor that explains most of the last rows; None while that could be another as well."""
        kept = int(self._state["kept_rows"][robot])
        rows = self._state["rows"][robot, WINDOW - kept :]
        unexplained = np.zeros(len(self._suspects))
        for n in range(len(unexplained)):
            wrong = np.append(free, unseen)
            wrong[n] = True
            angles = wrong[: len(free)]
            hand = wrong[len(free) :]
            unexplained[n] = sum(self._explain(robot, row, angles, hand)[1] for row in rows)
        best, next_best = np.argsort(unexplained)[:2]
        case.undecided_rows += 1
        unsure = unexplained[next_best] - unexplained[best] < SURER_BY
        if unsure and case.undecided_rows * self._gain <= 1.0:
            return None
        case.undecided_rows = 0
        if unexplained[best] <= EXPLAINED * len(rows):
            return self._suspects[best]
        return Contradiction(part="", columns=np.zeros(0, np.intp))

    def _explain(
        self, robot: int, row: Floats, free: Mask, unseen: Mask, prior: Prior | None = None
    ) -> tuple[Floats, float]:
        """Return (J,) angles of which those that are ``free`` (J,) are as the hand says, and |z|² of what is left.

        Args:
            row: its angles, speeds and hand, in the order of ``columns``.
            unseen: (9,) numbers of the hand that do not count.
            prior: what is known of the angles beside.
        """
        joints = len(free)
        angles = np.where(free, self._state["angles"][robot, :joints], row[:joints])
        if prior is None:
            prior = Prior(angles, np.full(joints, np.inf))
        late = self._geometry["late_s"][robot] * np.where(free, 0.0, row[joints : 2 * joints])
        weights = np.where(unseen, 0.0, self._geometry["weights"][robot])
        hand = row[2 * joints : 2 * joints + HAND]
        near = Prior(prior.angles - late, prior.error)
        fitted, unexplained = fit_angles(
            self._geometry[robot], angles - late, hand, weights, free, near
        )
        return fitted + late, float(unexplained)


class Prior(NamedTuple):
    """What is known of angles beside the hand."""

    angles: Floats  # (J,) [rad]
    error: Floats  # (J,) their standard deviations [rad]; infinite where nothing is known


@compiled
def compare_hands(rows: Any, geometry: Any, state: Any) -> bool:
    """Take rows (n, D) into the states (n, arms) of all hands; return whether any contradicts its joints."""
    some = False
    for n in range(len(rows)):
        some |= compare_hands_of(rows[n], geometry[n], state[n])
    return some


@inner
def compare_hands_of(row: Any, geometry: Any, state: Any) -> bool:
    """Take the row (D,) of one robot into the states (arms,) of its hands."""
    some = False
    for arm in range(len(geometry)):
        hand = geometry[arm]
        seen = state[arm]
        if not shift_in(row, hand, seen):
            seen.distance = -1.0
            seen.whole_rows = 0
            continue
        update_mean(hand, seen)
        if seen.distance <= LIMIT:
            for j in range(hand.joints):
                seen.angles[j] = seen.rows[WINDOW - 1, j]
        else:
            some = True
    return some


@inner
def shift_in(row: Any, hand: Any, seen: Any) -> bool:
    """Keep the numbers of an arm as the newest of its last rows, if all are finite; return whether they are."""
    size = 2 * hand.joints + HAND
    for i in range(size):
        if not np.isfinite(row[hand.columns[i]]):
            return False
    for i in range(size):
        for k in range(WINDOW - 1):
            seen.rows[k, i] = seen.rows[k + 1, i]
        seen.rows[WINDOW - 1, i] = row[hand.columns[i]]
    seen.whole_rows += 1
    seen.kept_rows = min(seen.kept_rows + 1, WINDOW)
    return True


@inner
def update_mean(hand: Any, seen: Any) -> None:
    """Take the newest row into m."""
    joints = hand.joints
    newest = seen.rows[WINDOW - 1]
    angles = np.empty(joints)
    for j in range(joints):
        angles[j] = newest[j] - hand.late_s * newest[joints + j]
    z = np.empty(HAND)
    length = np.sqrt(residual(angles, newest[2 * joints :], hand.weights, hand, z))
    longest = ONE_ROW * LIMIT / hand.gain
    share = min(1.0, longest / max(length, longest))
    total = 0.0
    for k in range(HAND):
        seen.mean[k] += hand.gain * (share * z[k] - seen.mean[k])
        total += seen.mean[k] * seen.mean[k]
    seen.distance = np.sqrt(total)


@inner
def residual(angles: Any, measured: Any, weights: Any, hand: Any, z: Any) -> float:
    """Write z (9,), what angles (J,) leave of the measured hand (9,) under weights (9,); return |z|²."""
    joints = hand.joints
    hand_at(angles, hand.axes[:joints], hand.anchors[:joints], hand.pose, z)
    total = 0.0
    for k in range(HAND):
        z[k] = (measured[k] - z[k]) * weights[k]
        total += z[k] * z[k]
    return total


@compiled
def fit_angles(hand: Any, angles: Any, measured: Any, weights: Any, free: Any, prior: Any) -> Any:
    """Return angles (J,), those that are ``free`` (J,) by Gauss and Newton's method, and |z|² of what is left.

    Args:
        hand: a record of ``HAND_GEOMETRY``.
        angles: (J,) to begin with.
        measured, weights: (9,) the hand, and 1/σ of its numbers, 0 for those that do not count.
        prior: a ``Prior`` of the angles.
    """
    fitted = angles.copy()
    z = np.empty(HAND)
    moved = np.empty(HAND)
    which = np.flatnonzero(free)
    slope = np.empty((HAND, len(which)))
    for _ in range(ITERATIONS if len(which) else 0):
        residual(fitted, measured, weights, hand, z)
        H = np.eye(len(which))
        b = np.empty(len(which))
        for i in range(len(which)):
            j = which[i]
            at = fitted[j]
            fitted[j] = at + DIFFERENCE
            residual(fitted, measured, weights, hand, moved)
            fitted[j] = at
            trust = 1.0 / prior.error[j] ** 2
            b[i] = trust * (prior.angles[j] - at)
            for k in range(HAND):
                slope[k, i] = (z[k] - moved[k]) / DIFFERENCE
                b[i] += slope[k, i] * z[k]
            for m in range(i + 1):
                for k in range(HAND):
                    H[i, m] += slope[k, i] * slope[k, m]
                H[m, i] = H[i, m]
            H[i, i] += trust
        step = np.linalg.solve(H, b)
        for i in range(len(which)):
            fitted[which[i]] += min(max(step[i], -LONGEST_STEP), LONGEST_STEP)
    return fitted, residual(fitted, measured, weights, hand, z)
