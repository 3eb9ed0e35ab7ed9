"""The hand against its joints: two senses of one thing, of which one is wrong where they contradict each other.

    z = (x - x(q)) / σ      x: the hand as it is sensed; x(q): by the angles of the joints, see ``Chain``
    m ← m + g (z - m)       |m| > LIMIT is a contradiction, at whatever rate it came about
    q̂_S = argmin |z|² + |q_S - q̄_S|²/ε²    what the angles S at fault must be; q̄, ε: completion, and its error

It takes a hand that is measured by itself: by a simulator, a camera, a tracker. Arms that compute their hand's place
from their encoders can contradict nothing.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from asm_gym.compilation import compiled
from asm_gym.detection.kinematics import HAND, Chain, hand_at
from asm_gym.guard.robots import NO_COLUMNS
from asm_gym.memory.completion import sensors_of
from asm_gym.spec import StreamSpec

LIMIT = 6.0
"""Of |m|, in standard deviations of what the hand's channels say."""

OVER_S = 0.2
"""What the running mean is over, about [s]."""

ONE = 2.0
"""No single row takes the mean further than so many times the limit, lest it last."""

WINDOW = 10
"""Rows by which the sensor at fault is told from others."""

LEFT = 30.0
"""Of |z|², nine numbers: what no sensor at fault leaves more of."""

SURER = 10.0
"""How much more of |z|², in all of these rows, the next best sensor leaves; else a moment more is waited for."""

TURNS = 0.2
"""The speed that is sensed of a joint is that of its angle where they differ by less [rad/s]."""

NEEDS = "joint_position", "joint_velocity", "hand_position", "hand_orientation"
"""Channels that it takes, of each arm."""

Floats = NDArray[np.float64]
Mask = NDArray[np.bool_]


class Contradiction(NamedTuple):
    """Hand and joints contradict each other."""

    part: str  # the one sensor that explains it, such as ``encoder[3]``; empty where none does
    columns: NDArray[np.intp]  # (n,) of the stream, its own


