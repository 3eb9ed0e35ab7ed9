"""The hand against its joints: two senses of one thing, of which one is wrong where they contradict each other.

    z = (x - x(q)) / σ      x: the hand as it is sensed; x(q): by the angles of the joints, see ``Chain``
    m ← m + g (z - m)       |m| > LIMIT is a contradiction, at whatever rate it came about
    q̂_S = argmin |z|² + |q_S - q̄_S|²/ε²    what the angles S at fault must be; q̄, ε: completion, and its error

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
from asm_gym.guard.robot_facts import NO_COLUMNS
from asm_gym.memory.completion import sensors_of
from asm_gym.spec import StreamSpec

LIMIT = 6.0  # of |m|, in standard deviations of what the hand's channels say
OVER_S = 0.2  # what the running mean is over, about [s]
ONE = 2.0  # no single row takes the mean further than so many times the limit, lest it last
WINDOW = 10  # rows by which the sensor at fault is told from others
LEFT = 30.0  # of |z|², nine numbers: what no sensor at fault leaves more of
SURER = 10.0  # how much more of |z|², in all of these rows, the next best sensor leaves; else a moment is waited for
TURNS = 0.2  # the speed that is sensed of a joint is that of its angle where they differ by less [rad/s]
NEEDS = "joint_position", "joint_velocity", "hand_position", "hand_orientation"  # channels that it takes, of each arm

Floats = NDArray[np.float64]
Mask = NDArray[np.bool_]


class Contradiction(NamedTuple):
    """Hand and joints contradict each other."""

    part: str  # the one sensor that explains it, such as ``encoder[3]``; empty where none does
    columns: NDArray[np.intp]  # (n,) of the stream, its own


@dataclass
class _Case:
    """What is known of a robot whose hand and joints contradict each other."""

    accused: Mask  # (D,) what was named, as long as they contradict each other
    left: float = 0.0  # running mean of |z|² that this does not explain
    waited: int = 0  # rows in which no sensor was surely the one at fault
    named: Contradiction | None = None


class HandAgainstJoints:
    """Compares hand and joints of one arm in each of n robots.

    Args:
        chains: n, the kinematics of that arm.
        spec: of the stream, which has the channels of ``NEEDS``.
    """

    def __init__(self, chains: tuple[Chain, ...], spec: StreamSpec) -> None:
        prefix, n = chains[0].prefix, len(chains)

        def columns(*names: str) -> NDArray[np.intp]:
            return np.concatenate([np.arange(spec.size)[spec.slices[prefix + name]] for name in names])

        self._size, self._dt = spec.size, spec.dt
        self._q, self._v = columns("joint_position"), columns("joint_velocity")
        self._x = columns("hand_position", "hand_orientation")
        self._at = columns(*NEEDS)
        parts = ("axes", "anchors", "hand")
        self._geometry = tuple(np.stack([np.asarray(getattr(c, part), np.float64) for c in chains]) for part in parts)
        self._late = np.array([c.late_s for c in chains])
        self._weights = np.stack([1.0 / (c.noise * spec.noise[self._x]) for c in chains])  # (n, 9)
        self._gain = min(1.0, spec.dt / OVER_S)
        sensors = {int(c): Contradiction(*sensor) for sensor in sensors_of(spec) for c in sensor[1]}
        self._suspects = [sensors[int(c)] for c in (*self._q, *self._x)]
        self._mean, self._size_of = np.zeros((n, HAND)), np.zeros(n)  # m, and |m|; -1 where a number is missing
        self._whole = np.zeros(n, np.int64)  # rows since a number was missing
        self._recent = np.zeros((n, WINDOW, len(self._at)))  # the last ones that were whole, the newest last
        self._kept = np.zeros(n, np.int64)  # how many of them there are
        self._good = np.zeros((n, len(self._q)))  # angles that were believed last
        self._cases: dict[int, _Case] = {}
        how = self._at, *self._geometry, self._late, self._weights, self._gain, ONE * LIMIT / self._gain, LIMIT
        state = self._mean, self._size_of, self._whole, self._recent, self._kept, self._good
        self.arguments: tuple[Any, ...] = *how, *state  # of ``compare``, after the rows
        # Compiled or loaded here, so that the first contradiction does not wait for it.
        self._explained(0, self._recent[0, 0], np.ones(len(self._q), bool), np.zeros(HAND, bool))

    def begin(self, which: Mask) -> None:
        """New episodes of the robots of ``which`` (n,)."""
        self._mean[which], self._whole[which], self._kept[which], self._good[which] = 0.0, 0, 0, 0.0
        self._cases = {robot: case for robot, case in self._cases.items() if not which[robot]}

    def contradicting(self, some: bool) -> list[int]:
        """Return which robots' last rows contradict themselves; ``some`` do by ``compare``."""
        if self._cases:
            agree = (self._size_of >= 0.0) & (self._size_of <= LIMIT)
            self._cases = {robot: case for robot, case in self._cases.items() if not agree[robot]}
        return np.flatnonzero(self._size_of > LIMIT).tolist() if some else []

    def contradiction(self, robot: int, missing: Mask) -> Contradiction | None:
        """Return what is wrong with a robot whose last row contradicts itself, beside what is ``missing`` (D,)."""
        case = self._cases.setdefault(robot, _Case(np.zeros(self._size, bool)))
        wrong = missing | case.accused
        free, unseen = wrong[self._q], wrong[self._x]
        if free.any() or unseen.any():
            left = self._explained(robot, self._recent[robot, -1], free, unseen)[1]
            case.left += self._gain * (min(left, ONE * LEFT / self._gain) - case.left)
            if case.left <= LEFT:  # that explains it still; where nothing completes it, it is said again
                return case.named if (case.accused & ~missing).any() else None
        found = self._named(robot, case, free, unseen)
        if found is not None:
            case.named, case.left, case.accused[found.columns] = found, 0.0, True
        return found

    def vouched(self, robot: int) -> Mask:
        """Return (D,) what is right by the last row: all tell the same of hand and speeds, and none repeats itself."""
        J, right = len(self._q), np.zeros(self._size, bool)
        if self._whole[robot] < 2 or np.linalg.norm(self._mean[robot]) > LIMIT / 2:
            return right
        angles, speeds = self._recent[robot, -2:, :J], self._recent[robot, -2:, J : 2 * J]
        moves = np.abs((angles[1] - angles[0]) / self._dt - (speeds[1] + speeds[0]) / 2) < TURNS
        moves &= (angles[1] != angles[0]) | (speeds[1] != speeds[0])
        right[self._q], right[self._v], right[self._x] = moves, moves, True
        return right

    def accused(self, robot: int) -> Mask:
        """Return (D,) what is not to be believed again while the contradiction lasts."""
        case = self._cases.get(robot)
        return np.zeros(self._size, bool) if case is None else case.accused

    def refined(self, robot: int, row: Floats, missing: Mask, error: Floats) -> Floats:
        """Return a completed row (D,), of errors (D,), with ``missing`` angles (D,) as the hand tells of them."""
        free, unseen, now = missing[self._q], missing[self._x], row[self._at]
        if free.any() and not unseen.all() and np.isfinite(now).all():
            found, _ = self._explained(robot, now, free, unseen, (row[self._q], error[self._q]))
            row[self._q] = self._good[robot] = np.where(free, found, row[self._q])
        return row

    def _named(self, robot: int, case: _Case, free: Mask, unseen: Mask) -> Contradiction | None:
        """Return the one sensor that explains most of the last rows; None while that could be another as well."""
        rows, left = self._recent[robot, WINDOW - self._kept[robot] :], np.zeros(len(self._suspects))
        for n in range(len(left)):
            wrong = np.append(free, unseen)
            wrong[n] = True
            angles, hand = wrong[: len(free)], wrong[len(free) :]
            left[n] = sum(self._explained(robot, row, angles, hand)[1] for row in rows)
        best, next_best = np.argsort(left)[:2]
        case.waited += 1
        if left[next_best] - left[best] < SURER and case.waited * self._gain <= 1.0:
            return None
        case.waited = 0
        return self._suspects[best] if left[best] <= LEFT * len(rows) else Contradiction("", NO_COLUMNS)

    def _explained(
        self, robot: int, row: Floats, free: Mask, unseen: Mask, known: tuple[Floats, Floats] | None = None
    ) -> tuple[Floats, float]:
        """Return (J,) angles of which those that are ``free`` are what the hand says, and |z|² of what it leaves.

        What is ``known`` of them beside (J,) counts by its standard deviations (J,) [rad].
        """
        J, geometry = len(self._q), (part[robot] for part in self._geometry)
        q = np.where(free, self._good[robot], row[:J])
        about, error = (q, np.full(J, np.inf)) if known is None else known
        late = self._late[robot] * np.where(free, 0.0, row[J : 2 * J])
        weights = np.where(unseen, 0.0, self._weights[robot])
        found, left = _fit(q - late, row[2 * J :], free, weights, about - late, error, *geometry)
        return found + late, float(left)


