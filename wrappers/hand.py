"""The hand against its joints: two senses of one thing, of which one is wrong where they contradict each other.

    z = (x - x(q)) / σ      x: the hand as it is sensed; x(q): by the joints' angles, see ``asm_gym.kinematics``
    m ← m + g (z - m)       |m| > LIMIT is a contradiction, at whatever rate it came about
    q̂_S = argmin |z|² + |q_S - q̄_S|²/ε²    what the angles S at fault must be; q̄, ε: completion, and its error

It takes a hand that is measured by itself: by a simulator, a camera, a tracker. Arms that compute their hand's place
from their encoders can contradict nothing.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

from asm_gym.compilation import compiled
from asm_gym.kinematics import HAND, Chain, hand_at
from asm_gym.memory.completion import sensors_of
from asm_gym.protocols import KnowsItsArms
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

NOBODY = np.zeros(0, np.intp)

Mask = NDArray[np.bool_]


class Contradiction(NamedTuple):
    """Hand and joints contradict each other.

    Attributes:
        part: the one sensor that explains it, such as ``encoder[3]``; empty where none does.
        columns: (n,) of the stream, its own.
    """

    part: str
    columns: NDArray[np.intp]


class HandAgainstJoints:
    """Compares them in the rows of one stream.

    Args:
        chain: of the arm.
        spec: of the stream, which has its angles, their speeds, and place and turn of its hand.
    """

    def __init__(self, chain: Chain, spec: StreamSpec) -> None:
        def columns(*names: str) -> NDArray[np.intp]:
            return np.concatenate([np.arange(spec.size)[spec.slices[chain.prefix + name]] for name in names])

        self._chain, self._size, self._dt = chain, spec.size, spec.dt
        self._q, self._v = columns("joint_position"), columns("joint_velocity")
        self._x = columns("hand_position", "hand_orientation")
        self._at: NDArray[np.intp] = np.concatenate([self._q, self._v, self._x])
        self._one_over = 1.0 / (chain.noise * spec.noise[self._x])
        self._gain = min(1.0, spec.dt / OVER_S)
        sensors = {int(c): (name, own) for name, own in sensors_of(spec) for c in own}
        self._suspects = [sensors[int(c)] for c in (*self._q, *self._x)]
        self.reset()

    @classmethod
    def of(cls, env: gym.Env[Any, Any], spec: StreamSpec) -> tuple[HandAgainstJoints, ...]:
        """Of each arm of ``env`` that it says the kinematics of, and whose stream has both."""
        inner = env.unwrapped
        chains = inner.hand_chains if isinstance(inner, KnowsItsArms) else ()
        names = "joint_position", "joint_velocity", "hand_position", "hand_orientation"
        return tuple(cls(c, spec) for c in chains if all(c.prefix + name in spec.slices for name in names))

    def reset(self) -> None:
        """A new episode begins."""
        self._left, self._waited = 0.0, 0
        self.mean = np.zeros(HAND)
        """(9,) m, of the rows so far."""
        self._said: Contradiction | None = None
        self._whole = 0  # rows since a number was missing
        self._rows: list[NDArray[np.float64]] = []  # the last ones that were whole, (2 J + 9,) each
        self._good = np.zeros(len(self._q))  # (J,) angles that were believed last
        self._accused = np.zeros(self._size, bool)  # (D,) what was named, as long as they contradict each other

    def read(self, row: NDArray[np.floating[Any]], missing: Mask) -> Contradiction | None:
        """What is wrong by the next row (D,) as it was sensed, beside what is ``missing`` (D,) already."""
        now = np.asarray(row[self._at], np.float64)
        c, cap = self._chain, ONE * LIMIT / self._gain
        size = _follow(now, c.axes, c.anchors, c.hand, c.late_s, self._one_over, self._gain, cap, self.mean)
        self._whole = 0 if size < 0.0 else self._whole + 1
        if size < 0.0:  # a number is missing
            return None
        self._rows = [*self._rows[1 - WINDOW :], now]
        if size <= LIMIT:
            self._good, self._left, self._waited = now[: len(self._q)], 0.0, 0
            self._accused[:] = False
            return None
        wrong = missing | self._accused
        known = wrong[self._q], wrong[self._x]
        if known[0].any() or known[1].any():
            self._left += self._gain * (min(self._explained(now, *known)[1], ONE * LEFT / self._gain) - self._left)
            if self._left <= LEFT:  # that explains it still; where nobody completes it, it is said again
                return self._said if (self._accused & ~missing).any() else None
        found = self._named(*known)
        if found is not None:
            self._said, self._left, self._accused[found.columns] = found, 0.0, True
        return found

    @property
    def arrays(self) -> tuple[NDArray[np.intp], list[NDArray[np.float64]], NDArray[np.float64]]:
        """What ``_follow`` takes: (2 J + 9,) columns of a row; axes, anchors, hand and 1/σ; how late, gain and cap."""
        c = self._chain
        numbers = np.array([c.late_s, self._gain, ONE * LIMIT / self._gain])
        return self._at, [c.axes, c.anchors, c.hand, self._one_over], numbers

    def passed(self, rows: Sequence[NDArray[np.floating[Any]]], count: int, mean: NDArray[np.float64]) -> None:
        """So many rows, the last of them ``rows`` (D,), were whole, contradicted nothing, and led to this ``mean``."""
        self._rows = [*self._rows, *(np.asarray(row[self._at], np.float64) for row in rows[-WINDOW:])][-WINDOW:]
        self._whole, self.mean = self._whole + count, np.array(mean)
        self._good, self._left = self._rows[-1][: len(self._q)], 0.0
        self._accused[:] = False

    @property
    def vouched(self) -> Mask:
        """(D,) what is right by the last row: each tells the same of the hand, and of a joint's speed, and none repeats
        itself."""
        J, right = len(self._q), np.zeros(self._size, bool)
        if self._whole < 2 or np.linalg.norm(self.mean) > LIMIT / 2:
            return right
        before, now = self._rows[-2:]
        turned = (now[:J] - before[:J]) / self._dt
        moves = np.abs(turned - (now[J : 2 * J] + before[J : 2 * J]) / 2) < TURNS
        moves &= (now[:J] != before[:J]) | (now[J : 2 * J] != before[J : 2 * J])
        right[self._q], right[self._v], right[self._x] = moves, moves, True
        return right

    @property
    def accused(self) -> Mask:
        """(D,) what was found to be at fault, and is not to be believed again while the contradiction lasts."""
        return self._accused

    def refined(self, row: NDArray[np.float64], missing: Mask, error: NDArray[np.float64]) -> NDArray[np.float64]:
        """(D,) the row, with the angles that are ``missing`` (D,) as the hand tells of them.

        Args:
            row: (D,) completed.
            error: (D,) standard deviations of that.
        """
        free, unseen = missing[self._q], missing[self._x]
        now = row[self._at]
        if not free.any() or unseen.all() or not np.isfinite(now).all():
            return row
        angles = now[: len(self._q)]
        found, _ = self._explained(now, free, unseen, angles, error[self._q])
        self._good = np.where(free, found, angles)
        row[self._q] = self._good
        return row

    def _named(self, free: Mask, unseen: Mask) -> Contradiction | None:
        """The one sensor that explains most of the last rows; None while that could be another as well."""
        left = np.zeros(len(self._suspects))
        for n in range(len(left)):
            wrong = np.append(free, unseen)
            wrong[n] = True
            left[n] = sum(self._explained(row, wrong[: len(free)], wrong[len(free) :])[1] for row in self._rows)
        best, next_best = np.argsort(left)[:2]
        self._waited += 1
        if left[next_best] - left[best] < SURER and self._waited * self._gain <= 1.0:
            return None
        self._waited = 0
        explains = left[best] <= LEFT * len(self._rows)
        return Contradiction(*self._suspects[best]) if explains else Contradiction("", NOBODY)

    def _explained(
        self,
        row: NDArray[np.float64],
        free: Mask,
        unseen: Mask,
        about: NDArray[np.float64] | None = None,
        error: NDArray[np.float64] | None = None,
    ) -> tuple[NDArray[np.float64], float]:
        """(J,) angles of which those that are ``free`` are what the hand says, and |z|² of what it leaves.

        Args:
            about, error: (J,) what is known of them, and its standard deviation [rad]; nothing where None.
        """
        c, J = self._chain, len(self._q)
        q = np.where(free, self._good, row[:J])
        known = (q, np.full(J, np.inf)) if about is None or error is None else (about, error)
        late = c.late_s * np.where(free, 0.0, row[J : 2 * J])
        weights = np.where(unseen, 0.0, self._one_over)
        found, left = _fit(q - late, row[2 * J :], free, weights, known[0] - late, known[1], c.axes, c.anchors, c.hand)
        return found + late, float(left)


@compiled
def _follow(
    row: Any, axes: Any, anchors: Any, hand: Any, late: float, one_over: Any, gain: float, cap: float, mean: Any
) -> float:
    """Takes a row (2 J + 9,) into the mean (9,), in place; its size, or -1 where the row has a number that is none."""
    J = len(axes)
    for value in row:
        if not np.isfinite(value):
            return -1.0
    z = (row[2 * J :] - hand_at(row[:J] - late * row[J : 2 * J], axes, anchors, hand)) * one_over
    size = np.sqrt(np.sum(z * z))
    share = 1.0 if size <= cap else cap / size
    total = 0.0
    for k in range(len(mean)):
        mean[k] += gain * (share * z[k] - mean[k])
        total += mean[k] * mean[k]
    return float(np.sqrt(total))


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