class _Case:
    """What is known of a robot whose hand and joints contradict each other."""

    def __init__(self, size: int) -> None:
        self.left, self.waited = 0.0, 0
        self.named: Contradiction | None = None
        self.accused = np.zeros(size, bool)  # (D,) what was named, as long as they contradict each other


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

        self._chains, self._size, self._dt = chains, spec.size, spec.dt
        self._q, self._v = columns("joint_position"), columns("joint_velocity")
        self._x = columns("hand_position", "hand_orientation")
        self._at: NDArray[np.intp] = np.concatenate([self._q, self._v, self._x])
        self._geometry = tuple(
            np.stack([np.asarray(part, np.float64) for part in parts])
            for parts in zip(*((c.axes, c.anchors, c.hand) for c in chains), strict=True)
        )
        self._late = np.array([c.late_s for c in chains])
        self._weights = np.stack([1.0 / (c.noise * spec.noise[self._x]) for c in chains])  # (n, 9)
        self._gain = min(1.0, spec.dt / OVER_S)
        self._cap = ONE * LIMIT / self._gain
        sensors = {int(c): (name, own) for name, own in sensors_of(spec) for c in own}
        self._suspects = [sensors[int(c)] for c in (*self._q, *self._x)]
        self._mean, self._size_of = np.zeros((n, HAND)), np.zeros(n)  # m, and |m|; -1 where a number is missing
        self._whole = np.zeros(n, np.int64)  # rows since a number was missing
        self._recent = np.zeros((n, WINDOW, len(self._at)))  # the last ones that were whole, the newest last
        self._kept = np.zeros(n, np.int64)  # how many of them there are
        self._good = np.zeros((n, len(self._q)))  # angles that were believed last
        self._cases: dict[int, _Case] = {}
        how = self._at, *self._geometry, self._late, self._weights, self._gain, self._cap, LIMIT
        state = self._mean, self._size_of, self._whole, self._recent, self._kept, self._good
        self.arguments: tuple[Any, ...] = *how, *state
        """Of ``compare``, after the rows."""

    def begin(self, which: Mask) -> None:
        """New episodes of the robots of ``which`` (n,)."""
        self._mean[which], self._whole[which], self._kept[which], self._good[which] = 0.0, 0, 0, 0.0
        for robot in np.flatnonzero(which):
            self._cases.pop(int(robot), None)

    def contradicting(self, some: bool) -> list[int]:
        """Return which robots' last rows contradict themselves; ``some`` do by ``compare``."""
        for robot in [robot for robot in self._cases if 0.0 <= self._size_of[robot] <= LIMIT] if self._cases else ():
            del self._cases[robot]
        return np.flatnonzero(self._size_of > LIMIT).tolist() if some else []

    def contradiction(self, robot: int, missing: Mask) -> Contradiction | None:
        """Return what is wrong with a robot whose last row contradicts itself, beside what is ``missing`` (D,)."""
        case = self._cases.setdefault(robot, _Case(self._size))
        now = self._recent[robot, -1]
        wrong = missing | case.accused
        known = wrong[self._q], wrong[self._x]
        if known[0].any() or known[1].any():
            left = min(self._explained(robot, now, *known)[1], ONE * LEFT / self._gain)
            case.left += self._gain * (left - case.left)
            if case.left <= LEFT:  # that explains it still; where nothing completes it, it is said again
                return case.named if (case.accused & ~missing).any() else None
        found = self._named(robot, case, *known)
        if found is not None:
            case.named, case.left, case.accused[found.columns] = found, 0.0, True
        return found

    def vouched(self, robot: int) -> Mask:
        """Return (D,) what is right by the last row: all tell the same of hand and speeds, and none repeats itself."""
        J, right = len(self._q), np.zeros(self._size, bool)
        if self._whole[robot] < 2 or np.linalg.norm(self._mean[robot]) > LIMIT / 2:
            return right
        before, now = self._recent[robot, -2:]
        turned = (now[:J] - before[:J]) / self._dt
        moves = np.abs(turned - (now[J : 2 * J] + before[J : 2 * J]) / 2) < TURNS
        moves &= (now[:J] != before[:J]) | (now[J : 2 * J] != before[J : 2 * J])
        right[self._q], right[self._v], right[self._x] = moves, moves, True
        return right

    def accused(self, robot: int) -> Mask:
        """Return (D,) what is not to be believed again while the contradiction lasts."""
        case = self._cases.get(robot)
        return np.zeros(self._size, bool) if case is None else case.accused

    def refined(self, robot: int, row: Floats, missing: Mask, error: Floats) -> Floats:
        """Return a completed row (D,), of errors (D,), with ``missing`` angles (D,) as the hand tells of them."""
        free, unseen = missing[self._q], missing[self._x]
        now = row[self._at]
        if not free.any() or unseen.all() or not np.isfinite(now).all():
            return row
        angles = now[: len(self._q)]
        found, _ = self._explained(robot, now, free, unseen, angles, error[self._q])
        self._good[robot] = np.where(free, found, angles)
        row[self._q] = self._good[robot]
        return row

    def _named(self, robot: int, case: _Case, free: Mask, unseen: Mask) -> Contradiction | None:
        """Return the one sensor that explains most of the last rows; None while that could be another as well."""
        rows = self._recent[robot, WINDOW - self._kept[robot] :]
        left = np.zeros(len(self._suspects))
        for n in range(len(left)):
            wrong = np.append(free, unseen)
            wrong[n] = True
            left[n] = sum(self._explained(robot, row, wrong[: len(free)], wrong[len(free) :])[1] for row in rows)
        best, next_best = np.argsort(left)[:2]
        case.waited += 1
        if left[next_best] - left[best] < SURER and case.waited * self._gain <= 1.0:
            return None
        case.waited = 0
        explains = left[best] <= LEFT * len(rows)
        return Contradiction(*self._suspects[best]) if explains else Contradiction("", NO_COLUMNS)

    def _explained(
        self,
        robot: int,
        row: Floats,
        free: Mask,
        unseen: Mask,
        about: Floats | None = None,
        error: Floats | None = None,
    ) -> tuple[Floats, float]:
        """Return (J,) angles of which those that are ``free`` are what the hand says, and |z|² of what it leaves.

        What is known ``about`` them (J,), with the standard deviation ``error`` (J,) [rad], counts beside.
        """
        J, geometry = len(self._q), (part[robot] for part in self._geometry)
        q = np.where(free, self._good[robot], row[:J])
        known = (q, np.full(J, np.inf)) if about is None or error is None else (about, error)
        late = self._late[robot] * np.where(free, 0.0, row[J : 2 * J])
        weights = np.where(unseen, 0.0, self._weights[robot])
        found, left = _fit(q - late, row[2 * J :], free, weights, known[0] - late, known[1], *geometry)
        return found + late, float(left)