def no_hand(count: int) -> tuple[Any, ...]:
    """Return the arguments of ``compare`` for ``count`` robots without a hand that their joints tell of."""
    none, each, whole = np.zeros((count, 0, 3)), np.zeros(count), np.zeros(count, np.int64)
    geometry, late = (none, none, np.zeros((count, 3, 3))), (each, np.zeros((count, HAND)), 1.0, 1.0, LIMIT)
    return NO_COLUMNS, *geometry, *late, np.zeros((count, HAND)), each, whole, none, whole, np.zeros((count, 0))


@compiled
def compare(rows: Any, at: Any, *known: Any) -> bool:
    """Take rows (n, D) into the running means (n, 9), and what else is known of each robot, in place.

    Args:
        at, known: ``HandAgainstJoints.arguments``.

    Returns:
        Whether any robot contradicts itself.
    """
    axes, anchors, hand, late, weights, gain, cap, limit, mean, size, whole, recent, kept, good = known
    some = False
    J, newest = axes.shape[1], recent.shape[1] - 1
    row, angles, z = np.empty(len(at)), np.empty(J), np.empty(HAND)
    for n in range(len(rows)):
        finite = True
        for i in range(len(at)):
            row[i] = rows[n, at[i]]
            finite = finite and np.isfinite(row[i])
        if not finite:
            size[n], whole[n] = -1.0, 0
            continue
        for j in range(J):
            angles[j] = row[j] - late[n] * row[J + j]
        length = np.sqrt(_left(angles, row[2 * J :], weights[n], axes[n], anchors[n], hand[n], z))
        share = 1.0 if length <= cap else cap / length
        total = 0.0
        for k in range(len(z)):
            mean[n, k] += gain * (share * z[k] - mean[n, k])
            total += mean[n, k] * mean[n, k]
        size[n] = np.sqrt(total)
        whole[n] += 1
        kept[n] = min(kept[n] + 1, newest + 1)
        for i in range(len(at)):
            for k in range(newest):
                recent[n, k, i] = recent[n, k + 1, i]
            recent[n, newest, i] = row[i]
        if size[n] <= limit:
            for j in range(J):
                good[n, j] = row[j]
        else:
            some = True
    return some


