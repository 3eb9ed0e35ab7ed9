"""The hand against its joints: two senses of one thing, of which one is wrong where they contradict each other.

    z = (x - x(q)) / σ                       x: the hand as it is sensed; x(q): by the joints' angles, see ``Chain``
    m ← m + g (z - m)                        |m| > LIMIT is a contradiction, at whatever rate it came about
    q̂_S = argmin |z|² + |q_S - q̄_S|²/ε²      what the angles S at fault must be; q̄, ε: completion, and its error

It takes a hand that is measured by itself: by a simulator, a camera, a tracker. Arms that compute their hand's place
from their encoders can contradict nothing.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from asm_gym.compilation import compiled, inner
from asm_gym.detection.hand_speed import Floats
from asm_gym.detection.kinematics import HAND, Chain, hand_at
from asm_gym.guard.robot_facts import NO_COLUMNS
from asm_gym.guard.robot_table import Mask
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
# How much more of |z|², in all of these rows, the next best sensor leaves; else wait a moment.
SURER_BY = 10.0
SAME_SPEED = 0.2  # a joint's sensed speed is that of its angle where they differ by less [rad/s]
DIFFERENCE = 1e-6  # of an angle, by which slopes are taken [rad]
LONGEST_STEP = 0.5  # that an angle makes in an iteration [rad]
ITERATIONS = 8

HAND_GEOMETRY = np.dtype(
    [
        ("joints", np.int64),  # J
        # of the stream: J angles, J speeds, the hand
        (
            "columns",
            np.int64,
            2 * MOST_JOINTS + HAND,
        ),
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
        # the last that were whole, the newest last; 0 before the first
        (
            "rows",
            np.float64,
            (WINDOW, 2 * MOST_JOINTS + HAND),
        ),
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

    def __init__(
        self,
        count: int,
        chains: tuple[tuple[Chain, ...], ...],
        spec: StreamSpec,
    ) -> None:
        checked = [own for own in chains if _can_check(own[0], spec)]
        shape = (count, len(checked))
        self.geometry: NDArray[Any] = np.zeros(shape, HAND_GEOMETRY)
        self.state: NDArray[Any] = np.zeros(shape, HAND_STATE)
        self.arms: list[HandCheck] = []
        for arm, own in enumerate(checked):
            geometry = self.geometry[:, arm]
            for robot, chain in enumerate(own):
                _describe(geometry[robot], chain, spec)
            self.arms.append(HandCheck(geometry, self.state[:, arm], spec))

    def begin(self, which: Mask) -> None:
        """Begin new episodes of the robots of ``which`` (n,)."""
        self.state[which] = np.zeros((), HAND_STATE)
        for arm in self.arms:
            arm.begin(which)

    def contradiction(
        self,
        robot: int,
        missing: Mask,
    ) -> Contradiction | None:
        """Return what is wrong with the last row of a robot beside what is ``missing`` (D,): the first arm's."""
        named = [arm.contradiction(robot, missing) for arm in self.arms if arm.contradicts(robot)]
        return next(filter(None, named), None)


def _can_check(
    chain: Chain,
    spec: StreamSpec,
) -> bool:
    """Return whether the stream tells of hand and joints of an arm."""
    needs = {chain.prefix + name for name in NEEDS}
    return len(chain.axes) <= MOST_JOINTS and needs <= spec.slices.keys()


def _describe(
    geometry: Any,
    chain: Chain,
    spec: StreamSpec,
) -> None:
    """Write what is known of an arm into a record."""
    joints = len(chain.axes)
    numbers = np.arange(spec.size)
    columns = np.concatenate([numbers[spec.slices[chain.prefix + name]] for name in NEEDS])
    geometry["joints"] = joints
    geometry["columns"][: len(columns)] = columns
    geometry["axes"][:joints] = chain.axes
    geometry["anchors"][:joints] = chain.anchors
    geometry["pose"] = chain.hand
    geometry["late_s"] = chain.late_s
    geometry["weights"] = 1.0 / (chain.noise * spec.noise[columns[-HAND:]])
    geometry["gain"] = min(1.0, spec.dt / AVERAGED_S)