def no_hand(count: int) -> tuple[Any, ...]:
    """Return the arguments of ``compare`` for ``count`` robots without a hand that their joints tell of."""
    none, each, whole = np.zeros((count, 0, 3)), np.zeros(count), np.zeros(count, np.int64)
    geometry, late = (none, none, np.zeros((count, 3, 3))), (each, np.zeros((count, HAND)), 1.0, 1.0, LIMIT)
    return NO_COLUMNS, *geometry, *late, np.zeros((count, HAND)), each, whole, none, whole, np.zeros((count, 0))


@compiled
def compare(
    rows: Any,
    at: Any,
    axes: Any,
    anchors: Any,
    hand: Any,
    late: Any,
    weights: Any,
    gain: float,
    cap: float,
    limit: float,
    mean: Any,
    size: Any,
    whole: Any,
    recent: Any,
    kept: Any,
    good: Any,
) -> bool:
    """Take rows (n, D) into the running means (n, 9), and what else is known of each robot, in place; return whether
    any contradicts itself."""
    some = False
    J, newest = axes.shape[1], recent.shape[1] - 1
    row = np.empty(len(at))
    for n in range(len(rows)):
        finite = True
        for i in range(len(at)):
            row[i] = rows[n, at[i]]
            finite = finite and np.isfinite(row[i])
        if not finite:
            size[n], whole[n] = -1.0, 0
            continue
        place = hand_at(row[:J] - late[n] * row[J : 2 * J], axes[n], anchors[n], hand[n])
        z = (row[2 * J :] - place) * weights[n]
        length = np.sqrt(np.sum(z * z))
        share = 1.0 if length <= cap else cap / length
        total = 0.0
        for k in range(len(z)):
            mean[n, k] += gain * (share * z[k] - mean[n, k])
            total += mean[n, k] * mean[n, k]
        size[n] = np.sqrt(total)
        whole[n] += 1
        kept[n] = min(kept[n] + 1, newest + 1)
        for k in range(newest):
            recent[n, k] = recent[n, k + 1]
        recent[n, newest] = row
        if size[n] <= limit:
            good[n] = row[:J]
        else:
            some = True
    return some


@compiled
def _fit(q: Any, x: Any, free: Any, weights: Any, about: Any, error: Any, axes: Any, anchors: Any, hand: Any) -> Any:
    """Gauss and Newton's angles (J,), of which those that are ``free`` are looked for, and |z|² of what is left."""
    q, which = q.copy(), np.flatnonzero(free)
    n, step = len(which), 1e-6
    slope = np.zeros((len(x), n))
    for _ in range(8 if n else 0):
        z = (x - hand_at(q, axes, anchors, hand)) * weights
        for i in range(n):
            moved = q.copy()
            moved[which[i]] += step
            slope[:, i] = ((hand_at(moved, axes, anchors, hand) - x) * weights + z) / step
        H, b = slope.T @ slope, slope.T @ z
        for i in range(n):
            trust = 1.0 / error[which[i]] ** 2
            H[i, i] += trust + 1.0
            b[i] += trust * (about[which[i]] - q[which[i]])
        change = np.linalg.solve(H, b)
        for i in range(n):
            q[which[i]] += min(max(change[i], -0.5), 0.5)
    z = (x - hand_at(q, axes, anchors, hand)) * weights
    return q, np.sum(z * z)
