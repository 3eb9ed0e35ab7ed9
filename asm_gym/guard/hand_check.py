"""The hand against its joints: two senses of one thing, of which one is wrong where they contradict each other.

``hand_comparison`` finds that they contradict each other; here the sensor at fault is named, and its angle estimated.

It takes a hand that is measured by itself: by a simulator, a camera, a tracker. Arms that compute their hand's place
from their encoders can contradict nothing.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from asm_gym.detection.hand_speed import Floats
from asm_gym.detection.kinematics import HAND_SIZE, Chain
from asm_gym.guard.hand_comparison import (
    HAND_GEOMETRY,
    HAND_STATE,
    LIMIT,
    MOST_JOINTS,
    NEEDS,
    ONE_ROW,
    describe_arm,
    fit_angles,
)
from asm_gym.guard.robot_facts import NO_COLUMNS
from asm_gym.guard.robot_table import Mask
from asm_gym.memory.completion import sensors_of
from asm_gym.spec import StreamSpec

EXPLAINED = 30.0  # most of |z|², nine numbers, that is left where the sensor at fault is left out
# How much more of |z|², in all of these rows, the next best sensor leaves; else wait a moment.
SURER_BY = 10.0
SAME_SPEED = 0.2  # a joint's sensed speed is that of its angle where they differ by less [rad/s]


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
                describe_arm(geometry[robot], chain, spec)
            self.arms.append(HandCheck(geometry, self.state[:, arm], spec))

    def begin(self, which: Mask) -> None:
        """Begin new episodes of the robots of ``which`` (n,)."""
        self.state[which] = np.zeros((), HAND_STATE)
        for arm in self.arms:
            arm.begin(which)

    def contradiction(self, robot: int, missing: Mask) -> Contradiction | None:
        """Return what is wrong with the last row of a robot beside what is ``missing`` (D,): the first arm's."""
        contradicting = [arm for arm in self.arms if arm.contradicts(robot)]
        named = [arm.contradiction(robot, missing) for arm in contradicting]
        return next(filter(None, named), None)


def _can_check(chain: Chain, spec: StreamSpec) -> bool:
    """Return whether the stream tells of hand and joints of an arm."""
    needs = {chain.prefix + name for name in NEEDS}
    return len(chain.axes) <= MOST_JOINTS and needs <= spec.slices.keys()


@dataclass(eq=False)
class HandCheck:
    """Names the sensor at fault where the hand of one arm contradicts its joints."""

    geometry: NDArray[Any]  # (n,) of n robots, see ``HAND_GEOMETRY``
    state: NDArray[Any]  # (n,) see ``HAND_STATE``
    spec: StreamSpec  # of their streams
    _cases: dict[int, _OpenCase] = field(default_factory=dict)

    def __post_init__(self) -> None:
        joints = int(self.geometry["joints"][0])
        columns = self.geometry["columns"][0, : 2 * joints + HAND_SIZE]
        self._joints = joints
        self._columns = columns
        # What may be at fault: J angles, then the numbers of the hand.
        self._suspects = np.delete(columns, np.s_[joints : 2 * joints])
        self._gain = float(self.geometry["gain"][0])
        # Compiled or loaded here, so that the first contradiction does not wait for it.
        all_wrong = np.ones(len(self._suspects), bool)
        self._fit(0, self.state["rows"][0, 0], all_wrong)

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

    def contradiction(self, robot: int, missing: Mask) -> Contradiction | None:
        """Return what is wrong with a robot whose last row contradicts itself.

        What is ``missing`` (D,) is left aside.
        """
        case = self._cases.setdefault(robot, _OpenCase(np.zeros_like(missing)))
        wrong = (missing | case.accused)[self._suspects]
        if wrong.any():
            newest = self.state["rows"][robot, -1]
            _, unexplained = self._fit(robot, newest, wrong)
            bounded = min(unexplained, ONE_ROW * EXPLAINED / self._gain)
            case.unexplained += self._gain * (bounded - case.unexplained)
            if case.unexplained <= EXPLAINED:
                # What was named still explains it; if nothing completes that sensor, name it again.
                if (case.accused & ~missing).any():
                    return case.named
                return None
        named = self._name_sensor(robot, case, wrong)
        if named is not None:
            case.named = named
            case.unexplained = 0.0
            case.accused[named.columns] = True
        return named

    def consistent(self, robot: int) -> Mask:
        """Return (D,) what is right by the last row: all say the same of hand and speeds, and none repeats itself."""
        consistent = np.zeros(self.spec.size, bool)
        state = self.state[robot]
        if state["whole_rows"] < 2 or state["distance"] > LIMIT / 2:
            return consistent
        joints = state["rows"][-2:, : 2 * self._joints]
        before, newest = joints.reshape(2, 2, self._joints)  # each (angles or speeds, J)
        turned, sped_up = newest - before
        mean_speed = (newest[1] + before[1]) / 2
        off_by = np.abs(turned / self.spec.dt - mean_speed)
        agrees = off_by < SAME_SPEED
        changes = (turned != 0.0) | (sped_up != 0.0)
        consistent[self._columns[:-HAND_SIZE]] = np.tile(agrees & changes, 2)
        consistent[self._columns[-HAND_SIZE:]] = True
        return consistent

    def accused(self, robot: int) -> Mask:
        """Return (D,) what is not to be believed again while the contradiction lasts."""
        if robot not in self._cases:
            return np.zeros(self.spec.size, bool)
        return self._cases[robot].accused

    def refine(self, robot: int, row: Floats, missing: Mask, error: Floats) -> Floats:
        """Return a completed row (D,), of errors (D,), with ``missing`` angles (D,) as the hand says."""
        wrong = missing[self._suspects]
        wrong_angles = wrong[: self._joints]
        hand_tells = not wrong[self._joints :].all()
        own = row[self._columns]
        if wrong_angles.any() and hand_tells and np.isfinite(own).all():
            angles = self._columns[: self._joints]
            fitted, _ = self._fit(robot, own, wrong, error[angles])
            row[angles] = np.where(wrong_angles, fitted, row[angles])
            self.state["angles"][robot, : self._joints] = row[angles]
        return row

    def _name_sensor(self, robot: int, case: _OpenCase, wrong: Mask) -> Contradiction | None:
        """Return the one sensor that explains most of the last rows; None while that could be another as well."""
        rows = self.state["rows"][robot]
        rows = rows[rows.any(axis=1)]
        unexplained = []
        for alone in np.eye(len(wrong), dtype=bool):
            left = [self._fit(robot, row, wrong | alone)[1] for row in rows]
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

    def _fit(
        self, robot: int, row: Floats, wrong: Mask, error: Floats | float = np.inf
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
        speeds = row[joints : 2 * joints]
        turned_since = np.where(free, 0.0, geometry["late_s"] * speeds)
        believed = self.state["angles"][robot, :joints]
        fitted, unexplained = fit_angles(
            geometry,
            angles=np.where(free, believed, row[:joints] - turned_since),
            row=row,
            weights=np.where(wrong[joints:], 0.0, geometry["weights"]),
            free=free,
            error=np.full(joints, error),
        )
        return fitted + turned_since, float(unexplained)