@dataclass(eq=False)
class HandCheck:
    """Names the sensor at fault where the hand of one arm contradicts its joints."""

    geometry: NDArray[Any]  # (n,) of n robots, see ``HAND_GEOMETRY``
    state: NDArray[Any]  # (n,) see ``HAND_STATE``
    spec: StreamSpec  # of their streams
    _cases: dict[int, _OpenCase] = field(default_factory=dict)

    def __post_init__(self) -> None:
        joints = int(self.geometry["joints"][0])
        columns = self.geometry["columns"][0, : 2 * joints + HAND]
        self._joints = joints
        self._columns = columns
        # What may be at fault: J angles, then the numbers of the hand.
        self._suspects = np.delete(columns, np.s_[joints : 2 * joints])
        self._gain = float(self.geometry["gain"][0])
        # Compiled or loaded here, so that the first contradiction does not wait for it.
        self._explain(0, self.state["rows"][0, 0], np.ones(len(self._suspects), bool))

    def begin(self, which: Mask) -> None:
        """Forget what was named of the robots of ``which`` (n,): new episodes begin."""
        self._cases = {robot: case for robot, case in self._cases.items() if not which[robot]}

    def contradicts(self, robot: int) -> bool:
        """Return whether the last row of a robot contradicts itself."""
        return bool(self.state["distance"][robot] > LIMIT)

    def close_cases(self) -> None:
        """Forget what was named of robots whose hands and joints agree again."""
        distance = self.state["distance"]
        self.begin((distance >= 0.0) & (distance <= LIMIT))

    def contradiction(
        self,
        robot: int,
        missing: Mask,
    ) -> Contradiction | None:
        """Return what is wrong with a robot whose last row contradicts itself.

        What is ``missing`` (D,) is left aside.
        """
        case = self._cases.setdefault(robot, _OpenCase(np.zeros_like(missing)))
        wrong = (missing | case.accused)[self._suspects]
        if wrong.any():
            unexplained = self._explain(robot, self.state["rows"][robot, -1], wrong)[1]
            bounded = min(unexplained, ONE_ROW * EXPLAINED / self._gain)
            case.unexplained += self._gain * (bounded - case.unexplained)
            if case.unexplained <= EXPLAINED:
                # What was named still explains it; if nothing completes that sensor, name it again.
                return case.named if (case.accused & ~missing).any() else None
        named = self._name_sensor(robot, case, wrong)
        if named is not None:
            case.named = named
            case.unexplained = 0.0
            case.accused[named.columns] = True
        return named

    def right(self, robot: int) -> Mask:
        """Return (D,) what is right by the last row: all say the same of hand and speeds, and none repeats itself."""
        right = np.zeros(self.spec.size, bool)
        state = self.state[robot]
        if state["whole_rows"] < 2 or state["distance"] > LIMIT / 2:
            return right
        moving = state["rows"][-2:, : 2 * self._joints]
        before, last = moving.reshape(2, 2, self._joints)  # (angles or speeds, J)
        turned, sped_up = last - before
        speed = (last[1] + before[1]) / 2
        moves = np.abs(turned / self.spec.dt - speed) < SAME_SPEED
        moves &= (turned != 0.0) | (sped_up != 0.0)
        right[self._columns[:-HAND]] = np.tile(moves, 2)
        right[self._columns[-HAND:]] = True
        return right

    def accused(self, robot: int) -> Mask:
        """Return (D,) what is not to be believed again while the contradiction lasts."""
        case = self._cases.get(robot)
        return np.zeros(self.spec.size, bool) if case is None else case.accused

    def refine(
        self,
        robot: int,
        row: Floats,
        missing: Mask,
        error: Floats,
    ) -> Floats:
        """Return a completed row (D,), of errors (D,), with ``missing`` angles (D,) as the hand says."""
        wrong = missing[self._suspects]
        free = wrong[: self._joints]
        now = row[self._columns]
        if free.any() and not wrong[self._joints :].all() and np.isfinite(now).all():
            angles = self._columns[: self._joints]
            fitted, _ = self._explain(robot, now, wrong, error[angles])
            row[angles] = np.where(free, fitted, row[angles])
            self.state["angles"][robot, : self._joints] = row[angles]
        return row

    def _name_sensor(
        self,
        robot: int,
        case: _OpenCase,
        wrong: Mask,
    ) -> Contradiction | None:
        """Return the one sensor that explains most of the last rows; None while that could be another as well."""
        rows = self.state["rows"][robot]
        rows = rows[rows.any(axis=1)]
        unexplained = []
        for alone in np.eye(len(wrong), dtype=bool):
            left = [self._explain(robot, row, wrong | alone)[1] for row in rows]
            unexplained.append(sum(left))
        best, next_best = np.argsort(unexplained)[:2]
        case.undecided_rows += 1
        unsure = unexplained[next_best] - unexplained[best] < SURER_BY
        if unsure and case.undecided_rows * self._gain <= 1.0:
            return None
        case.undecided_rows = 0
        if unexplained[best] <= EXPLAINED * len(rows):
            for name, columns in sensors_of(self.spec):
                if self._suspects[best] in columns:
                    return Contradiction(part=name, columns=columns)
        return Contradiction(part="", columns=NO_COLUMNS)

    def _explain(
        self,
        robot: int,
        row: Floats,
        wrong: Mask,
        error: Floats | float = np.inf,
    ) -> tuple[Floats, float]:
        """Return (J,) angles, those that are wrong as the hand says, and |z|² of what is left.

        Args:
            robot: of which the row is.
            row: its angles, speeds and hand, in the order of ``columns``.
            wrong: (J + 9,) angles, and numbers of the hand, that do not count.
            error: (J,) standard deviations of the row's angles [rad]; infinite where the wrong ones tell nothing.
        """
        joints = self._joints
        geometry = self.geometry[robot]
        free = wrong[:joints]
        late = np.where(free, 0.0, geometry["late_s"] * row[joints : 2 * joints])
        fitted, unexplained = fit_angles(
            geometry,
            np.where(free, self.state["angles"][robot, :joints], row[:joints] - late),
            row,
            np.where(wrong[joints:], 0.0, geometry["weights"]),
            free,
            np.full(joints, error),
        )
        return fitted + late, float(unexplained)