@inner
def _left(q: Any, x: Any, weights: Any, axes: Any, anchors: Any, hand: Any, z: Any) -> float:
    """Write z (9,), what angles (J,) leave of the hand; return |z|²."""
    hand_at(q, axes, anchors, hand, z)
    total = 0.0
    for k in range(len(z)):
        z[k] = (x[k] - z[k]) * weights[k]
        total += z[k] * z[k]
    return total


@inner
def _solve(H: Any, b: Any, n: int) -> None:
    """Write the solution of H x = b to ``b`` (n,), for a symmetric H (n, n) that is positive definite."""
    for i in range(n):
        for j in range(i + 1):
            for k in range(j):
                H[i, j] -= H[i, k] * H[j, k]
            H[i, j] = np.sqrt(H[i, i]) if i == j else H[i, j] / H[j, j]
            if j < i:
                b[i] -= H[i, j] * b[j]
        b[i] /= H[i, i]
    for i in range(n - 1, -1, -1):
        for k in range(i + 1, n):
            b[i] -= H[k, i] * b[k]
        b[i] /= H[i, i]


@compiled
def _fit(q: Any, x: Any, free: Any, weights: Any, about: Any, error: Any, axes: Any, anchors: Any, hand: Any) -> Any:
    """Gauss and Newton's angles (J,), of which those that are ``free`` are looked for, and |z|² of what is left."""
    J, step, n = len(q), 1e-6, 0
    found, which, z, moved = np.empty(J), np.empty(J, np.intp), np.empty(HAND), np.empty(HAND)
    slope, H, b = np.empty((HAND, J)), np.empty((J, J)), np.empty(J)
    for j in range(J):
        found[j] = q[j]
        if free[j]:
            which[n] = j
            n += 1
    for _ in range(8 if n else 0):
        _left(found, x, weights, axes, anchors, hand, z)
        for i in range(n):
            j = which[i]
            was, trust = found[j], 1.0 / error[j] ** 2
            found[j] += step
            _left(found, x, weights, axes, anchors, hand, moved)
            found[j] = was
            b[i] = trust * (about[j] - was)
            for k in range(HAND):
                slope[k, i] = (z[k] - moved[k]) / step
                b[i] += slope[k, i] * z[k]
            for m in range(i + 1):
                H[i, m] = trust + 1.0 if m == i else 0.0
                for k in range(HAND):
                    H[i, m] += slope[k, i] * slope[k, m]
        _solve(H, b, n)
        for i in range(n):
            found[which[i]] += min(max(b[i], -0.5), 0.5)
    return found, _left(found, x, weights, axes, anchors, hand, z)