@inner
def compare_hands_of(
    row: Any,
    geometry: Any,
    state: Any,
) -> bool:
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
        if seen.distance > LIMIT:
            some = True
        else:
            seen.angles[:] = seen.rows[-1, :MOST_JOINTS]
    return some


@inner
def shift_in(
    row: Any,
    hand: Any,
    seen: Any,
) -> bool:
    """Keep the numbers of an arm as the newest of its last rows, if all are finite; return whether they are."""
    size = 2 * hand.joints + HAND
    for i in range(size):
        if not np.isfinite(row[hand.columns[i]]):
            return False
    for k in range(WINDOW - 1):
        seen.rows[k] = seen.rows[k + 1]
    for i in range(size):
        seen.rows[-1, i] = row[hand.columns[i]]
    seen.whole_rows += 1
    return True


@inner
def update_mean(
    hand: Any,
    seen: Any,
) -> None:
    """Take the newest row into m."""
    joints = hand.joints
    newest = seen.rows[-1]
    angles = newest[:joints] - hand.late_s * newest[joints : 2 * joints]
    z = residual(angles, newest, hand.weights, hand)
    longest = ONE_ROW * LIMIT / hand.gain
    share = longest / max(np.sqrt(squared(z)), longest)
    for k in range(HAND):
        seen.mean[k] += hand.gain * (share * z[k] - seen.mean[k])
    seen.distance = np.sqrt(squared(seen.mean))


@compiled
def residual(
    angles: Any,
    row: Any,
    weights: Any,
    hand: Any,
) -> Any:
    """Return z (9,): what angles (J,) leave of the hand that a row says, under weights (9,)."""
    joints = hand.joints
    z = np.empty(HAND)
    hand_at(angles, hand.axes[:joints], hand.anchors[:joints], hand.pose, z)
    for k in range(HAND):
        z[k] = (row[2 * joints + k] - z[k]) * weights[k]
    return z


@inner
def squared(z: Any) -> float:
    """Return |z|²."""
    total = 0.0
    for number in z:
        total += number * number
    return total


def fit_angles(
    hand: Any,
    angles: Floats,
    row: Floats,
    weights: Floats,
    free: Mask,
    error: Floats,
) -> tuple[Floats, float]:
    """Return angles (J,), those that are ``free`` (J,) by Gauss and Newton's method, and |z|² of what is left.

    Args:
        hand: a record of ``HAND_GEOMETRY``.
        angles: (J,) to begin with; written to.
        row: its angles, speeds and hand.
        weights: (9,) 1/σ of the hand's numbers, 0 for those that do not count.
        free: (J,) the angles to fit.
        error: (J,) standard deviations of the row's angles [rad]; infinite where nothing is known.
    """
    which = np.flatnonzero(free)
    trust = 1.0 / error[which] ** 2
    slopes = np.empty((len(which), HAND))
    z = residual(angles, row, weights, hand)
    for _ in range(ITERATIONS):
        for i, joint in enumerate(which):
            turned = angles.copy()
            turned[joint] += DIFFERENCE
            slopes[i] = (z - residual(turned, row, weights, hand)) / DIFFERENCE
        H = slopes @ slopes.T + np.diag(1.0 + trust)
        b = slopes @ z + trust * (row[which] - angles[which])
        step = np.clip(np.linalg.solve(H, b), -LONGEST_STEP, LONGEST_STEP)
        angles[which] += step
        z = residual(angles, row, weights, hand)
        if np.abs(step).max(initial=0.0) < DIFFERENCE:
            break
    return angles, float(z @ z)
